"""The baked files themselves, for clients that relight on their own."""

import hashlib
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response

from gi_core.constants import SECTOR_SIZE_M
from gi_core.errors import CorruptFileError, SectorMissingError
from gi_core.grid import SectorIndex
from server.caching import FILE_CACHE_CONTROL, Body, conditional, strong_etag
from server.dependencies import NoQuery, ServiceDep
from server.encoding import REPLY_VERSION
from server.finished_replies import names
from server.models import SectorReply, SectorsReply
from server.openapi import NOT_CHANGED, reply
from server.ranges import file_reply
from server.service import Service

router = APIRouter(prefix="/v1/sectors", tags=["dataset"])
SectorNumber = Annotated[int, Path(description="of the sector that covers [64 n, 64 n + 64) m in this direction")]
_FILE = reply(
    "application/octet-stream",
    headers=("ETag",),
    more={
        206: {"description": "what `Range: bytes=...` asks for", **reply("application/octet-stream", headers=("Content-Range",))[200]},
        **NOT_CHANGED,
    },
)


@router.get("", response_model=SectorsReply)
def sectors(request: Request, service: ServiceDep, _: Annotated[NoQuery, Query()]) -> Response:
    """Every sector that was baked."""

    def compute() -> Body:
        index = [
            SectorReply(sector=(i.x, i.z), bytes=facts.bytes, digest=facts.digest, probes=facts.probes, href=f"/v1/sectors/{i.x},{i.z}")
            for i, facts in sorted(service.dataset.world.sectors.items())
        ]
        return Body(SectorsReply(size_m=SECTOR_SIZE_M, sectors=index).model_dump_json().encode(), "application/json")

    return conditional(request, strong_etag("sectors", REPLY_VERSION, service.dataset.digest), compute)


@router.get("/{x},{z}", response_class=Response, responses=_FILE)
def sector_file(request: Request, service: ServiceDep, x: SectorNumber, z: SectorNumber, _: Annotated[NoQuery, Query()]) -> Response:
    """One baked sector file: byte ranges, immutable under its ETag."""
    index = SectorIndex(x, z)
    facts = service.dataset.world.sectors.get(index)
    if facts is None:
        raise SectorMissingError(f"sector {x},{z}: expected one that /v1/sectors lists, found none")
    etag = f'"{facts.digest}"'
    if names(request.headers, etag, is_there=True):
        return Response(status_code=304, headers={"ETag": etag, "Cache-Control": FILE_CACHE_CONTROL})
    return file_reply(request, read_checked(service, index, facts.bytes, facts.digest), etag, FILE_CACHE_CONTROL)


def read_checked(service: Service, index: SectorIndex, size: int, digest: str) -> bytes:
    """A sector file's bytes; CorruptFileError unless they are those that the dataset's index promises."""
    path = service.dataset.sector_path(index)
    try:
        with path.open("rb") as file:
            content = file.read(size + 1)
    except OSError as error:
        raise CorruptFileError(f"{path}: expected {size} bytes, found {error.strerror}; bake it again") from error
    if len(content) != size or hashlib.blake2b(content, digest_size=16).hexdigest() != digest:
        raise CorruptFileError(f"{path}: expected {size} bytes with digest {digest}, found others; bake it again")
    return content
