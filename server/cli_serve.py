"""``sectorlight serve``: one process that listens."""

import logging
import socket
import sys
from pathlib import Path

import uvicorn
from starlette.applications import Starlette

from gi_core.errors import InputError
from server.app import create_app
from server.heap import give_memory_back
from server.player_streams import MAX_MESSAGE_BYTES, PING_S
from server.service import Service
from server.settings import Settings

# Long enough for a picture that is being drawn, short enough for a hand on Ctrl-C.
SHUTDOWN_GRACE_S = 5
# Python lets a thread that computes keep its lock this long before another gets it. At the default of 5 ms a tick, which takes and gives
# the lock often, would wait for the encoding of one reply longer than its own work takes.
SWITCH_INTERVAL_S = 0.0005
# A client that takes no bytes for so long is cut off, whoever waits: without it, one that stops reading would hold its stream for ever.
UNSENT_MS = 60_000
# What the system takes of a connection beyond what is under way. By itself it takes megabytes, and a stream's client who reads slowly would
# see what was many seconds ago.
UNSENT_BYTES = 1 << 16


def run(dataset_path: Path, settings: Settings) -> None:
    """Serve until interrupted; returns normally then. InputError when the address is not to be had."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("pyopencl").setLevel(logging.WARNING)  # it reports how long each first build of a kernel took
    settings.checked()
    # Bound before anything slow, so that a taken port is known at once; listening starts when the application is ready.
    with bind(settings.host, settings.port) as listener:
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        give_memory_back()
        app = create_app(dataset_path, settings)
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        print(f"Serving {dataset_path} at http://{host}:{listener.getsockname()[1]}/", flush=True)
        try:
            listen(app, listener)
        except KeyboardInterrupt:  # how uvicorn ends after its own clean shutdown
            print("Stopped.", flush=True)


def listen(app: Starlette, listener: socket.socket) -> None:
    """Answer at a bound socket until interrupted, which raises KeyboardInterrupt."""
    http_server(app).run(sockets=[listener])


def http_server(app: Starlette, log_level: str = "warning") -> uvicorn.Server:
    """The server of an application, as ``serve`` runs it."""
    config = uvicorn.Config(
        app,
        lifespan="on",  # else a world that cannot start would be served all the same
        log_level=log_level,
        timeout_graceful_shutdown=SHUTDOWN_GRACE_S,
        server_header=False,
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_per_message_deflate=False,  # frames are compressed already
        ws_ping_interval=PING_S,
        ws_ping_timeout=PING_S,
    )
    server = _Server(config)
    server.service = getattr(app.state, "service", None)
    return server


class _Server(uvicorn.Server):
    """Closes streams with a word of its own, while their connections still stand."""

    service: Service | None = None

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        if self.service is not None:
            await self.service.streams.close()
        await super().shutdown(sockets)


def bind(host: str, port: int) -> socket.socket:
    """A TCP socket bound to an address; InputError when it cannot be."""
    listener = None
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; connections inherit it
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNSENT_MS)
        if hasattr(socket, "TCP_NOTSENT_LOWAT"):
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
        listener.bind(address)
    except OSError as error:
        if listener is not None:
            listener.close()
        raise InputError(f"--host {host} --port {port}: expected an address that is free here, found {error.strerror}") from error
    return listener
