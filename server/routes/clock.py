"""The live world's clock."""

from typing import Annotated, Any

from fastapi import APIRouter, Query

from server.dependencies import NoQuery, ServiceDep
from server.live_access import KEEP, TickerDep, WritingTickerDep, apply_to_part
from server.live_models import ClockReply
from server.live_state import Command, LiveState
from server.world_clock import changed_clock, clock_to_json
from server.write_access import WRITE, JsonBody, body_schema

router = APIRouter(prefix="/v1/clock", tags=["live world"])
_BODY = body_schema(
    {"time": "21:30", "rate": 60},
    {
        "time": "jumps to `13:00` of the day that the clock shows, or to ISO 8601 with a date",
        "rate": "world seconds per second, 0..3600",
        "paused": "true stops it, false goes on at the same rate",
        "keep": f"{KEEP}, where it shows what it was set to last",
    },
)


@router.get("", response_model=ClockReply)
def clock(ticker: TickerDep, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """What the live world's clock shows, and how fast it runs."""
    state, tick = ticker.state, ticker.tick
    return _reply(state, max(tick, state.clock.start_tick))


@router.put("", response_model=ClockReply, dependencies=WRITE, openapi_extra=_BODY)
async def change_clock(body: JsonBody, service: ServiceDep, ticker: WritingTickerDep, _: Annotated[NoQuery, Query()]) -> dict[str, Any]:
    """Set time, rate or pause, all together from the tick that the reply names."""
    location = service.dataset.world.location

    def change(rest: dict[str, Any]) -> Command:
        def command(state: LiveState, tick: int) -> LiveState:
            return state.with_clock(changed_clock(state.clock, tick, rest, location), is_jump="time" in rest)

        return command

    applied = await apply_to_part(service, ticker, "clock", body, change)
    return _reply(applied.state, applied.tick)


def _reply(state: LiveState, tick: int) -> dict[str, Any]:
    return {**clock_to_json(state.clock, tick), "keep": "clock" in state.kept}
