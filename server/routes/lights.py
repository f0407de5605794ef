"""The live world's lamps: those of the dataset, and those that requests add. No bake is needed for any."""

import secrets
from dataclasses import replace
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import JSONResponse

from gi_core.lights import (
    MAX_CONE_DEGREES,
    MAX_LUMENS,
    MAX_RANGE_M,
    MAX_SIZE_M,
    MAX_TEMPERATURE_K,
    MIN_CONE_DEGREES,
    MIN_RANGE_M,
    MIN_SIZE_M,
    MIN_TEMPERATURE_K,
)
from server.dependencies import NoQuery, ServiceDep
from server.lamps_json import lamp_changed, lamp_from_json, lamp_to_json
from server.live_access import KEEP, TickerDep, WritingTickerDep, apply, apply_to, keep, reply_to
from server.live_models import GoneReply, LightReply, LightsReply
from server.write_access import WRITE, JsonBody, body_schema

router = APIRouter(prefix="/v1/lights", tags=["live world"])
IdInPath = Annotated[str, Path(alias="id", max_length=256, description="as /v1/lights lists them")]
_MEMBERS = {
    "kind": "`point`, `spot` or `area`",
    "position": "[x, y, z], world metres",
    "lumens": f"luminous flux [lm], 0..{MAX_LUMENS:g}",
    "color": "[r, g, b], linear; changes the colour, not how much light there is",
    "temperature_k": f"colour temperature, in place of color, {MIN_TEMPERATURE_K:g}..{MAX_TEMPERATURE_K:g}",
    "range_m": f"beyond it the lamp gives nothing [m], {MIN_RANGE_M:g}..{MAX_RANGE_M:g}",
    "direction": "[x, y, z], of spots and areas; of any length but 0",
    "cone_degrees": f"full angle of a spot, {MIN_CONE_DEGREES:g}..{MAX_CONE_DEGREES:g}",
    "size": f"[width, height] of an area [m], {MIN_SIZE_M:g}..{MAX_SIZE_M:g}",
    "schedule": "`always`, `night`, or local times as in `18:00-23:30`",
    "dynamic": "true for a lamp that moves all the time: it is worked out apart from those that stand still",
    "keep": KEEP,
}
_NEW = body_schema(
    {"kind": "point", "position": [40, 4, 60], "lumens": 8000, "temperature_k": 2700},
    {"id": "1 to 64 letters, digits, - or _; made up when there is none", **_MEMBERS},
    ("kind", "position", "lumens"),
)


@router.get("", response_model=LightsReply)
def lights(ticker: TickerDep, _: Annotated[NoQuery, Query()]) -> Response:
    """All lamps, those of the dataset included."""
    state, tick = ticker.state, ticker.tick
    return JSONResponse({"lights": [lamp_to_json(lamp) for lamp in state.lamps.values()], "tick": tick})


@router.post("", response_model=LightReply, status_code=201, dependencies=WRITE, openapi_extra=_NEW)
async def add_light(
    body: JsonBody, service: ServiceDep, ticker: WritingTickerDep, response: Response, _: Annotated[NoQuery, Query()]
) -> dict[str, Any]:
    """Another lamp."""
    lamp = lamp_from_json(body, "light", new_id="new")
    if "id" not in body:  # made up last, so that the same mistake is always refused in the same words
        name = f"light-{secrets.token_hex(4)}"
        lamp = replace(lamp, id=name, lamp=replace(lamp.lamp, name=name))
    if lamp.kept:
        service.live.kept.expect_possible()
    applied = await apply(ticker, lambda state, _: state.with_lamp(lamp, new=True))
    await keep(service, lamp.kept)
    response.headers["Location"] = f"/v1/lights/{lamp.id}"
    return reply_to(applied, lamp_to_json(lamp))


@router.get("/{id}", response_model=LightReply)
def light(ticker: TickerDep, name: IdInPath, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """One lamp."""
    state, tick = ticker.state, ticker.tick
    return {**lamp_to_json(state.lamp(name)), "tick": tick}


@router.patch("/{id}", response_model=LightReply, dependencies=WRITE, openapi_extra=body_schema({"position": [42, 4, 60]}, _MEMBERS))
async def change_light(
    name: IdInPath, body: JsonBody, service: ServiceDep, ticker: WritingTickerDep, _: Annotated[NoQuery, Query()]
) -> dict[str, Any]:
    """Move a lamp, or change anything else of it; what the body does not name stays."""
    if body.get("keep") is True:
        service.live.kept.expect_possible()
    applied = await apply_to(
        service,
        ticker,
        lambda state: state.lamp(name),
        lambda state: state.with_lamp(lamp_changed(state.lamp(name), body, "light"), new=False),
        stays=True,
    )
    return reply_to(applied, lamp_to_json(applied.state.lamp(name)))


@router.delete("/{id}", response_model=GoneReply, dependencies=WRITE)
async def remove_light(service: ServiceDep, ticker: WritingTickerDep, name: IdInPath, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """One lamp less. A lamp of the dataset is back after a restart."""
    applied = await apply_to(service, ticker, lambda state: state.lamp(name), lambda state: state.without_lamp(name), stays=False)
    return {"id": name, "tick": applied.tick}
