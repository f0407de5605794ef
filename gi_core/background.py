"""Threads whose work can wait, beside those that tick."""

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

NICENESS = 19  # the most there is: they get what ticks leave over, which is most of two cores


def background_thread(name: str) -> ThreadPoolExecutor:
    """An executor of one thread that has ticks and the device's threads go before it, where the system can do that for one thread
    (Linux)."""
    return ThreadPoolExecutor(1, thread_name_prefix=name, initializer=_step_back)


def _step_back() -> None:
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
