"""What is served: bounds, sector grid, location, presets, dataset facts, limits."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from gi_core.basis import served_from
from gi_core.constants import MAX_CASCADE, MAX_PROBES_PER_SECTOR, ROOM_OUTDOORS, SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.dataset import Dataset, WorldInfo
from gi_core.errors import FormatError
from gi_core.weather import WEATHER_RANGES, weather_presets
from gi_core.world import Room
from server.caching import Body, conditional, strong_etag
from server.dependencies import MAX_DECAL_RADIUS_M, MAX_PREVIEW_WIDTH, MAX_PROBE_RADIUS_M, NoQuery, ServiceDep
from server.encoding import REPLY_VERSION
from server.live_state import MAX_BOXES, MAX_LAMPS
from server.models import BoundsReply, DoorReply, LimitsReply, LocationReply, OpeningReply, RoomReply, SectorGridReply, WorldReply, vector3
from server.player_streams import MAX_CLIENTS
from server.players import MAX_PLAYERS
from server.write_access import MAX_BODY_BYTES

router = APIRouter(prefix="/v1", tags=["dataset"])


@router.get("/world", response_model=WorldReply)
def world(request: Request, service: ServiceDep, _: Annotated[NoQuery, Query()]) -> Response:
    """What a client needs to know before it asks for light."""
    dataset = service.dataset
    etag = strong_etag("world", REPLY_VERSION, dataset.digest, dataset.distant_bytes, weather_presets())
    return conditional(request, etag, lambda: Body(world_reply(dataset).model_dump_json().encode(), "application/json"))


def world_reply(dataset: Dataset) -> WorldReply:
    """A dataset's facts as the contract names them."""
    info, place = dataset.world, dataset.world.location
    try:
        lights: list[str] = list(dataset.distant().lights)
    except FormatError:  # /v1/distant says what is wrong with it; all else can be served
        lights = []
    return WorldReply(
        name=info.name,
        bounds=BoundsReply(minimum=vector3(info.bounds[0]), maximum=vector3(info.bounds[1])),
        location=LocationReply(
            latitude_degrees=place.latitude_degrees,
            longitude_degrees=place.longitude_degrees,
            elevation_m=place.elevation_m,
            timezone=place.timezone,
            north_degrees=place.north_degrees,
            date=place.date.isoformat(),
            source=place.source,
        ),
        sectors=sector_grid(info),
        weather=list(weather_presets()),
        weather_overrides=dict(WEATHER_RANGES),
        time="HH:MM, or ISO 8601 local time with a date",
        voxel_size_m=VOXEL_SIZE_M,
        volume_shape=VOLUME_SHAPE,
        bases=list(served_from(info.basis)),
        kinds=["outdoor", "fog", *(["interior"] if info.rooms else [])],
        cascades=list(range(-1 if info.has_fine_voxels else 0, MAX_CASCADE + 1)),
        distant=lights,
        rooms=[room_reply(number, room) for number, room in enumerate(info.rooms, 1)],
        limits=LimitsReply(
            probe_radius_m=MAX_PROBE_RADIUS_M,
            decal_radius_m=MAX_DECAL_RADIUS_M,
            preview_width=MAX_PREVIEW_WIDTH,
            probes_per_sector=MAX_PROBES_PER_SECTOR,
            body_bytes=MAX_BODY_BYTES,
            players=MAX_PLAYERS,
            lights=MAX_LAMPS,
            boxes=MAX_BOXES,
            streams=MAX_CLIENTS,
        ),
        dataset={
            "digest": dataset.digest,
            "source": info.source,
            "preset": info.preset,
            "basis": info.basis,
            "sky": info.sky,
            "sky_patches": info.sky_patches,
            "settings": info.settings,
            "counts": info.counts,
            "distant_bytes": dataset.distant_bytes,
            "error_report": info.error_report,
        },
    )


def room_reply(number: int, room: Room) -> RoomReply:
    """A room, and where its air meets the open air and that of other rooms."""
    openings = [OpeningReply(minimum=each.minimum, maximum=each.maximum) for each in room.openings if each.to == ROOM_OUTDOORS]
    doors = [DoorReply(minimum=each.minimum, maximum=each.maximum, to=each.to) for each in room.openings if each.to != ROOM_OUTDOORS]
    return RoomReply(
        number=number,
        name=room.name,
        minimum=room.minimum,
        maximum=room.maximum,
        shape="box" if room.cells is None else "cells",
        found=room.is_found,
        openings=openings,
        doors=doors,
    )


def sector_grid(info: WorldInfo) -> SectorGridReply:
    """Extent of the sectors that were baked; there may be gaps."""
    xs, zs = [index.x for index in info.sectors], [index.z for index in info.sectors]
    return SectorGridReply(
        size_m=SECTOR_SIZE_M,
        count=len(xs),
        minimum=(min(xs), min(zs)) if xs else None,
        maximum=(max(xs), max(zs)) if xs else None,
    )
