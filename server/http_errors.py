"""Errors that only HTTP has."""

from gi_core.errors import InputError, SectorlightError


class RangeError(InputError):
    """A byte range that lies beyond the file: HTTP 416."""

    code = "range_not_satisfiable"

    def __init__(self, message: str, size: int) -> None:
        super().__init__(message)
        self.size = size


class TokenError(SectorlightError):
    """A write without the server's token: HTTP 401."""

    code = "unauthorized"


class BodyTooLargeError(InputError):
    """HTTP 413."""

    code = "body_too_large"


class NotJsonError(InputError):
    """A body of another media type: HTTP 415."""

    code = "not_json"
