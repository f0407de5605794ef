"""Two server processes of one dataset give the same bytes: any replica may answer any request."""

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

START = "from server.cli import main; main()"
STARTUP_S = 90.0


@pytest.fixture(scope="module")
def replicas(city: Path) -> Iterator[list[httpx.Client]]:
    processes = [
        subprocess.Popen([sys.executable, "-c", START, "serve", str(city), "--port", "0"], stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    try:
        clients = []
        for process in processes:
            assert process.stdout is not None
            clients.append(httpx.Client(base_url=process.stdout.readline().split()[-1], timeout=60))
            wait_until_ready(clients[-1])
        yield clients
        for client in clients:
            client.close()
    finally:
        for process in processes:
            process.terminate()
            process.communicate(timeout=20)


def wait_until_ready(client: httpx.Client) -> None:
    deadline = time.monotonic() + STARTUP_S
    while True:
        try:
            assert client.get("/readyz").status_code == 200
            return
        except httpx.TransportError:
            assert time.monotonic() < deadline, "the server did not start"
            time.sleep(0.05)


def test_replicas_give_the_same_bytes(replicas: list[httpx.Client], place: dict[str, Any]) -> None:
    first, second = replicas
    # The second replica lights other moments first: what a process did before must not show.
    for time_of_day in ("06:00", "18:30"):
        second.get("/v1/volume", params={**place, "time": time_of_day, "weather": "overcast"})
    for path, query in (
        ("/v1/volume", {**place}),
        ("/v1/volume", {**place, "format": "raw"}),
        ("/v1/distant", {}),
        ("/v1/sky", {}),
        ("/v1/probes", {**place, "radius": 50}),
        ("/v1/preview.png", {"eye": "-10,20,-10", "look": "30,0,30", "width": 64}),
    ):
        replies = [client.get(path, params={**query, "time": "09:30", "weather": "clear"}) for client in (first, second)]
        assert replies[0].status_code == 200
        assert replies[0].content == replies[1].content, path
        assert replies[0].headers["etag"] == replies[1].headers["etag"]
        first_headers, second_headers = ({k: v for k, v in r.headers.items() if k not in ("date", "server-timing")} for r in replies)
        assert first_headers == second_headers
