"""Whose turn it is to get a first frame: a whole volume, which takes some milliseconds to encode, where most ticks have nothing to encode.

When fifty streams open at once, those fifty frames would take both encoders and half of Python's lock from several ticks on end. So each
tick lets one of them begin, in the order in which they came: ticks keep their time, and so do the streams that are there already.
"""

import asyncio
from collections import deque

from server.tick_signal import TickSignal

FIRST_FRAMES_PER_TICK = 1


class FirstFrames:
    """Turns of all streams of a server. On the event loop alone."""

    def __init__(self, ticks: TickSignal) -> None:
        self._ticks = ticks
        self._tick = -1
        self._left = 0
        self._waiting: deque[asyncio.Future[None]] = deque()
        self._giving: asyncio.Task[None] | None = None

    async def turn(self) -> None:
        """Returns at once while a tick has turns left and nobody waits, else when all who came before have had theirs, or have gone."""
        self._note(self._ticks.latest.tick)
        if self._left and not self._waiting:
            self._left -= 1
            return
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append(turn)
        if self._giving is None or self._giving.done():
            self._giving = asyncio.create_task(self._give())
        await turn

    async def _give(self) -> None:
        while self._waiting:
            self._note((await self._ticks.after(self._tick)).tick)
            while self._left and self._waiting:
                turn = self._waiting.popleft()
                if not turn.done():  # else it was cancelled: the client has gone
                    turn.set_result(None)
                    self._left -= 1

    def _note(self, tick: int) -> None:
        if tick != self._tick:
            self._tick, self._left = tick, FIRST_FRAMES_PER_TICK
