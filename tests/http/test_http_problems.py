"""Bad input is refused by name, as problem+json, and never as our failure."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import Any, get_args

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from starlette.requests import Request

from gi_core.errors import InputError
from server.dependencies import refuse_repeated_parameters
from server.preview_views import ViewName
from server.write_access import read_json_object

ProblemOf = Callable[[httpx.Response], dict[str, Any]]
GOOD = {"time": "12:00", "weather": "clear", "x": "0", "y": "5", "z": "0"}

BAD: list[tuple[str, dict[str, str], str]] = [
    ("/v1/volume", {**GOOD, "time": "25:99"}, "time"),
    ("/v1/volume", {**GOOD, "time": ""}, "time"),
    ("/v1/volume", {**GOOD, "time": "9" * 65}, "time"),
    ("/v1/volume", {**GOOD, "weather": "plague"}, "clear"),
    ("/v1/volume", {**GOOD, "weather": "snow:nan"}, "snow"),
    ("/v1/volume", {**GOOD, "x": "nan"}, "x"),
    ("/v1/volume", {**GOOD, "y": "-inf"}, "y"),
    ("/v1/volume", {**GOOD, "z": "1e30"}, "z"),
    ("/v1/volume", {"time": "12:00"}, "weather"),
    ("/v1/volume", {**GOOD, "format": "exe"}, "'npy', 'raw' or 'ktx2'"),
    ("/v1/volume", {**GOOD, "format": "raw", "encoding": "bc6h"}, "'f16'"),
    ("/v1/volume", {**GOOD, "basis": "sh2"}, "baked in cube; expected cube, found sh2"),
    ("/v1/volume", {**GOOD, "cascade": "4"}, "cascade"),
    ("/v1/volume", {**GOOD, "kind": "indoor"}, "'outdoor', 'interior' or 'fog'"),
    ("/v1/volume", {**GOOD, "mask": "maybe"}, "mask"),
    ("/v1/volume", {**GOOD, "kind": "interior", "room": ""}, "or a number of 1 to"),
    ("/v1/volume", {**GOOD, "fromat": "raw"}, "fromat"),
    ("/v1/world", {"verbose": "1"}, "verbose"),
    ("/healthz", {"x": "1"}, "x"),
    ("/v1/sky", {"time": "12:00", "weather": "clear", "format": "hdr"}, "'npy' or 'exr'"),
    ("/v1/probes", {**GOOD, "radius": "1e6"}, "radius"),
    ("/v1/probes", {**GOOD, "radius": "-1"}, "radius"),
    ("/v1/decals", {"x": "0", "y": "0", "z": "0", "radius": "501"}, "radius"),
    ("/v1/decals", {"x": "0", "y": "0"}, "z"),
    ("/v1/decals", GOOD, "time"),
    ("/v1/decals/gradient.png", {"size": "9"}, "size"),
    ("/v1/sectors/one,two", {}, "x"),
    ("/v1/preview.png", {"time": "12:00", "weather": "clear", "eye": "1,2", "look": "0,0,0"}, "eye"),
    ("/v1/preview.png", {"time": "12:00", "weather": "clear", "eye": "1,2,3", "look": "1,2,3"}, "look"),
    ("/v1/preview.png", {"time": "12:00", "weather": "clear", "eye": "1,2,3", "look": "0,0,0", "width": "100000"}, "width"),
    ("/v1/preview.png", {"time": "12:00", "weather": "clear", "eye": "1,2,3", "look": "0,0,0", "gi": "wrong"}, "gi"),
]


@pytest.mark.parametrize(("path", "query", "named"), BAD, ids=[f"{p} {n}" for p, _, n in BAD])
def test_bad_parameters_are_named(http: httpx.Client, problem_of: ProblemOf, path: str, query: dict[str, str], named: str) -> None:
    reply = http.get(path, params=query)
    assert reply.status_code == 400
    assert named in problem_of(reply)["detail"]


def test_codes_are_stable(http: httpx.Client, problem_of: ProblemOf) -> None:
    """Clients branch on these."""
    expected = {
        "unknown_time": ("/v1/volume", {**GOOD, "time": "25:99"}, 400),
        "unknown_weather": ("/v1/volume", {**GOOD, "weather": "plague"}, 400),
        "bad_parameter": ("/v1/volume", {**GOOD, "x": "east"}, 400),
        "outside_world": ("/v1/volume", {**GOOD, "x": "90000"}, 404),
        "no_such_sector": ("/v1/sectors/999999,999999", {}, 404),
        "no_such_path": ("/v1/nothing", {}, 404),
    }
    for code, (path, query, status) in expected.items():
        reply = http.get(path, params=query)
        assert (problem_of(reply)["code"], reply.status_code) == (code, status)


def test_a_position_outside_is_told_the_bounds(http: httpx.Client, problem_of: ProblemOf) -> None:
    for query in ({**GOOD, "x": "90000"}, {**GOOD, "z": "-90000"}, {**GOOD, "y": "90000"}):
        for path in ("/v1/volume", "/v1/probes"):
            reply = http.get(path, params=query)
            assert reply.status_code == 404
            assert "expected" in problem_of(reply)["detail"]


def test_a_parameter_given_twice_is_refused(http: httpx.Client, problem_of: ProblemOf) -> None:
    reply = http.get("/v1/lighting?time=12:00&time=13:00&weather=clear")
    assert reply.status_code == 400
    assert "time" in problem_of(reply)["detail"]


def test_as_many_parameters_as_a_request_can_hold_are_looked_through_in_no_time() -> None:
    """On the event loop, where all requests wait: comparing each with each took three seconds."""
    names = [f"{number:x}" for number in range(13_000)]  # 64 kB, the longest line that the server reads
    for query, repeated in (("&".join(names), False), ("&".join([*names, "0"]), True)):
        request = Request({"type": "http", "query_string": query.encode()})
        started = time.process_time()
        with pytest.raises(InputError, match="found 0 more than once") if repeated else contextlib.nullcontext():
            asyncio.run(refuse_repeated_parameters(request))
        assert time.process_time() - started < 1.0


def test_a_client_that_goes_away_within_its_body_is_no_failure_of_ours() -> None:
    async def receive() -> dict[str, str]:
        return {"type": "http.disconnect"}

    request = Request({"type": "http", "headers": [(b"content-type", b"application/json")]}, receive)
    with pytest.raises(InputError, match="went away"):
        asyncio.run(read_json_object(request))


def test_other_methods_are_refused_with_what_is_allowed(http: httpx.Client, problem_of: ProblemOf) -> None:
    for method in ("POST", "PUT", "DELETE", "PATCH"):
        reply = http.request(method, "/v1/world")
        assert (reply.status_code, reply.headers["allow"]) == (405, "GET")
        assert problem_of(reply)["code"] == "method_not_allowed"


def test_unknown_paths_are_problems(http: httpx.Client, problem_of: ProblemOf) -> None:
    for path in ("/v1/nothing", "/v1/sectors/1", "/v1/world/", "/viewer/none.js", "/viewer/..%2fapp.py", "/%00", "/" + "a" * 3000):
        reply = http.get(path)
        assert reply.status_code == 404
        assert len(problem_of(reply)["detail"]) < 300


def test_problems_are_not_cached(http: httpx.Client) -> None:
    assert http.get("/v1/volume", params={**GOOD, "weather": "plague"}).headers["cache-control"] == "no-store"


NAMES = [
    "time",
    "weather",
    "x",
    "y",
    "z",
    "radius",
    "format",
    "encoding",
    "mask",
    "eye",
    "look",
    "fov",
    "gi",
    "cascade",
    "basis",
    "room",
    "kind",
]
NUMBERS = st.floats().map(str) | st.integers().map(str)
TIMES = st.times().map(str) | st.datetimes().map(lambda moment: moment.isoformat())
WEATHERS = st.builds("{}:{}".format, st.sampled_from(["clear", "snow", "fog"]), NUMBERS | st.text(max_size=8))
VALUES = (
    NUMBERS
    | TIMES
    | WEATHERS
    | st.text(max_size=30)
    | st.sampled_from(["clear", "12:00", "npy", "raw", "ktx2", "exr", "f16", "rgb9e5", "on", "0,5,9", "1", "-1", "3", "interior", "fog"])
)
ROUTES = [
    "/v1/volume",
    "/v1/lighting",
    "/v1/sky",
    "/v1/distant",
    "/v1/probes",
    "/v1/preview.png",
    "/v1/world",
    "/v1/sectors",
    "/v1/decals",
    "/readyz",
]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(path=st.sampled_from(ROUTES), query=st.dictionaries(st.sampled_from(NAMES) | st.text(max_size=5), VALUES, max_size=6))
def test_no_query_is_our_failure(http: httpx.Client, path: str, query: dict[str, str]) -> None:
    assert http.get(path, params=_encodable(query)).status_code < 500


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(
    path=st.sampled_from(["/v1/volume", "/v1/probes"]),
    changes=st.dictionaries(st.sampled_from([*NAMES[:9], *NAMES[-4:]]), VALUES, max_size=2),
)
def test_no_almost_good_query_is_our_failure(http: httpx.Client, path: str, changes: dict[str, str]) -> None:
    assert http.get(path, params=_encodable({**GOOD, **changes})).status_code < 500


EYES = st.tuples(*[st.floats(-1e7, 1e7) | st.floats(-300, 300)] * 3).map(lambda eye: ",".join(f"{v:.17g}" for v in eye))


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(
    eye=EYES,
    look=EYES,
    fov=st.floats(1, 150),
    options=st.fixed_dictionaries({"gi": st.sampled_from(["on", "off", "split"]), "distant": st.sampled_from(["on", "off", "client"])})
    | st.fixed_dictionaries({"view": st.sampled_from(get_args(ViewName))}),
    fog=st.sampled_from(["0", "1e-9", "0.03", "0.2"]),
)
def test_no_camera_is_our_failure(http: httpx.Client, eye: str, look: str, fov: float, options: dict[str, str], fog: str) -> None:
    query: dict[str, Any] = {"time": "12:00", "weather": f"clear:fog_density={fog}", "eye": eye, "look": look, "fov": fov, "width": 16}
    query |= options
    assert http.get("/v1/preview.png", params=query).status_code < 500


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(target=st.binary(max_size=60))
def test_no_bytes_after_the_question_mark_are_our_failure(http: httpx.Client, target: bytes) -> None:
    query = bytes(b for b in target if 0x21 <= b < 0x7F and b != ord("#"))
    reply = http.send(httpx.Request("GET", http.base_url.copy_with(path="/v1/volume", query=query)))
    assert 400 <= reply.status_code < 500


def _encodable(query: dict[str, str]) -> dict[str, str]:
    """Without lone surrogates, which no client can percent-encode."""
    return {name.encode("utf-8", "replace").decode(): value.encode("utf-8", "replace").decode() for name, value in query.items()}
