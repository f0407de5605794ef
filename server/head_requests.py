"""HEAD for every GET (RFC 9110, 9.3.2): load balancers and caches ask with it. Pure ASGI."""

from starlette.types import ASGIApp, Receive, Scope, Send


class HeadRequests:
    """Routes HEAD as GET; the ASGI server sends the headers and leaves the body out."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] == "HEAD":
            # A copy: the server reads its own scope to know that the body is not wanted.
            scope = {**scope, "method": "GET"}
        await self._app(scope, receive, send)
