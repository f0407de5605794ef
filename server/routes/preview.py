"""A rendered picture: a lighting bug is seen sooner than measured."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from gi_core.client_light import Look
from gi_core.errors import InputError
from gi_core.lighting import Lighting
from server import preview_views, tonemap
from server.caching import Body, conditional, strong_etag
from server.camera import Camera
from server.dependencies import PreviewQuery, ServiceDep, parse_vector
from server.encoding import REPLY_VERSION
from server.openapi import NOT_CHANGED, reply
from server.preview import city_radiance
from server.preview_error import error_picture
from server.service import Service

router = APIRouter(prefix="/v1", tags=["pictures"])


@router.get("/preview.png", response_class=Response, responses=reply("image/png", headers=("ETag",), more=NOT_CHANGED))
async def preview(request: Request, service: ServiceDep, query: Annotated[PreviewQuery, Query()]) -> Response:
    """The city at a time and in a weather, lit directly by sun, moon and lamps, indirectly by the volumes that /v1/volume serves.

    `gi=off`: direct light only; `split`: left off, right on; `error`: the indirect light's error against a path tracer in false colour
    (blue: too dark, red: too bright, by half and more), which takes some seconds.
    `distant`: beyond the volumes the texture of /v1/distant takes over (`on`), or not (`off`: the nearest volume's edge). A picture takes
    as many volumes as its pixels need, up to 128; `client` shows what one has who holds only the volume around the eye, `cascades` who
    holds three coarser ones around that, up to 800 m wide, each fading into the next. Of the texture `distant_light=sky` takes the sky's
    light alone, as in the talk, `full` all of it; left out it is the best that was baked.
    `interior=off` lights rooms by the outdoor volume, as one sees them who never asks for `kind=interior`.

    `ao=on` dims indirect light by what stands within 3 m, which a volume's voxels cannot see. Against the path tracer it mends corners;
    where the volumes are too dark already, as under an overcast sky, it makes them darker. The decals of `/v1/decals` dim it besides.

    `view`, instead of the light: `albedo`, `normal`, `snow` (how much would stay), `sun` (what it reaches) of surfaces, and the same as
    `surfel_albedo`, `surfel_normal`, `surfel_snow`, `surfel_sun` (the share that baked directions give) of the surfels that stand for them
    in the eye's sector and those around it; `sectors`, and their `residency` in the live world; `voxels` (the class of the one in front of
    each surface); `probes` within 60 m of the eye as spheres that show their light, or the colours of their `rooms`.
    """
    async with service.preview_thread():
        if await request.is_disconnected():  # a picture takes seconds: not for nobody
            raise InputError("preview: expected a client that waits for its turn, found one that went away")
        return await run_in_threadpool(_reply, request, service, query)


def _reply(request: Request, service: Service, query: PreviewQuery) -> Response:
    light = service.lighting(query.time, query.weather)
    # The far view gets better when the same bake is run again, and nothing else of the dataset changes.
    identity = service.light_identity, service.dataset.distant_bytes
    if query.view == "residency":  # of this moment
        return Response(picture(service, query, light), media_type="image/png", headers={"Cache-Control": "no-store"})
    etag = strong_etag("preview", REPLY_VERSION, *identity, light.digest, query.model_dump(exclude={"time", "weather"}))
    return conditional(request, etag, lambda: Body(picture(service, query, light), "image/png"))


def picture(service: Service, query: PreviewQuery, light: Lighting) -> bytes:
    """The PNG that a query asks for."""
    camera = Camera(parse_vector(query.eye), parse_vector(query.look), query.fov, query.width)
    look = Look("on" if query.gi == "error" else query.gi, query.distant, query.ao == "on", query.interior == "on", query.distant_light)
    with service.preview_turn():
        if query.view != "lit":
            scene = service.preview_scenes.around(camera.eye, camera.look)
            residency = service.live.residency() if query.view == "residency" else {}
            return tonemap.png_file(preview_views.draw(query.view, service.engine, scene, camera, light, residency))
        if query.gi == "error":
            return tonemap.png_file(error_picture(service, camera, light, look))
        scene = service.preview_scenes.around(camera.eye, camera.look)
        radiance = city_radiance(service.engine, scene, camera, light, look)
    return tonemap.png(radiance, light.exposure)
