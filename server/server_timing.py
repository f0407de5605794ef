"""What of a reply took how long, as the header Server-Timing says it (W3C), which browsers show beside each request."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from starlette.responses import Response

HEADER = "Server-Timing"


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
        telling.raw_headers = [*answer.raw_headers, (HEADER.lower().encode(), self.text.encode())]
        return telling
