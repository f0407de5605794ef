"""What a request that changes something has to bring: the token, where there is one, and a small JSON object."""

import hmac
import json
from typing import Annotated, Any

from fastapi import Depends, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.requests import ClientDisconnect

from gi_core.errors import InputError
from server.dependencies import ServiceDep
from server.http_errors import BodyTooLargeError, NotJsonError, TokenError

MAX_BODY_BYTES = 1 << 20  # a path of 10 000 points, with room
_bearer = HTTPBearer(auto_error=False, description="the text of the server's --token-file; servers without one take every write")


async def require_token(service: ServiceDep, given: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]) -> None:
    """Raises TokenError for a write that does not bring the token."""
    if service.token is None:
        return
    # In constant time: how far a guess is right must not show in how long the answer takes.
    if given is None or not hmac.compare_digest(given.credentials.encode("utf-8", "replace"), service.token.encode()):
        raise TokenError("expected the header Authorization: Bearer TOKEN with this server's token")


async def read_json_object(request: Request) -> dict[str, Any]:
    """The body. Raises NotJsonError, BodyTooLargeError before more than that is read, and InputError."""
    # Also keeps other sites' pages out: a browser sends forms and plain text across sites unasked, but not JSON.
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise NotJsonError(f"body: expected Content-Type: application/json, found {kind[:60] or 'none'}")
    length = request.headers.get("content-length", "")
    if length.isdecimal() and int(length[:20]) > MAX_BODY_BYTES:
        raise BodyTooLargeError(f"body: expected at most {MAX_BODY_BYTES} bytes, found {length[:20]}")
    body = bytearray()
    try:
        async for part in request.stream():
            body += part
            if len(body) > MAX_BODY_BYTES:
                raise BodyTooLargeError(f"body: expected at most {MAX_BODY_BYTES} bytes, found more")
    except ClientDisconnect as error:  # nobody reads the answer, but it is no failure of ours
        raise InputError("body: expected all of it, found a client that went away") from error
    try:
        record = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise InputError(f"body: expected a JSON object ({str(error)[:120]})") from error
    if not isinstance(record, dict):
        raise InputError(f"body: expected a JSON object, found a {type(record).__name__}")
    return record


JsonBody = Annotated[dict[str, Any], Depends(read_json_object)]
WRITE = [Depends(require_token)]


def body_schema(example: dict[str, Any], properties: dict[str, str], required: tuple[str, ...] = ()) -> dict[str, Any]:
    """``openapi_extra`` of a route whose body is read by ``read_json_object``: its members with what they mean."""
    schema = {
        "type": "object",
        "additionalProperties": False,
        "properties": {name: {"description": text} for name, text in properties.items()},
        "required": list(required),
    }
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema, "example": example}}}}
