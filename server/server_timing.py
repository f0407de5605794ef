"""What of a reply took how long, as the header Server-Timing says it (W3C), which browsers show beside each request."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADER = "Server-Timing"
_RAW_HEADER = HEADER.lower().encode()


class Laps:
    """Times of a reply's parts, in the order in which they ended."""

    def __init__(self) -> None:
        self._parts_ms: dict[str, float] = {}
        self._is_divided = False

    @contextmanager
    def lap(self, name: str) -> Iterator[None]:
        """Time a part; ``name`` is an HTTP token."""
        started = time.perf_counter()
        self._is_divided = True
        yield
        self._parts_ms[name] = self._parts_ms.get(name, 0.0) + (time.perf_counter() - started) * 1e3

    @contextmanager
    def unless_divided(self, name: str) -> Iterator[None]:
        """Time the whole under one name, where nobody times its parts."""
        started = time.perf_counter()
        yield
        if not self._is_divided:
            self._parts_ms[name] = (time.perf_counter() - started) * 1e3

    @property
    def text(self) -> str:
        """The header's value."""
        return ", ".join(f"{name};dur={value:.3f}" for name, value in self._parts_ms.items())

    def told(self, answer: Response) -> Response:
        """A reply that says so. Not the one that was given, which others may get too, later and in no time."""
        telling = Response(answer.body, answer.status_code)
        telling.raw_headers = [*answer.raw_headers, (_RAW_HEADER, self.text.encode())]
        return telling


class TellTotal:
    """Has each HTTP reply say how long it took until it began, as the part ``total``. Pure ASGI; the outermost, so that it times them all.

    Only the reply to a failure that nobody foresaw, which Starlette sends from outside of everything, goes without.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()

        async def telling(message: Message) -> None:
            if message["type"] == "http.response.start":
                total = b"total;dur=%.3f" % ((time.perf_counter() - started) * 1e3)
                # Another line of a list, beside the parts' own. Not into the list that was given, which may be a finished reply's.
                message = {**message, "headers": [*message["headers"], (_RAW_HEADER, total)]}
            await send(message)

        await self._app(scope, receive, telling)
