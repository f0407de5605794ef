"""The same query is the same bytes under the same ETag, and a client that has them costs nothing."""

from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

QUERIES: list[tuple[str, dict[str, Any]]] = [
    ("/v1/world", {}),
    ("/v1/sectors", {}),
    ("/v1/lighting", {"moment": True}),
    ("/v1/sky", {"moment": True}),
    ("/v1/volume", {"moment": True, "place": True}),
    ("/v1/volume", {"moment": True, "place": True, "mask": 1}),
    ("/v1/volume", {"moment": True, "place": True, "format": "raw"}),
    ("/v1/distant", {"moment": True}),
    ("/v1/probes", {"moment": True, "place": True, "radius": 20}),
    ("/v1/decals", {"x": 0, "y": 0, "z": 0}),
    ("/v1/decals/gradient.png", {}),
    ("/v1/preview.png", {"moment": True, "eye": "-10,20,-10", "look": "30,0,30", "width": 64}),
]


def parameters(query: dict[str, Any], moment: dict[str, Any], place: dict[str, Any]) -> dict[str, Any]:
    chosen = {name: value for name, value in query.items() if name not in ("moment", "place")}
    return chosen | (moment if "moment" in query else {}) | (place if "place" in query else {})


@pytest.mark.parametrize(("path", "query"), QUERIES, ids=[f"{p} {len(q)}" for p, q in QUERIES])
def test_repeats_are_equal_and_304(
    http: httpx.Client, moment: dict[str, Any], place: dict[str, Any], path: str, query: dict[str, Any]
) -> None:
    wanted = parameters(query, moment, place)
    first, second = http.get(path, params=wanted), http.get(path, params=wanted)
    assert first.status_code == 200
    assert first.content == second.content
    assert first.headers["etag"] == second.headers["etag"]
    assert "max-age" in first.headers["cache-control"]
    for condition in (first.headers["etag"], f'"other", W/{first.headers["etag"]}', "*"):
        unchanged = http.get(path, params=wanted, headers={"If-None-Match": condition})
        assert (unchanged.status_code, unchanged.content) == (304, b"")
        assert unchanged.headers["etag"] == first.headers["etag"]
    assert http.get(path, params=wanted, headers={"If-None-Match": '"other"'}).content == first.content


def test_whatever_changes_the_reply_changes_the_etag(http: httpx.Client, moment: dict[str, Any], place: dict[str, Any]) -> None:
    base = {**moment, **place}
    variants = [{}, {"time": "12:05"}, {"weather": "overcast"}, {"x": place["x"] + 8}, {"mask": 1}, {"format": "raw"}]
    etags = [http.get("/v1/volume", params={**base, **variant}).headers["etag"] for variant in variants]
    assert len(set(etags)) == len(etags)


def test_two_spellings_of_one_moment_share_an_etag(http: httpx.Client, place: dict[str, Any]) -> None:
    date = http.get("/v1/world").json()["location"]["date"]
    replies = [http.get("/v1/volume", params={**place, "time": time, "weather": "clear"}) for time in ("12:00", f"{date}T12:00:00")]
    assert replies[0].headers["etag"] == replies[1].headers["etag"]
    assert replies[0].content == replies[1].content


