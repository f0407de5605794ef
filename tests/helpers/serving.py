"""A server beside a test, and waiting for what it does."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import uvicorn

PATIENCE_S = 20.0  # the machine may be busy
STARTUP_S = 90.0  # a fresh process builds its kernels, on a machine that may be busy


def until(found: Callable[[], Any]) -> Any:
    """What a function gives, once that is true."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := found()):
        assert time.monotonic() < deadline, "it did not come to that"
        time.sleep(0.02)
    return value


@contextmanager
def running(server: uvicorn.Server, listener: socket.socket) -> Iterator[str]:
    """The address of a server that answers at a bound socket, in a thread of its own, while the block lasts."""
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    with listener:
        thread.start()
        try:
            deadline = time.monotonic() + STARTUP_S
            while not server.started:
                assert thread.is_alive(), "the server ended"
                assert time.monotonic() < deadline, "the server did not start"
                time.sleep(0.01)
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(10)
