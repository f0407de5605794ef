"""The light of a moment, before any city is in its way."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from server.caching import Body, conditional, strong_etag
from server.dependencies import LightingQuery, ServiceDep, SkyQuery
from server.encoding import MEDIA_TYPE, REPLY_VERSION, npy
from server.exr import exr
from server.models import LightingReply
from server.openapi import NOT_CHANGED, reply

router = APIRouter(prefix="/v1", tags=["light"])


@router.get("/lighting", response_model=LightingReply)
def lighting(request: Request, service: ServiceDep, query: Annotated[LightingQuery, Query()]) -> Response:
    """Sun, moon, exposure, sky cube, snow and fog. With /v1/sky and the mesh, all that a path tracer needs to check us."""
    light = service.lighting(query.time, query.weather)
    etag = strong_etag("lighting", REPLY_VERSION, light.digest, light.time, light.weather)
    return conditional(request, etag, lambda: Body(LightingReply.of(light).model_dump_json().encode(), "application/json"))


EXR_MEDIA_TYPE = "image/x-exr"


@router.get("/sky", response_class=Response, responses=reply(MEDIA_TYPE["npy"], EXR_MEDIA_TYPE, headers=("ETag",), more=NOT_CHANGED))
def sky(request: Request, service: ServiceDep, query: Annotated[SkyQuery, Query()]) -> Response:
    """Sky radiance, float32 (64, 128, 3) in cd/m2 per channel, equirectangular, no sun disc, zero below the horizon.

    Row i, column j looks along (sin t cos p, cos t, sin t sin p), t = pi (i + 0.5) / 64, p = 2 pi (j + 0.5) / 128. `exr`: the same as an
    OpenEXR picture, channels R, G, B.
    """
    light = service.lighting(query.time, query.weather)
    etag = strong_etag("sky", REPLY_VERSION, light.digest, query.format)

    def compute() -> Body:
        if query.format == "exr":
            return Body(exr(light.sky_radiance), EXR_MEDIA_TYPE)
        return Body(npy(light.sky_radiance), MEDIA_TYPE["npy"])

    return conditional(request, etag, compute)