def test_a_client_that_has_the_volume_costs_no_relighting(
    http: httpx.Client, app: FastAPI, moment: dict[str, Any], place: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    etag = http.get("/v1/volume", params={**moment, **place}).headers["etag"]

    def refuse(*_: object) -> None:
        raise AssertionError("the engine was asked")

    monkeypatch.setattr(app.state.service.engine, "volume", refuse)
    assert http.get("/v1/volume", params={**moment, **place}, headers={"If-None-Match": etag}).status_code == 304
    app.state.service.replies.clear()
    assert http.get("/v1/volume", params={**moment, **place}, headers={"If-None-Match": etag}).status_code == 304
    # So the refusal above does work. After a failure the server closes the connection: it must not be the next test's.
    assert http.get("/v1/volume", params={**moment, **place}, headers={"Connection": "close"}).status_code == 500


def test_a_volume_that_was_served_is_not_lit_again(
    http: httpx.Client, app: FastAPI, moment: dict[str, Any], place: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = http.get("/v1/volume", params={**moment, **place})

    def refuse(*_: object) -> None:
        raise AssertionError("the engine was asked")

    monkeypatch.setattr(app.state.service.engine, "volume", refuse)
    date = http.get("/v1/world").json()["location"]["date"]
    # Letter by letter, in another order, and as another spelling of the same moment.
    for query in ({**moment, **place}, {**place, **moment}, {**place, **moment, "time": f"{date}T{moment['time']}"}):
        again = http.get("/v1/volume", params=query)
        assert (again.status_code, again.content) == (200, first.content)
        # What took how long is told only where something was computed.
        first_headers, again_headers = ({k: v for k, v in r.headers.items() if k not in ("date", "server-timing")} for r in (first, again))
        assert again_headers == first_headers
        assert again.headers["server-timing"].partition("=")[0] == "total;dur"
    head = http.head("/v1/volume", params={**moment, **place})
    assert (head.content, head.headers["content-length"]) == (b"", str(len(first.content)))


def test_a_device_s_light_has_its_own_etag(
    http: httpx.Client, app: FastAPI, moment: dict[str, Any], place: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = {"/v1/volume": place, "/v1/probes": place, "/v1/preview.png": {"eye": "-10,20,-10", "look": "30,0,30", "width": 16}}
    before = {path: http.get(path, params={**moment, **query}).headers["etag"] for path, query in paths.items()}
    app.state.service.replies.clear()
    monkeypatch.setattr(type(app.state.service.engine), "device_name", "another device")
    for path, query in paths.items():
        assert http.get(path, params={**moment, **query}).headers["etag"] != before[path], path
    app.state.service.replies.clear()  # what was made under the other name must not be answered to later tests


def first_sector(http: httpx.Client) -> tuple[str, bytes, str]:
    href = http.get("/v1/sectors").json()["sectors"][0]["href"]
    reply = http.get(href)
    return href, reply.content, reply.headers["etag"]


def test_sector_files_are_immutable(http: httpx.Client) -> None:
    href, _, etag = first_sector(http)
    assert http.get(href, headers={"If-None-Match": "*"}).status_code == 304
    assert "immutable" in http.get(href).headers["cache-control"]
    unchanged = http.get(href, headers={"If-None-Match": etag})
    assert (unchanged.status_code, unchanged.content) == (304, b"")


@pytest.mark.parametrize(
    ("header", "part"), [("0-9", slice(0, 10)), ("5-", slice(5, None)), ("-7", slice(-7, None)), ("0-99999999", slice(None))]
)
def test_ranges(http: httpx.Client, header: str, part: slice) -> None:
    href, whole, _ = first_sector(http)
    reply = http.get(href, headers={"Range": f"bytes={header}"})
    assert reply.status_code == 206
    assert reply.content == whole[part]
    start, stop, _ = part.indices(len(whole))
    assert reply.headers["content-range"] == f"bytes {start}-{stop - 1}/{len(whole)}"


@pytest.mark.parametrize("header", ["bytes=9-2", "bytes=-", "bytes=0-1,4-5", "lines=0-1", "bytes=x", "bytes=" + "9" * 40 + "-"])
def test_what_is_no_single_range_means_the_whole(http: httpx.Client, header: str) -> None:
    href, whole, _ = first_sector(http)
    reply = http.get(href, headers={"Range": header})
    assert (reply.status_code, reply.content) == (200, whole)


@pytest.mark.parametrize("header", ["bytes=999999999-", "bytes=-0"])
def test_a_range_beyond_the_file_is_416(http: httpx.Client, header: str) -> None:
    href, whole, _ = first_sector(http)
    reply = http.get(href, headers={"Range": header})
    assert (reply.status_code, reply.headers["content-type"]) == (416, "application/problem+json")
    assert reply.headers["content-range"] == f"bytes */{len(whole)}"


def test_a_range_of_another_version_gets_the_whole(http: httpx.Client) -> None:
    href, whole, etag = first_sector(http)
    assert http.get(href, headers={"Range": "bytes=0-3", "If-Range": '"another"'}).content == whole
    assert http.get(href, headers={"Range": "bytes=0-3", "If-Range": etag}).content == whole[:4]


def test_the_etag_of_a_sector_is_that_of_its_file(http: httpx.Client, city: Path) -> None:
    listed = {entry["href"]: entry["digest"] for entry in http.get("/v1/sectors").json()["sectors"]}
    assert len(set(listed.values())) == len(listed) == len(list((city / "sectors").glob("*.gisec")))
    for href, digest in listed.items():
        assert http.get(href).headers["etag"] == f'"{digest}"'
