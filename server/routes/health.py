"""Whether the process lives, and whether it can answer."""

from typing import Annotated

from fastapi import APIRouter, Query

from server.dependencies import NoQuery, ServiceDep
from server.models import HealthReply, ReadyReply, RefusedSector

router = APIRouter(tags=["operations"])


@router.get("/healthz")
async def healthz(_: Annotated[NoQuery, Query()]) -> HealthReply:
    """The process answers. Asks nothing of the engine, so it stays quick under load."""
    return HealthReply(status="alive")


@router.get("/readyz")
async def readyz(service: ServiceDep, _: Annotated[NoQuery, Query()]) -> ReadyReply:
    """Queries are answered. Sectors whose files were refused are named; all others keep working."""
    refused = [RefusedSector(sector=(i.x, i.z), reason=service.public(why)) for i, why in sorted(service.failed_sectors.items())]
    return ReadyReply(
        status="degraded" if refused else "ready",
        device=service.engine.device_name,
        dataset=service.dataset.digest,
        refused_sectors=refused,
    )
