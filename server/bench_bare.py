"""The baseline of ``http_volume``: the least that Starlette and uvicorn can do to send some bytes. Run as a process of its own."""

import sys
from pathlib import Path

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from server.cli_serve import bind, listen


def bare_app(content: bytes) -> Starlette:
    """An application whose every reply to /v1/volume is ``content``."""

    async def reply(_: Request) -> Response:
        return Response(content, media_type="application/octet-stream")

    return Starlette(routes=[Route("/v1/volume", reply)])


def main() -> None:
    """Serve the file that the first argument names, on a free port of this machine, until stopped."""
    content = Path(sys.argv[1]).read_bytes()
    with bind("127.0.0.1", 0) as listener:
        print(f"Serving http://127.0.0.1:{listener.getsockname()[1]}/", flush=True)
        listen(bare_app(content), listener)


if __name__ == "__main__":
    main()
