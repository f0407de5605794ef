"""Threads whose work can wait, beside those that tick."""

import os
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

# A little: of two that want a core ticks get three fifths. With the most there is, 19, a thread that is put aside while it holds Python's
# lock holds up ticks as long as it takes to be let on again: where other work filled both cores, a loader decoded a sixth of the sectors
# and ticks came later than with none at all.
NICENESS = 2
# A thread waits as long as it has worked, and this much more at a stretch [s]: in a world whose ticks leave no time it still gets half.
MOST_AHEAD_S = 0.05


class RightOfWay:
    """What a tick takes and background threads give. For ticks of one thread."""

    def __init__(self) -> None:
        self._free = threading.Event()
        self._free.set()

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Meanwhile background threads wait, as soon as each next comes to ``give_way``."""
        self._free.clear()
        try:
            yield
        finally:
            self._free.set()

    def wait(self, timeout_s: float) -> None:
        """Until nobody has it, or so long [s]."""
        self._free.wait(timeout_s)


class _Turn:
    """One background thread's: what it gives way to, and how long it may yet wait."""

    def __init__(self, to: RightOfWay) -> None:
        self._to = to
        self._spare_s = MOST_AHEAD_S
        self._since = time.perf_counter()

    def give_way(self) -> None:
        before = time.perf_counter()
        self._spare_s = min(self._spare_s + before - self._since, MOST_AHEAD_S)
        self._to.wait(self._spare_s)
        self._since = time.perf_counter()
        self._spare_s -= self._since - before


_own = threading.local()


def give_way() -> None:
    """In a background thread: wait while a tick runs. To be called between steps of a millisecond or less. Elsewhere nothing happens."""
    turn: _Turn | None = getattr(_own, "turn", None)
    if turn is not None:
        turn.give_way()


def background_thread(name: str, to: RightOfWay) -> ThreadPoolExecutor:
    """An executor of one thread that gives way ``to`` ticks, and has them and the device's threads go before it where the system can do
    that for one thread (Linux)."""
    return ThreadPoolExecutor(1, thread_name_prefix=name, initializer=_step_back, initargs=(to,))


def _step_back(to: RightOfWay) -> None:
    _own.turn = _Turn(to)
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
