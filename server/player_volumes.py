"""Replies with players' volumes, encoded once however many ask for them."""

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from server.finished_replies import Body

# The volumes of one tick that several readers may share; some 1.2 MB each.
MAX_REPLIES = 32


@dataclass(frozen=True)
class VolumeKey:
    """What decides a reply's bytes."""

    player: str
    tick: int
    format: str
    encoding: str
    mask: bool


class PlayerVolumes:
    """The replies that were asked for last. On the event loop alone; encoding runs in a thread."""

    def __init__(self) -> None:
        self.hits = self.misses = 0
        self._replies: OrderedDict[VolumeKey, asyncio.Future[Body]] = OrderedDict()

    async def get(self, key: VolumeKey, encode: Callable[[], Body]) -> Body:
        """The reply, encoded now if nobody asked for it before."""
        found = self._replies.get(key)
        if found is None:
            self.misses += 1
            found = self._replies[key] = asyncio.ensure_future(asyncio.to_thread(encode))
            found.add_done_callback(lambda made: self._drop_failed(key, made))
            while len(self._replies) > MAX_REPLIES:
                self._replies.popitem(last=False)
        else:
            self.hits += 1
            self._replies.move_to_end(key)
        # Others may wait for it too: it goes on when this request is given up.
        return await asyncio.shield(found)

    def _drop_failed(self, key: VolumeKey, made: "asyncio.Future[Body]") -> None:
        if (made.cancelled() or made.exception() is not None) and self._replies.get(key) is made:
            del self._replies[key]
