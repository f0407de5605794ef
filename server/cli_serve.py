"""``sectorlight serve``: one process that listens."""

import logging
import socket
from pathlib import Path

import uvicorn
from starlette.types import ASGIApp

from gi_core.errors import InputError
from server.app import create_app
from server.settings import Settings

# Long enough for a picture that is being drawn, short enough for a hand on Ctrl-C.
SHUTDOWN_GRACE_S = 5


def run(dataset_path: Path, settings: Settings) -> None:
    """Serve until interrupted; returns normally then. InputError when the address is not to be had."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("pyopencl").setLevel(logging.WARNING)  # it reports how long each first build of a kernel took
    settings.checked()
    # Bound before anything slow, so that a taken port is known at once; listening starts when the application is ready.
    with bind(settings.host, settings.port) as listener:
        app = create_app(dataset_path, settings)
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        print(f"Serving {dataset_path} at http://{host}:{listener.getsockname()[1]}/", flush=True)
        try:
            listen(app, listener)
        except KeyboardInterrupt:  # how uvicorn ends after its own clean shutdown
            print("Stopped.", flush=True)


def listen(app: ASGIApp, listener: socket.socket) -> None:
    """Answer at a bound socket until interrupted, which raises KeyboardInterrupt."""
    config = uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=SHUTDOWN_GRACE_S, server_header=False)
    uvicorn.Server(config).run(sockets=[listener])


def bind(host: str, port: int) -> socket.socket:
    """A TCP socket bound to an address; InputError when it cannot be."""
    listener = None
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        if listener is not None:
            listener.close()
        raise InputError(f"--host {host} --port {port}: expected an address that is free here, found {error.strerror}") from error
    return listener
