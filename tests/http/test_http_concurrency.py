"""Many clients at once get what one client gets, and a busy server still says that it lives."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from server.service import PREVIEW_THREADS


def test_concurrent_queries_give_the_bytes_of_lone_ones(http: httpx.Client, place: dict[str, Any]) -> None:
    queries: list[tuple[str, dict[str, Any]]] = []
    for hour in range(6, 20, 2):
        moment = {"time": f"{hour:02d}:15", "weather": "clear"}
        queries += [
            ("/v1/volume", {**place, **moment}),
            ("/v1/volume", {**place, **moment, "x": place["x"] + 13, "format": "raw"}),
            ("/v1/probes", {**place, **moment, "radius": 30}),
            ("/v1/distant", moment),
            ("/v1/preview.png", {**moment, "eye": "-10,20,-10", "look": "30,0,30", "width": 32}),
        ]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda query: http.get(query[0], params=query[1]), queries))
    assert {reply.status_code for reply in together} == {200}
    for (path, query), reply in zip(queries, together, strict=True):
        assert http.get(path, params=query).content == reply.content, (path, query)


def test_a_busy_server_still_answers_healthz(http: httpx.Client) -> None:
    def picture(minute: int) -> int:
        query = {"time": f"11:{minute:02d}", "weather": "clear", "eye": "-10,20,-10", "look": "30,0,30", "width": 480}
        return http.get("/v1/preview.png", params=query).status_code

    with ThreadPoolExecutor(8) as pool:
        pictures = [pool.submit(picture, minute) for minute in range(8)]
        asked = 0
        while not all(done.done() for done in pictures):
            started = time.perf_counter()
            assert http.get("/healthz").status_code == 200
            # It needs no thread of the pool, so it waits for none: far below the seconds that eight pictures take.
            assert time.perf_counter() - started < 2
            asked += 1
            time.sleep(0.02)
    assert asked
    assert {done.result() for done in pictures} == {200}


def test_more_pictures_than_there_are_threads_leave_some_for_all_else(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()

    def drawn(*_: object) -> bytes:
        go_on.wait(20)
        return b"drawn"

    def picture(minute: int) -> int:
        query = {"time": f"12:{minute:02d}", "weather": "clear", "eye": "-10,20,-10", "look": "30,0,30", "width": 16}
        return http.get("/v1/preview.png", params=query, timeout=30).status_code

    monkeypatch.setattr("server.routes.preview.picture", drawn)
    with ThreadPoolExecutor(50) as pool:  # the pool of routes has 40
        pictures = [pool.submit(picture, minute) for minute in range(50)]
        try:
            time.sleep(0.5)
            for path, query in (("/healthz", {}), ("/v1/lighting", {"time": "13:37", "weather": "clear"})):
                assert http.get(path, params=query, timeout=5).status_code == 200
            assert not any(done.done() for done in pictures)
        finally:
            go_on.set()
    assert {done.result() for done in pictures} == {200}


def test_no_picture_is_drawn_for_a_client_that_did_not_wait(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()
    drawn: list[object] = []

    def draw(*_: object) -> bytes:
        drawn.append(_)
        go_on.wait(20)
        return b"drawn"

    query = {"weather": "clear", "eye": "-10,20,-10", "look": "30,0,30", "width": 16}

    def impatient(minute: int) -> None:
        with pytest.raises(httpx.TimeoutException):
            http.get("/v1/preview.png", params={"time": f"15:{minute:02d}", **query}, timeout=0.5)

    monkeypatch.setattr("server.routes.preview.picture", draw)
    with ThreadPoolExecutor(10) as pool:
        list(pool.map(impatient, range(10)))
    go_on.set()
    assert http.get("/v1/preview.png", params={"time": "15:59", **query}).status_code == 200
    assert len(drawn) == PREVIEW_THREADS + 1
