"""How routes get at the live world: the first of them starts it. Reads are told to come back while it warms up, writes wait.

A world that was built before is warm in a second or two; kernels that are new to a machine take half a minute, of which writes
wait WRITES_WAIT_S before they too are told to come back.
"""

import asyncio
from collections.abc import Callable
from typing import Annotated, Any, Protocol

from fastapi import Depends

from server.dependencies import ServiceDep
from server.json_input import Members
from server.live_state import Applied, Command, LiveState, LiveUnavailableError, Part
from server.service import Service
from server.ticker import Ticker

WRITES_WAIT_S = 25.0
_LOOK_AGAIN_S = 0.02


async def running_ticker(service: Service, wait_s: float) -> Ticker:
    """The ticker, once it ticks. Raises LiveUnavailableError when it does not within some seconds, or never will."""
    live = service.live
    # Making the world opens a device, which takes a while.
    ticker = live.ticker if live.is_started else await asyncio.to_thread(lambda: live.ticker)
    give_up_at = asyncio.get_running_loop().time() + wait_s
    while not ticker.is_running:
        if ticker.is_stopped:
            raise LiveUnavailableError(f"the live world cannot run: {ticker.failure or 'the server is stopping'}")
        if asyncio.get_running_loop().time() >= give_up_at:
            raise LiveUnavailableError("the live world is starting; ask again in a moment")
        await asyncio.sleep(_LOOK_AGAIN_S)
    service.ticks.follow(ticker)
    return ticker


async def _for_reading(service: ServiceDep) -> Ticker:
    return await running_ticker(service, 0.0)


async def _for_writing(service: ServiceDep) -> Ticker:
    return await running_ticker(service, WRITES_WAIT_S)


TickerDep = Annotated[Ticker, Depends(_for_reading)]
WritingTickerDep = Annotated[Ticker, Depends(_for_writing)]


# From what a request says to the command that does it. Raises InputError.
Change = Callable[[dict[str, Any]], Command]
KEEP = "true: written to the server's --state file, and back after a restart"


class Kept(Protocol):
    """A player, a light, a box: whether it is back after a restart."""

    @property
    def kept(self) -> bool: ...


async def apply(ticker: Ticker, command: Command) -> Applied:
    """Have a command applied between two ticks. Raises what the command raises."""
    return await asyncio.wrap_future(ticker.apply(command))


async def keep(service: Service, is_concerned: bool) -> None:
    """Write the state file when something in it has changed."""
    if is_concerned:
        await asyncio.to_thread(service.live.keep)


async def apply_to_part(service: Service, ticker: Ticker, part: Part, body: dict[str, Any], change: Change) -> Applied:
    """Have what a body says of clock, weather or settings applied, and write the state file where that was kept or is from now on.

    ``change`` gets the body without its ``keep``, which may be all that it says. Raises as ``apply`` does, and InputError."""
    rest = {name: value for name, value in body.items() if name != "keep"}
    keep_it = Members(body, part, body).flag("keep", False) if "keep" in body else None
    if keep_it:
        service.live.kept.expect_possible()
    command = change(rest) if rest or keep_it is None else None
    was_kept = False

    def noted(state: LiveState, tick: int) -> LiveState:
        nonlocal was_kept
        was_kept = part in state.kept
        after = state if command is None else command(state, tick)
        return after.keeping(part, was_kept if keep_it is None else keep_it)

    applied = await apply(ticker, noted)
    await keep(service, was_kept or part in applied.state.kept)
    return applied


async def apply_to(
    service: Service, ticker: Ticker, find: Callable[[LiveState], Kept], command: Callable[[LiveState], LiveState], *, stays: bool
) -> Applied:
    """``apply`` a command to what ``find`` finds, and write the state file where that was kept or, if it ``stays``, is from now on."""
    was_kept = False

    def noted(state: LiveState, _: int) -> LiveState:
        nonlocal was_kept
        was_kept = find(state).kept
        return command(state)

    applied = await apply(ticker, noted)
    await keep(service, was_kept or (stays and find(applied.state).kept))
    return applied


def reply_to(applied: Applied, record: dict[str, Any]) -> dict[str, Any]:
    """A write's reply: what there is now, and since which tick."""
    return {**record, "tick": applied.tick}
