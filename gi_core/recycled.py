"""Arrays whose memory is used again once nobody holds them: memory that was never touched costs a page fault for each 4 kB."""

import math
import weakref
from collections import deque

import numpy as np

from gi_core.arrays import Float32

KEPT = 8  # free ones that are kept: more players at once than these share out what the others return


class RecycledArrays:
    """Float32 arrays of one shape. ``take`` is one thread's; arrays may be let go by any."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._free: deque[bytearray] = deque(maxlen=KEPT)

    def take(self) -> Float32:
        """An array of any contents. Its memory returns when it and all views of it are gone."""
        try:
            memory = self._free.pop()
        except IndexError:
            memory = bytearray(4 * math.prod(self._shape))
        # Views of an array over foreign memory keep that very array, so that it outlives them all.
        whole = np.frombuffer(memory, np.float32)
        weakref.finalize(whole, self._free.append, memory)
        return whole.reshape(self._shape)
