"""The live world's weather."""

from typing import Annotated, Any

from fastapi import APIRouter, Query

from gi_core.weather import WEATHER_RANGES
from server.dependencies import NoQuery, ServiceDep
from server.live_access import KEEP, TickerDep, WritingTickerDep, apply_to_part
from server.live_models import WeatherReply
from server.live_state import Command, LiveState
from server.live_weather import blended, weather_from_json
from server.write_access import WRITE, JsonBody, body_schema

router = APIRouter(prefix="/v1/weather", tags=["live world"])
_BODY = body_schema(
    {"weather": "fog:0.5", "blend_s": 600},
    {
        "weather": "a preset that /v1/world lists, or one with overrides; this, or one of the next two",
        "script_seed": "a whole number: weather that changes by itself, the same for a seed",
        "measured": "true: the year of the server's --epw file",
        "blend_s": "over how many seconds of the world's time the present weather turns into it, 0..86400; 0 changes it at once",
        "keep": KEEP,
    },
)


@router.get("", response_model=WeatherReply)
def weather(ticker: TickerDep, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """What PUT was told last, and the weather of the present tick in numbers."""
    state, tick = ticker.state, ticker.tick
    return _reply(state, max(tick, state.clock.start_tick))


@router.put("", response_model=WeatherReply, dependencies=WRITE, openapi_extra=_BODY)
async def change_weather(body: JsonBody, service: ServiceDep, ticker: WritingTickerDep, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """Another weather, at once or little by little, from the tick that the reply names."""

    def change(rest: dict[str, Any]) -> Command:
        after, blend_s = weather_from_json(rest, service.dataset.world.location, service.live.measured)

        def command(state: LiveState, tick: int) -> LiveState:
            since = state.clock.moment_at(tick)
            return state.with_weather(blended(state.weather, after, since, blend_s), is_jump=blend_s == 0)

        return command

    applied = await apply_to_part(service, ticker, "weather", body, change)
    return _reply(applied.state, applied.tick)


def _reply(state: LiveState, tick: int) -> dict[str, Any]:
    now = state.weather.at(state.clock.moment_at(tick))
    numbers = {name: float(getattr(now, name)) for name in WEATHER_RANGES}
    return {"asked": dict(state.weather.description), "now": {"text": now.text, **numbers}, "keep": "weather" in state.kept, "tick": tick}
