"""Conditional replies: an ETag is known before anything is computed, so a client that has the bytes costs nothing."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from fastapi import Request, Response

# A query's answer changes only when the server gets another dataset; a minute is how long a client may not notice.
QUERY_CACHE_CONTROL = "public, max-age=60"
# A sector's bytes never change under one digest.
FILE_CACHE_CONTROL = "public, max-age=31536000, immutable"


@dataclass(frozen=True)
class Body:
    """What a reply carries."""

    content: bytes
    media_type: str
    headers: Mapping[str, str] = field(default_factory=dict)


def strong_etag(*parts: object) -> str:
    """A quoted ETag that names everything a reply depends on, in order."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        text = repr(part).encode()
        digest.update(len(text).to_bytes(8, "little") + text)
    return f'"{digest.hexdigest()}"'


def has_current(request: Request, etag: str) -> bool:
    """Whether If-None-Match names ``etag``, compared weakly (RFC 9110, 13.1.2)."""
    given = request.headers.get("if-none-match", "")
    return etag in {candidate.strip().removeprefix("W/") for candidate in given.split(",")}


def conditional(request: Request, etag: str, compute: Callable[[], Body], cache_control: str = QUERY_CACHE_CONTROL) -> Response:
    """304 when the client has the reply already, else what ``compute`` returns. ``*`` in If-None-Match means any successful reply."""
    headers = {"ETag": etag, "Cache-Control": cache_control}
    if has_current(request, etag):
        return Response(status_code=304, headers=headers)
    body = compute()
    if request.headers.get("if-none-match", "").strip() == "*":
        return Response(status_code=304, headers=headers)
    return Response(body.content, media_type=body.media_type, headers={**body.headers, **headers})
