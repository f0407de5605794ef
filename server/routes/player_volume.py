"""The irradiance volume around a simulated player, as the live world last filled it."""

import asyncio
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query, Request, Response

from gi_core.live_volume import PublishedVolume
from gi_core.shadow_plan import MovingBox
from gi_core.stale_weights import boxes_in_reach, stale_share
from gi_core.volume import Volume
from server.caching import strong_etag
from server.dependencies import PlayerVolumeQuery, ServiceDep
from server.encoding import MEDIA_TYPE, REPLY_VERSION
from server.finished_replies import Body, names
from server.live_access import TickerDep
from server.live_state import LiveUnavailableError
from server.openapi import reply
from server.player_volumes import VolumeKey
from server.routes.players import IdInPath
from server.routes.volume import bytes_body, light_body, mask_body
from server.server_timing import Laps
from server.service import Service
from server.ticker import Ticker

router = APIRouter(prefix="/v1/players", tags=["live world"])
FIRST_FILL_S = 3.0
# Every tick may bring another one.
CACHE_CONTROL = "no-cache"


@router.get(
    "/{id}/volume",
    response_class=Response,
    responses=reply(
        *MEDIA_TYPE.values(),
        headers=("Gi-Volume", "Gi-Tick", "Gi-Boxes", "ETag"),
        more={304: {"description": "the client has the latest, by `since` or If-None-Match"}},
    ),
)
async def player_volume(
    request: Request, service: ServiceDep, ticker: TickerDep, name: IdInPath, query: Annotated[PlayerVolumeQuery, Query()]
) -> Response:
    """The latest volume around a player, laid out as /v1/volume's. `Gi-Tick` is the tick in which it was filled: give it as `since` next
    time. For a stream of what changes: the WebSocket `/v1/players/{id}/stream`, described in STREAM.md.

    Baked weights do not know boxes that move: `Gi-Boxes`, where it is there, says how many reach into the volume, and `stale=1` asks which
    voxels they concern.
    """
    laps = Laps()
    with laps.lap("wait"):
        found = await _published(service, ticker, name)
    boxes = boxes_in_reach(ticker.state.moving_boxes, found.first_voxel)
    if query.stale:
        with laps.lap("stale"):
            body = await asyncio.to_thread(_stale_body, service, found, boxes, query)
        headers = {**body.headers, "Cache-Control": "no-store", "Gi-Tick": str(found.tick), "Server-Timing": laps.text}
        return Response(body.content, media_type=body.media_type, headers=headers)
    etag = strong_etag("player volume", REPLY_VERSION, service.run_id, name, found.tick, query.format, query.encoding, query.mask)
    headers = {"ETag": etag, "Cache-Control": CACHE_CONTROL, "Gi-Tick": str(found.tick)}
    if boxes:
        headers["Gi-Boxes"] = str(len(boxes))
    # A tick that has not been yet is from before a restart.
    is_old = query.since is not None and found.tick <= query.since <= ticker.tick
    if is_old or names(request.headers, etag, is_there=True):
        return Response(status_code=304, headers=headers)

    def encode() -> Body:
        volume = _volume(service, found)
        return mask_body(volume, query) if query.mask else light_body(volume, query)

    with laps.lap("encode"):
        body = await service.player_volumes.get(VolumeKey(name, found.tick, query.format, query.encoding, query.mask), encode)
    headers |= {**body.headers, "Server-Timing": laps.text}
    return Response(body.content, media_type=body.media_type, headers=headers)


def _volume(service: Service, found: PublishedVolume) -> Volume:
    return Volume(found.values, found.mask, found.first_voxel, found.sectors, expected_error=service.expected_error)


def _stale_body(service: Service, found: PublishedVolume, boxes: tuple[MovingBox, ...], query: PlayerVolumeQuery) -> Body:
    """Reads the volume's sectors, if there are boxes: not for the event loop."""
    share = stale_share(service.dataset.sector, found.sectors, boxes, found.first_voxel)
    facts = {"unit": "share", "scale": 1 / 255, "boxes": len(boxes)}
    return bytes_body(_volume(service, found), np.rint(share * 255).astype(np.uint8), query, facts)


async def _published(service: Service, ticker: Ticker, name: str) -> PublishedVolume:
    """A player's latest volume; a new player's is waited for. Raises NoSuchThingError, LiveUnavailableError."""
    give_up_at = asyncio.get_running_loop().time() + FIRST_FILL_S
    while True:
        since_tick = ticker.state.player(name).since_tick
        found = ticker.world.published(name)
        # One that is older is of a player that had the same name.
        if found is not None and found.tick >= since_tick:
            return found
        left_s = give_up_at - asyncio.get_running_loop().time()
        try:
            await asyncio.wait_for(service.ticks.after(service.ticks.latest.tick), max(left_s, 0.0))
        except TimeoutError as error:
            if found is not None:  # the new player took over the old one's place and volume within one tick
                return found
            raise LiveUnavailableError(f"player {name}: no volume yet; ask again in a moment") from error
