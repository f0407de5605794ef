"""A rendered picture: a lighting bug is seen sooner than measured."""

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query, Request, Response

from gi_core.arrays import Float64
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.volume import Volume
from server import tonemap
from server.caching import Body, conditional, strong_etag
from server.camera import Camera
from server.dependencies import PreviewQuery, ServiceDep, parse_vector
from server.encoding import REPLY_VERSION
from server.preview import render
from server.service import Service

router = APIRouter(prefix="/v1", tags=["pictures"])


@router.get("/preview.png", response_class=Response, responses={200: {"content": {"image/png": {}}}})
def preview(request: Request, service: ServiceDep, query: Annotated[PreviewQuery, Query()]) -> Response:
    """The city at a time and in a weather, lit directly by sun, moon and lamps, indirectly by the volumes that /v1/volume serves."""
    light = service.lighting(query.time, query.weather)
    etag = strong_etag("preview", REPLY_VERSION, service.light_identity, light.digest, query.model_dump(exclude={"time", "weather"}))
    return conditional(request, etag, lambda: Body(picture(service, query, light), "image/png"))


def picture(service: Service, query: PreviewQuery, light: Lighting) -> bytes:
    """The PNG that a query asks for."""
    camera = Camera(parse_vector(query.eye), parse_vector(query.look), query.fov, query.width)
    bounds = service.dataset.world.bounds

    def volume_at(position: Float64) -> Volume:
        # A tile's centre may lie beyond the world's edge though its pixels do not.
        return service.engine.volume(np.clip(position, bounds[0], bounds[1]), light)

    with service.preview_turn():
        scene = service.preview_scenes.around(camera.eye, camera.look)
        radiance = render(camera, scene, light, lamps_on(service.engine.lamps, light), volume_at, query.gi)
    return tonemap.png(radiance, light.exposure)
