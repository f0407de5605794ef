"""Replies that were computed before, so that a texture which many clients ask for is made once and then only sent.

A reply is kept under its ETag, which names everything that it depends on. Which ETag a request's path and query lead to is kept too:
a request that was answered before, letter by letter, is then answered on the event loop, past routing, parsing and the thread pool.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from fastapi import Response
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

MAX_BYTES = 64 << 20  # some 80 raw volumes
# A reply takes 1.4 kB beside its content: without this a million of the smallest would fit, and be held in a gigabyte and a half.
MAX_REPLIES = 8192
# Longer targets are somebody's experiment; remembering them would cost more than it saves.
MAX_TARGET_BYTES = 512
MAX_TARGETS = 4096

Target = tuple[str, bytes]
Count = Callable[[str, str, int], None]


@dataclass(frozen=True)
class Body:
    """What a reply carries."""

    content: bytes
    media_type: str
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class FinishedReply:
    """A successful reply. ``etag`` is quoted."""

    etag: str
    cache_control: str
    body: Body

    def answer(self, headers: Mapping[str, str]) -> Response:
        """The reply, or 304 when a request's headers say that the client has it."""
        shared = {"ETag": self.etag, "Cache-Control": self.cache_control}
        if names(headers, self.etag, is_there=True):
            return Response(status_code=304, headers=shared)
        return self.whole

    @cached_property
    def whole(self) -> Response:
        """The reply for a client that has nothing. Built once, since headers take long to encode, and never changed."""
        headers = {**self.body.headers, "ETag": self.etag, "Cache-Control": self.cache_control}
        return Response(self.body.content, media_type=self.body.media_type, headers=headers)


def names(headers: Mapping[str, str], etag: str, is_there: bool = False) -> bool:
    """Whether If-None-Match names ``etag``, compared weakly (RFC 9110, 13.1.2); ``*`` does of what is known to be there."""
    given = headers.get("if-none-match", "")
    return (is_there and given.strip() == "*") or etag in {candidate.strip().removeprefix("W/") for candidate in given.split(",")}


class FinishedReplies:
    """The replies that were asked for last, bounded in bytes and in number. Safe to use from several threads."""

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self.hits = self.misses = 0
        self._max_bytes = max_bytes
        self._bytes = 0
        self._replies: OrderedDict[str, FinishedReply] = OrderedDict()
        self._etags: OrderedDict[Target, str] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, etag: str | None) -> FinishedReply | None:
        """The reply under an ETag, if it is still kept."""
        with self._lock:
            found = None if etag is None else self._replies.get(etag)
            if found is not None:
                self._replies.move_to_end(found.etag)
                self.hits += 1
            return found

    def count_miss(self) -> None:
        """A reply had to be computed."""
        with self._lock:
            self.misses += 1

    @property
    def nbytes(self) -> int:
        """Bytes of the contents that are kept."""
        return self._bytes

    def at(self, target: Target) -> FinishedReply | None:
        """The reply to a path and query that were asked for before, if it is still kept."""
        with self._lock:
            etag = self._etags.get(target)
        return self.get(etag)

    def keep(self, target: Target, reply: FinishedReply) -> None:
        """Keep a reply and how it was asked for; the least recently used ones make room."""
        size = len(reply.body.content)
        if size > self._max_bytes:
            return
        with self._lock:
            if reply.etag not in self._replies:
                self._bytes += size
            self._replies[reply.etag] = reply
            self._replies.move_to_end(reply.etag)
            while self._bytes > self._max_bytes or len(self._replies) > MAX_REPLIES:
                _, oldest = self._replies.popitem(last=False)
                self._bytes -= len(oldest.body.content)
            if len(target[0]) + len(target[1]) <= MAX_TARGET_BYTES:
                self._etags[target] = reply.etag
                self._etags.move_to_end(target)
                while len(self._etags) > MAX_TARGETS:
                    self._etags.popitem(last=False)

    def clear(self) -> None:
        """Forget everything: called when what requests lead to may have changed."""
        with self._lock:
            self._replies.clear()
            self._etags.clear()
            self._bytes = 0


def target_of(scope: Scope) -> Target:
    """A request's path and query, as they were sent."""
    return scope["path"], scope["query_string"]


class AnswerFromFinished:
    """Answers a GET that was answered before. Pure ASGI; everything else goes on to the application."""

    def __init__(self, app: ASGIApp, replies: FinishedReplies, count: Count) -> None:
        """``count`` is told method, path and status of each answer; the path is one that a route has, letter by letter."""
        self._app = app
        self._replies = replies
        self._count = count

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        reply = self._replies.at(target_of(scope)) if scope["type"] == "http" and scope["method"] == "GET" else None
        if reply is None:
            await self._app(scope, receive, send)
        else:
            answer = reply.answer(Headers(scope=scope))
            self._count("GET", scope["path"], answer.status_code)
            await answer(scope, receive, send)
