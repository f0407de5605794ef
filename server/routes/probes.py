"""Probes around a point, for debugging and tests."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from gi_core.engine import LitProbes
from gi_core.lighting import Lighting
from server.caching import Body, conditional, strong_etag
from server.dependencies import ProbesQuery, ServiceDep
from server.encoding import REPLY_VERSION
from server.models import ProbeReply, ProbesReply, vector3
from server.server_timing import Laps

router = APIRouter(prefix="/v1", tags=["light"])


@router.get("/probes", response_model=ProbesReply)
def probes(request: Request, service: ServiceDep, query: Annotated[ProbesQuery, Query()]) -> Response:
    """Positions, cubes, rooms and flags of the probes within `radius` of a point."""
    laps = Laps()
    with laps.lap("light"):
        light = service.lighting(query.time, query.weather)
    etag = strong_etag("probes", REPLY_VERSION, service.light_identity, light.digest, query.model_dump())

    def compute() -> Body:
        with laps.lap("relight"):
            found = service.engine.probes(query.position, query.radius, light)
        with laps.lap("encode"):
            return _body(found, light)

    return conditional(request, etag, compute, laps=laps)


def _body(found: LitProbes, light: Lighting) -> Body:
    shown = [
        ProbeReply(
            sector=(sector.x, sector.z),
            position=vector3(position),
            cube=[vector3(face) for face in cube],
            room=int(room),
            flags=int(flags),
        )
        for sector, position, cube, room, flags in zip(found.sectors, found.position, found.cubes, found.room, found.flags, strict=True)
    ]
    reply = ProbesReply(time=light.time, weather=light.weather, probes=shown)
    return Body(reply.model_dump_json().encode(), "application/json")
