"""Decals: still boxes that darken the ground, and the gradient that says how much."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from gi_core.decals import BELOW_M, REACH, decals_near, gradient_texels, world_from_box
from server import tonemap
from server.caching import Body, conditional, strong_etag
from server.dependencies import DecalsQuery, NoQuery, ServiceDep
from server.encoding import REPLY_VERSION
from server.models import DecalReply, DecalsReply, GradientReply

router = APIRouter(prefix="/v1", tags=["dataset"])
GRADIENT_HREF = "/v1/decals/gradient.png"


@router.get("/decals", response_model=DecalsReply)
def decals(request: Request, service: ServiceDep, query: Annotated[DecalsQuery, Query()]) -> Response:
    """The world's decals within `radius` of a point: boxes such as parked vehicles, which hide indirect light from the ground around.

    A point of the ground loses `f(x, width) f(z, length)` of its indirect light,
    `f(s, side) = max(0, g((|s| - side / 2) / h) - g((|s| + side / 2) / under))`: `x` and `z` in the box's own metres, `under` and `top`
    the heights of its underside (at least 0.01 m) and top above the point, `h` the `top` outside, `under` within, `g` the gradient. Beside
    the box `under` is `sqrt(under^2 + d^2)`, `d` how far the point is outside on the other axis. Times `n.y` where the ground leans; none
    on what is within the box. They stand still, and cast no shadow of the sun.
    """
    etag = strong_etag("decals", REPLY_VERSION, service.dataset.digest, query.model_dump())

    def compute() -> Body:
        found = decals_near(service.dataset.world.decals, (query.x, query.y, query.z), query.radius)
        shown = [
            DecalReply(
                name=decal.name,
                position=decal.position,
                size=decal.size,
                yaw_degrees=decal.yaw_degrees,
                world_from_box=world_from_box(decal).tolist(),
                distance=distance,
            )
            for distance, decal in found
        ]
        gradient = GradientReply(href=GRADIENT_HREF, low=-REACH, high=REACH, below_m=BELOW_M)
        return Body(DecalsReply(gradient=gradient, decals=shown).model_dump_json().encode(), "application/json")

    return conditional(request, etag, compute)


@router.get("/decals/gradient.png", response_class=Response, responses={200: {"content": {"image/png": {}}}})
def gradient(request: Request, _: Annotated[NoQuery, Query()]) -> Response:
    """The gradient: 256 x 1 texels, 8 bits, linear, from 1 deep under a box by 1/2 at its edge to 0."""
    texels = gradient_texels()
    return conditional(request, strong_etag("gradient", texels.tobytes()), lambda: Body(tonemap.png_file(texels[None]), "image/png"))
