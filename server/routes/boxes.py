"""The live world's moving boxes, vehicles and doors: they shade the sun, and are seen by nothing else."""

import secrets
from dataclasses import replace
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import JSONResponse

from server.boxes_json import box_changed, box_from_json, box_to_json
from server.dependencies import NoQuery, ServiceDep
from server.live_access import KEEP, TickerDep, WritingTickerDep, apply, apply_to, keep, reply_to
from server.live_models import BoxesReply, BoxReply, GoneReply
from server.write_access import WRITE, JsonBody, body_schema

router = APIRouter(prefix="/v1/boxes", tags=["live world"])
IdInPath = Annotated[str, Path(alias="id", max_length=256, description="as /v1/boxes lists them")]
_MEMBERS = {
    "position": "[x, y, z] of its middle, world metres",
    "half_size": "[x, y, z], half of its extent along its own axes [m], 0.01..100",
    "turned_degrees": "about the vertical, from +X towards -Z, -360..360",
    "keep": KEEP,
}
_NEW = body_schema(
    {"id": "bus", "position": [40, 1.6, 60], "half_size": [6, 1.6, 1.3], "turned_degrees": 90},
    {"id": "1 to 64 letters, digits, - or _; made up when there is none", **_MEMBERS},
    ("position", "half_size"),
)


@router.get("", response_model=BoxesReply)
def boxes(ticker: TickerDep, _: Annotated[NoQuery, Query()]) -> Response:
    """All boxes."""
    state, tick = ticker.state, ticker.tick
    return JSONResponse({"boxes": [box_to_json(box) for box in state.boxes.values()], "tick": tick})


@router.post("", response_model=BoxReply, status_code=201, dependencies=WRITE, openapi_extra=_NEW)
async def add_box(
    body: JsonBody, service: ServiceDep, ticker: WritingTickerDep, response: Response, _: Annotated[NoQuery, Query()]
) -> dict[str, Any]:
    """Another box. Its shadow comes with the next map of the sun's, some ticks later."""
    box = box_from_json(body, "box", new_id="new")
    if "id" not in body:  # made up last, so that the same mistake is always refused in the same words
        box = replace(box, id=f"box-{secrets.token_hex(4)}")
    if box.kept:
        service.live.kept.expect_possible()
    applied = await apply(ticker, lambda state, _: state.with_box(box, new=True))
    await keep(service, box.kept)
    response.headers["Location"] = f"/v1/boxes/{box.id}"
    return reply_to(applied, box_to_json(box))


@router.get("/{id}", response_model=BoxReply)
def box(ticker: TickerDep, name: IdInPath, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """One box."""
    state, tick = ticker.state, ticker.tick
    return {**box_to_json(state.box(name)), "tick": tick}


@router.patch("/{id}", response_model=BoxReply, dependencies=WRITE, openapi_extra=body_schema({"position": [42, 1.6, 60]}, _MEMBERS))
async def change_box(
    name: IdInPath, body: JsonBody, service: ServiceDep, ticker: WritingTickerDep, _: Annotated[NoQuery, Query()]
) -> dict[str, Any]:
    """Move a box, turn it, or change anything else of it; what the body does not name stays."""
    if body.get("keep") is True:
        service.live.kept.expect_possible()
    applied = await apply_to(
        service,
        ticker,
        lambda state: state.box(name),
        lambda state: state.with_box(box_changed(state.box(name), body, "box"), new=False),
        stays=True,
    )
    return reply_to(applied, box_to_json(applied.state.box(name)))


@router.delete("/{id}", response_model=GoneReply, dependencies=WRITE)
async def remove_box(service: ServiceDep, ticker: WritingTickerDep, name: IdInPath, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """One box less."""
    applied = await apply_to(service, ticker, lambda state: state.box(name), lambda state: state.without_box(name), stays=False)
    return {"id": name, "tick": applied.tick}
