"""The HTTP application: routes, problems, the viewer page. Built by a function, so that a process can serve any dataset."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fastapi import Depends, FastAPI, Response
from fastapi.responses import FileResponse, HTMLResponse
from fastapi.staticfiles import StaticFiles

from server import problems
from server.dependencies import refuse_repeated_parameters
from server.finished_replies import AnswerFromFinished
from server.head_requests import HeadRequests
from server.metrics import CountRequests, Metrics
from server.openapi import describe
from server.reference import reference_page
from server.routes import (
    boxes,
    clock,
    decals,
    distant,
    health,
    lighting,
    lights,
    live,
    player_stream,
    player_volume,
    players,
    preview,
    probes,
    sectors,
    volume,
    weather,
    world,
)
from server.routes import (
    metrics as metrics_route,
)
from server.routes import settings as live_settings
from server.server_timing import TellTotal
from server.service import Service
from server.settings import Settings
from server.version import program_version

VIEWER = Path(__file__).parent / "viewer"


class _ViewerFiles(StaticFiles):
    """Asked for anew each time, as the page is: left to guess, browsers keep the scripts of a server that was since replaced for days."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "no-cache"
        return response


def create_app(dataset_path: Path, settings: Settings) -> FastAPI:
    """An application that serves one dataset; InputError or FormatError when the dataset or the device cannot be used."""
    return app_of(Service.open(dataset_path, settings.checked()))


def app_of(service: Service) -> FastAPI:
    """An application on top of an open service. Its lifespan is the live world's."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await asyncio.to_thread(service.live.start_if_needed)
        yield
        await service.streams.close()
        await asyncio.to_thread(service.live.close)
        service.close()

    app = FastAPI(
        title="Sectorlight",
        version=program_version(),
        summary="Dynamic global illumination of a baked city, at any hour and weather",
        description="Errors are `application/problem+json` with a stable `code`. World frame: metres, Y up, X east, Z south.\n\n"
        "The WebSocket `/v1/players/{id}/stream` sends what changes in a player's volume, tick by tick; server/STREAM.md in the source "
        "describes it byte by byte.",
        dependencies=[Depends(refuse_repeated_parameters)],
        redirect_slashes=False,
        docs_url=None,  # their pages load scripts from elsewhere
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.service = service
    app.state.metrics = metrics = Metrics(service)
    app.add_middleware(CountRequests, metrics=metrics)
    app.add_middleware(AnswerFromFinished, replies=service.replies, count=metrics.count_request)
    app.add_middleware(HeadRequests)
    app.add_middleware(TellTotal)
    problems.install(app)
    describe(app)
    stateless = (world, lighting, volume, distant, sectors, probes, decals, preview)
    for resource in (health, metrics_route, *stateless, clock, weather, live_settings, lights, boxes, players, player_volume, live):
        app.include_router(resource.router)
    app.router.routes.append(player_stream.route)
    app.mount("/viewer", _ViewerFiles(directory=VIEWER), name="viewer")

    @app.get("/", include_in_schema=False)
    def viewer() -> FileResponse:
        return FileResponse(VIEWER / "index.html", headers={"Cache-Control": "no-cache"})

    @app.get("/docs", include_in_schema=False)
    def reference() -> HTMLResponse:
        return HTMLResponse(reference_page(app.openapi()), headers={"Cache-Control": "no-cache"})

    return app
