"""Whose turn it is to get a first frame: a whole volume, which takes some milliseconds to encode, where most ticks have nothing to encode.

When fifty streams open at once, those fifty frames would take both encoders and half of Python's lock from several ticks on end. So each
tick lets one of them begin, in the order in which they came: ticks keep their time, and so do the streams that are there already.
"""

import asyncio

from server.tick_signal import TickSignal


class FirstFrames:
    """Turns of all streams of a server. On the event loop alone."""

    def __init__(self, ticks: TickSignal) -> None:
        self._ticks = ticks
        self._tick = -1
        """The last that somebody had."""
        self._queue = asyncio.Lock()
        """Goes to who came first, and not to who has gone."""

    async def turn(self) -> None:
        """Returns once all who came before have had their turn, or have gone, and there is a tick that nobody has had."""
        async with self._queue:
            self._tick = (await self._ticks.after(self._tick)).tick
