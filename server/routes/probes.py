"""Probes around a point, for debugging and tests."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from server.caching import Body, conditional, strong_etag
from server.dependencies import ProbesQuery, ServiceDep
from server.encoding import REPLY_VERSION
from server.models import ProbeReply, ProbesReply, vector3

router = APIRouter(prefix="/v1", tags=["light"])


@router.get("/probes", response_model=ProbesReply)
def probes(request: Request, service: ServiceDep, query: Annotated[ProbesQuery, Query()]) -> Response:
    """Positions, cubes, rooms and flags of the probes within `radius` of a point."""
    light = service.lighting(query.time, query.weather)
    etag = strong_etag("probes", REPLY_VERSION, service.dataset.digest, light.digest, query.model_dump())

    def compute() -> Body:
        with service.engine_turn() as engine:
            found = engine.probes(query.position, query.radius, light)
        shown = [
            ProbeReply(
                sector=(probe.sector.x, probe.sector.z),
                position=vector3(probe.position),
                cube=[vector3(face) for face in probe.cube],
                room=int(probe.room),
                flags=int(probe.flags),
            )
            for probe in found
        ]
        reply = ProbesReply(time=light.time, weather=light.weather, probes=shown)
        return Body(reply.model_dump_json().encode(), "application/json")

    return conditional(request, etag, compute)
