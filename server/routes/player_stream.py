"""The WebSocket stream of a player's volume."""

from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from gi_core.errors import SectorlightError
from server.live_access import WRITES_WAIT_S, running_ticker
from server.player_streams import Close, close
from server.service import Service


async def stream(socket: WebSocket) -> None:
    """Accept, wait for the live world where it is starting, and follow the player. Refusals are close codes, which browsers show too."""
    service = socket.app.state.service
    assert isinstance(service, Service)
    await socket.accept()
    try:
        ticker = await running_ticker(service, WRITES_WAIT_S)
        await service.streams.serve(socket, ticker, socket.path_params["id"])
    except SectorlightError as error:
        await close(socket, Close(1013, service.public(str(error))))
    except WebSocketDisconnect:
        pass


route = WebSocketRoute("/v1/players/{id}/stream", stream, name="player_stream")
