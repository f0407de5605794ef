"""The live world's artistic settings."""

from dataclasses import asdict
from typing import Annotated, Any

from fastapi import APIRouter, Query

from gi_core.settings import MAX_AMBIENT_LX, MAX_FACTOR
from server.dependencies import NoQuery, ServiceDep
from server.live_access import KEEP, TickerDep, WritingTickerDep, apply_to_part
from server.live_models import SettingsReply
from server.live_state import Command, LiveState
from server.settings_json import changed_settings
from server.write_access import WRITE, JsonBody, body_schema

router = APIRouter(prefix="/v1/settings", tags=["live world"])
_FACTOR, _COLOR = f"a gain, 0..{MAX_FACTOR:g}, neutral 1", f"[r, g, b], 0..{MAX_AMBIENT_LX:g}, neutral 0"
_BODY = body_schema(
    {"bounce_factor": 1.5, "sky_boost": [100, 100, 120]},
    {
        "bounce_factor": f"light that has met two surfaces or more: {_FACTOR}",
        "sky_factor": f"the sky's light: {_FACTOR}",
        "sun_factor": f"sun and moon: {_FACTOR}",
        "lights_factor": f"lamps: {_FACTOR}",
        "sky_boost": f"radiance added to the sky [cd/m2]: {_COLOR}",
        "ambient_factor": f"both ambient colours: {_FACTOR}",
        "ambient_up": f"irradiance added to faces that look up [lx]: {_COLOR}",
        "ambient_down": f"irradiance added to faces that look down [lx]: {_COLOR}",
        "exterior_ambient_scale": f"ambient colours outdoors: {_FACTOR}",
        "interior_ambient_scale": f"ambient colours in rooms: {_FACTOR}",
        "keep": KEEP,
    },
)


@router.get("", response_model=SettingsReply)
def settings(ticker: TickerDep, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """The artists' panel as it is."""
    state, tick = ticker.state, ticker.tick
    return _reply(state, tick)


@router.put("", response_model=SettingsReply, dependencies=WRITE, openapi_extra=_BODY)
async def change_settings(body: JsonBody, service: ServiceDep, ticker: WritingTickerDep, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """Change some settings; those that the body does not name stay."""

    def change(rest: dict[str, Any]) -> Command:
        return lambda state, _: state.with_settings(changed_settings(state.settings, rest))

    applied = await apply_to_part(service, ticker, "settings", body, change)
    return _reply(applied.state, applied.tick)


def _reply(state: LiveState, tick: int) -> dict[str, Any]:
    return {**asdict(state.settings), "keep": "settings" in state.kept, "tick": tick}
