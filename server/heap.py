"""What the C library does with memory that NumPy lets go of. The rest of glibc's defaults are for programs that do not run for weeks."""

import ctypes
import sys

# <malloc.h>
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8
# Arrays from this size on [bytes] are the system's again as soon as they go. glibc's own threshold starts at half of that, but rises to
# 32 MB with what it sees, and sectors that come and go then leave holes.
RETURNED_FROM = 1 << 18
# Heaps that threads share, instead of eight for each core: every thread that ever decoded a sector would keep its own.
HEAPS = 2


def give_memory_back() -> bool:
    """Have this process return what it no longer needs; whether the C library can be told (glibc)."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    return mallopt is not None and bool(mallopt(_M_MMAP_THRESHOLD, RETURNED_FROM) and mallopt(_M_ARENA_MAX, HEAPS))
