"""Threads whose work can wait, beside those that tick."""

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

# A little: of two that want a core ticks get three fifths. With the most there is, 19, a thread that is put aside while it holds Python's
# lock holds up ticks as long as it takes to be let on again: where other work filled both cores, a loader decoded a sixth of the sectors
# and ticks came later than with none at all.
NICENESS = 2


def background_thread(name: str) -> ThreadPoolExecutor:
    """An executor of one thread that has ticks and the device's threads go before it, where the system can do that for one thread
    (Linux)."""
    return ThreadPoolExecutor(1, thread_name_prefix=name, initializer=_step_back)


def _step_back() -> None:
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
