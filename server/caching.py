"""Conditional replies: an ETag is known before anything is computed, so a client that has the bytes costs nothing."""

import hashlib
from collections.abc import Callable

from fastapi import Request, Response

from server.dependencies import service_of
from server.finished_replies import Body, FinishedReply, names, target_of
from server.server_timing import Laps

__all__ = ["FILE_CACHE_CONTROL", "QUERY_CACHE_CONTROL", "Body", "conditional", "strong_etag"]

# A query's answer changes only when the server gets another dataset; a minute is how long a client may not notice.
QUERY_CACHE_CONTROL = "public, max-age=60"
# A sector's bytes never change under one digest.
FILE_CACHE_CONTROL = "public, max-age=31536000, immutable"


def strong_etag(*parts: object) -> str:
    """A quoted ETag that names everything a reply depends on, in order."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        text = repr(part).encode()
        digest.update(len(text).to_bytes(8, "little") + text)
    return f'"{digest.hexdigest()}"'


def conditional(request: Request, etag: str, compute: Callable[[], Body], laps: Laps | None = None) -> Response:
    """304 when the client has the reply already, else the reply: a finished one, or what ``compute`` returns.

    ``*`` in If-None-Match means any successful reply. A reply that is computed says what took how long: ``laps``, or all of it as one.
    """
    if names(request.headers, etag):
        return Response(status_code=304, headers={"ETag": etag, "Cache-Control": QUERY_CACHE_CONTROL})
    replies = service_of(request).replies
    reply, laps = replies.get(etag), laps or Laps()
    is_new = reply is None
    if reply is None:
        replies.count_miss()
        with laps.unless_divided("compute"):
            reply = FinishedReply(etag, QUERY_CACHE_CONTROL, compute())
    replies.keep(target_of(request.scope), reply)
    answer = reply.answer(request.headers)
    return laps.told(answer) if is_new and answer.status_code == 200 else answer
