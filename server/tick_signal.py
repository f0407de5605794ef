"""Ticks, as the event loop hears of them: one notification for all who wait, however many."""

import asyncio
import time
from typing import NamedTuple

from gi_core.live_world import TickReport
from server.ticker import Ticker


class Published(NamedTuple):
    """A tick that is done, and when it was [microseconds since 1970, UTC]."""

    tick: int
    time_us: int


class TickSignal:
    """Told by the ticker's thread, asked on one event loop."""

    def __init__(self) -> None:
        self.latest = Published(-1, 0)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._event = asyncio.Event()
        self._waiting = 0
        self._is_waking = False

    def follow(self, ticker: Ticker) -> None:
        """Hear of a ticker's ticks, on the loop that runs now; nothing when it does so already."""
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
            ticker.listeners.append(self._tell)

    async def after(self, tick: int) -> Published:
        """The latest tick, once it is later than ``tick``."""
        # Announced before looking, so that a tick between the two is not slept through.
        self._waiting += 1
        try:
            while self.latest.tick <= tick:
                await self._event.wait()
        finally:
            self._waiting -= 1
        return self.latest

    def _tell(self, report: TickReport) -> None:
        """In the ticker's thread."""
        self.latest = Published(report.tick, time.time_ns() // 1000)
        if self._waiting and not self._is_waking and self._loop is not None:
            self._is_waking = True
            try:
                self._loop.call_soon_threadsafe(self._wake)
            except RuntimeError:  # the loop has ended; the ticker will, too
                self._loop = None

    def _wake(self) -> None:
        self._is_waking = False
        event, self._event = self._event, asyncio.Event()
        event.set()
