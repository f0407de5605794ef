"""The texture of distant sector probes."""

from typing import Annotated, get_args

from fastapi import APIRouter, Query, Request, Response

from gi_core.constants import SECTOR_SIZE_M
from gi_core.engine import Distant
from server.caching import Body, conditional, strong_etag
from server.dependencies import DistantQuery, ServiceDep
from server.encoding import MEDIA_TYPE, REPLY_VERSION, ArrayFormat, half_scale, half_texels, header_json, npy
from server.openapi import NOT_CHANGED, reply
from server.server_timing import Laps

router = APIRouter(prefix="/v1", tags=["light"])


@router.get(
    "/distant",
    response_class=Response,
    responses=reply(*(MEDIA_TYPE[name] for name in get_args(ArrayFormat)), headers=("Gi-Distant", "ETag"), more=NOT_CHANGED),
)
def distant(request: Request, service: ServiceDep, query: Annotated[DistantQuery, Query()]) -> Response:
    """Irradiance [lx] of one cube per sector, float32 (rows, cols, 6, 3); texel (0, 0) at the sector grid's north-west corner.

    Rows go south (+Z), columns east (+X). `raw`: little-endian halves (rows, cols, 6, 4); lux = rgb x scale; alpha is 0 where no
    sector was baked. `Gi-Distant` has the origin, and which light it is.
    """
    laps = Laps()
    with laps.lap("light"):
        light = service.lighting(query.time, query.weather)
    kind = query.light or service.dataset.distant().lights[-1]
    etag = strong_etag("distant", REPLY_VERSION, service.dataset.digest, light.digest, kind, query.format, query.encoding)

    def compute() -> Body:
        with laps.lap("relight"):
            found = service.engine.distant(light, kind)
        with laps.lap("encode"):
            return distant_body(found, query)

    return conditional(request, etag, compute, laps=laps)


def distant_body(found: Distant, query: DistantQuery) -> Body:
    """The texture in the format that was asked for, with its place in the world."""
    values, origin = found.values, found.origin
    scale = 1.0 if query.format == "npy" else half_scale(values)
    content = npy(values) if query.format == "npy" else half_texels(values, scale, found.valid[..., None])
    facts = {
        "origin_sector": [origin.x, origin.z],
        "origin": [float(v) for v in origin.origin],
        "sector_size": SECTOR_SIZE_M,
        "shape": list(values.shape) if query.format == "npy" else [*values.shape[:-1], 4],
        "dtype": "float32" if query.format == "npy" else "float16",
        "basis": "cube",
        "light": found.light,
        "unit": "lx",
        "scale": scale,
    }
    return Body(content, MEDIA_TYPE[query.format], {"Gi-Distant": header_json(facts)})
