"""Byte ranges of a reply (RFC 9110, 14): a single range is honoured, anything else means the whole."""

import re

from fastapi import Request, Response

from server.http_errors import RangeError

_SINGLE_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})$")


def requested_range(request: Request, size: int, etag: str) -> slice | None:
    """Which bytes of ``size`` a request wants; None for all of them. RangeError when it wants none that exist."""
    header = request.headers.get("range", "").replace(" ", "")
    match = _SINGLE_RANGE.match(header)
    if not match or match.groups() == ("", ""):
        return None
    # The client has part of another version: it needs everything (If-Range, RFC 9110, 13.1.5).
    if request.headers.get("if-range", etag) != etag:
        return None
    first, last = match.groups()
    if first == "":
        start, stop = max(size - int(last), 0), size
    else:
        start, stop = int(first), size if last == "" else min(int(last) + 1, size)
        if last != "" and int(last) < int(first):
            return None  # not a range at all, so it is ignored
    if start >= stop:
        raise RangeError(f"Range: expected bytes below {size}, found {header[:60]}", size)
    return slice(start, stop)


def file_reply(request: Request, content: bytes, etag: str, cache_control: str) -> Response:
    """A file's bytes, whole (200) or in part (206)."""
    headers = {"ETag": etag, "Cache-Control": cache_control, "Accept-Ranges": "bytes"}
    part = requested_range(request, len(content), etag)
    if part is None:
        return Response(content, media_type="application/octet-stream", headers=headers)
    headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{len(content)}"
    return Response(content[part], 206, headers=headers, media_type="application/octet-stream")
