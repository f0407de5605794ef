"""Errors on the wire: ``application/problem+json`` (RFC 9457), always. One table says which error is which status."""

import logging
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from gi_core.errors import (
    FormatError,
    InputError,
    OutsideWorldError,
    SectorlightError,
    SectorMissingError,
)
from server.http_errors import BodyTooLargeError, NotJsonError, RangeError, TokenError
from server.live_state import LiveUnavailableError, NoSuchThingError, NotKeptError, TakenIdError

log = logging.getLogger("sectorlight.http")

# First match wins, so a class stands above its bases.
STATUS_OF: tuple[tuple[type[Exception], HTTPStatus], ...] = (
    (OutsideWorldError, HTTPStatus.NOT_FOUND),
    (NoSuchThingError, HTTPStatus.NOT_FOUND),
    (TakenIdError, HTTPStatus.CONFLICT),
    (TokenError, HTTPStatus.UNAUTHORIZED),
    (BodyTooLargeError, HTTPStatus.REQUEST_ENTITY_TOO_LARGE),
    (NotJsonError, HTTPStatus.UNSUPPORTED_MEDIA_TYPE),
    (InputError, HTTPStatus.BAD_REQUEST),
    (SectorMissingError, HTTPStatus.NOT_FOUND),
    (FormatError, HTTPStatus.SERVICE_UNAVAILABLE),
    (LiveUnavailableError, HTTPStatus.SERVICE_UNAVAILABLE),
    (NotKeptError, HTTPStatus.INSUFFICIENT_STORAGE),
    (SectorlightError, HTTPStatus.INTERNAL_SERVER_ERROR),
)

RETRY_AFTER_S = 1  # kernels that were built before are warm within seconds
LONGEST_ECHO = 80  # of what a client sent, in a reply or a log

CODE_OF_STATUS = {400: "bad_request", 404: "no_such_path", 405: "method_not_allowed", 416: "range_not_satisfiable"}


def problem(status: int, code: str, detail: str, headers: Mapping[str, str] | None = None, **members: Any) -> JSONResponse:
    """A problem reply. ``members`` are extensions such as ``expected`` or ``errors``."""
    body = {"title": HTTPStatus(status).phrase, "status": int(status), "code": code, "detail": detail, **members}
    no_store = {"Cache-Control": "no-store"}
    return JSONResponse(body, status, headers={**no_store, **(headers or {})}, media_type="application/problem+json")


def install(app: FastAPI) -> None:
    """Make every error of ``app`` a problem reply."""
    app.add_exception_handler(RequestValidationError, _bad_parameters)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(RangeError, _range_error)
    app.add_exception_handler(SectorlightError, _own_error)
    app.add_exception_handler(Exception, _unexpected)


def _own_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, SectorlightError)
    status = next(status for kind, status in STATUS_OF if isinstance(error, kind))
    waiting = isinstance(error, LiveUnavailableError)
    if status >= 500 and not waiting:
        log.error("%s: %s", request.url.path, error)
    # FileNotFoundError and LookupError quote their argument in str(): the text itself is args[0].
    text = str(error.args[0]) if error.args else error.code
    headers = {"Retry-After": str(RETRY_AFTER_S)} if waiting else {"WWW-Authenticate": "Bearer"} if status == 401 else None
    return problem(status, error.code, text if status < 500 else request.app.state.service.public(text), headers)


def _range_error(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RangeError)
    return problem(416, error.code, str(error), {"Content-Range": f"bytes */{error.size}"})


def _bad_parameters(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    errors = [_bad_parameter(item) for item in error.errors()]
    detail = "; ".join(
        ": ".join(part for part in (e["parameter"], f"expected {e['expected']}, found {e['found']}") if part) for e in errors
    )
    return problem(400, "bad_parameter", detail, errors=errors)


def _bad_parameter(item: Mapping[str, Any]) -> dict[str, str]:
    """One of pydantic's complaints in our words: which parameter, what was expected, what was found."""
    if item["type"] == "unknown_parameter":
        context = item["ctx"]
        return {"parameter": context["shown"], "expected": context["known"], "found": "an unknown parameter", "code": item["type"]}
    expected = str(item["msg"]).removeprefix("Value error, ").removeprefix("Input should be ").removeprefix("expected ")
    found = item.get("input")
    return {
        "parameter": ".".join(str(part) for part in item["loc"][1:]),
        "expected": "a value" if item["type"] == "missing" else expected,
        "found": repr(found)[:LONGEST_ECHO] if isinstance(found, str | int | float) else "none",
        "code": str(item["type"]),
    }


def _http_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    status = error.status_code
    detail = {
        404: f"{request.url.path[:LONGEST_ECHO]}: no such path; expected one that /docs lists",
        405: f"{request.method} {request.url.path[:LONGEST_ECHO]}: expected {(error.headers or {}).get('Allow', 'another method')}",
    }.get(status, str(error.detail))
    return problem(status, CODE_OF_STATUS.get(status, "http_error"), detail, error.headers)


def _unexpected(request: Request, error: Exception) -> JSONResponse:
    log.error("%s failed", request.url.path, exc_info=error)
    return problem(500, "internal", "our failure; the server's log says more")
