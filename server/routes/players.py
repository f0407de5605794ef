"""Simulated players of the live world."""

import asyncio
import secrets
from dataclasses import replace
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import JSONResponse

from gi_core.errors import InputError
from server.dependencies import NoQuery, ServiceDep
from server.live_access import KEEP, TickerDep, WritingTickerDep, apply, apply_to, keep, reply_to
from server.live_models import GoneReply, PlayerReply, PlayersReply
from server.live_state import LivePlayer
from server.players import MAX_DWELL_S, player_from_json
from server.street_walk import MAX_WALK_M, MIN_WALK_M
from server.write_access import WRITE, JsonBody, body_schema

router = APIRouter(prefix="/v1/players", tags=["live world"])
IdInPath = Annotated[str, Path(alias="id", max_length=256, description="as /v1/players lists them")]
_BODY = body_schema(
    {"id": "runner", "speed": 5, "path": [[10, 1.6, 8], [90, 1.6, 8]], "loop": True},
    {
        "id": "1 to 64 letters, digits, - or _; made up when there is none",
        "speed": "m/s, 0..200",
        "path": "points [x, y, z] in world metres, or a GeoJSON LineString; without one the player walks along streets",
        "loop": "true: the last point leads to the first; else back and forth",
        "pause_s": f"[shortest, longest] pause at each corner [s], 0..{MAX_DWELL_S:g}",
        "turn_s": f"how long turning round on the spot takes [s], 0..{MAX_DWELL_S:g}",
        "seed": "of pauses, and of a walk along streets",
        "walk_m": f"how far a walk along streets goes before it turns back [m], {MIN_WALK_M:g}..{MAX_WALK_M:g}",
        "near": "[x, y, z] where a walk along streets starts",
        "keep": KEEP,
    },
)


@router.get("", response_model=PlayersReply)
def players(ticker: TickerDep, _: Annotated[NoQuery, Query()]) -> Response:
    """All players and where they are, without their paths."""
    state, tick = ticker.state, ticker.tick
    return JSONResponse({"players": [_whereabouts(entry, tick, ticker.rate_hz) for entry in state.players.values()], "tick": tick})


@router.post("", response_model=PlayerReply, status_code=201, dependencies=WRITE, openapi_extra=_BODY)
async def add_player(
    body: JsonBody, service: ServiceDep, ticker: WritingTickerDep, response: Response, _: Annotated[NoQuery, Query()]
) -> dict[str, Any]:
    """Another player, at the start of its walk in the tick that the reply names."""
    kept = body.pop("keep", False)
    if not isinstance(kept, bool):
        raise InputError("player: keep: expected true or false")
    if kept:
        service.live.kept.expect_possible()
    live = service.live

    def walking() -> LivePlayer:
        # Heights for GeoJSON, and streets to walk along, are read from files.
        player = player_from_json(body, "player", new_id=f"player-{secrets.token_hex(4)}", eye_height=live.lattice.eye_height)
        ticker.state.expect_room_for(player.id)  # planning a walk may take a second
        return live.walking(player, 0, kept)

    entry = await asyncio.get_running_loop().run_in_executor(live.walkers, walking)
    applied = await apply(ticker, lambda state, tick: state.with_player(replace(entry, since_tick=tick)))
    await keep(service, kept)
    name = entry.player.id
    response.headers["Location"] = f"/v1/players/{name}"
    return reply_to(applied, _whole(applied.state.player(name), applied.tick, ticker.rate_hz))


@router.get("/{id}", response_model=PlayerReply)
def player(ticker: TickerDep, name: IdInPath, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """One player: where it is, and what it was told to do."""
    state, tick = ticker.state, ticker.tick
    return {**_whole(state.player(name), tick, ticker.rate_hz), "tick": tick}


@router.delete("/{id}", response_model=GoneReply, dependencies=WRITE)
async def remove_player(service: ServiceDep, ticker: WritingTickerDep, name: IdInPath, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """One player less; its streams end."""
    applied = await apply_to(service, ticker, lambda state: state.player(name), lambda state: state.without_player(name), stays=False)
    return {"id": name, "tick": applied.tick}


def _whereabouts(entry: LivePlayer, tick: int, rate_hz: int) -> dict[str, Any]:
    pose = entry.walk.at(max(tick - entry.since_tick, 0) / rate_hz)
    return {
        "id": entry.player.id,
        "position": pose.position,
        "velocity": pose.velocity,
        "heading_degrees": pose.heading_degrees,
        "since_tick": entry.since_tick,
        "keep": entry.kept,
    }


def _whole(entry: LivePlayer, tick: int, rate_hz: int) -> dict[str, Any]:
    return {**entry.player.to_json(), **_whereabouts(entry, tick, rate_hz)}
