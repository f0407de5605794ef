"""What the C library does with memory that NumPy lets go of. The rest of glibc's defaults are for programs that do not run for weeks."""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# <malloc.h>
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
# Arrays from this size on [bytes] are the system's again as soon as they go. glibc's own threshold starts at half of that, but rises to
# 32 MB with what it sees, and sectors that come and go then leave holes.
RETURNED_FROM = 1 << 18
# Heaps that threads share, instead of eight for each core: every thread that ever decoded a sector would keep its own.
HEAPS = 2
# What is free at a heap's end goes back beyond so much [bytes]: glibc's own number.
TRIMMED_FROM = 1 << 17
# Arrays below this, the most that glibc takes, and as much at a heap's end as a picture needs, are kept while one is drawn.
KEPT_BELOW, KEPT_AT_END = 1 << 25, 1 << 28
_gives_back = False


def give_memory_back() -> bool:
    """Have this process return what it no longer needs; whether the C library can be told (glibc)."""
    global _gives_back  # noqa: PLW0603
    _gives_back = _tell(_M_MMAP_THRESHOLD, RETURNED_FROM) and _tell(_M_ARENA_MAX, HEAPS)
    return _gives_back


@contextmanager
def keeping_memory() -> Iterator[None]:
    """Meanwhile a process that gives memory back keeps what it lets go of; it gives that back in the end. One at a time.

    For work that makes hundreds of large arrays one after the other: the system clears each page that it gives, which takes a quarter of a
    picture's time.
    """
    if not _gives_back:
        yield
        return
    _tell(_M_MMAP_THRESHOLD, KEPT_BELOW)
    _tell(_M_TRIM_THRESHOLD, KEPT_AT_END)
    try:
        yield
    finally:
        _tell(_M_MMAP_THRESHOLD, RETURNED_FROM)
        _tell(_M_TRIM_THRESHOLD, TRIMMED_FROM)
        ctypes.CDLL(None).malloc_trim(0)


def _tell(option: int, value: int) -> bool:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    return mallopt is not None and bool(mallopt(option, value))
