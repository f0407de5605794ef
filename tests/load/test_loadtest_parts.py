"""The load test's arithmetic, files and picture, without a server."""

import asyncio
import json
import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from rich.console import Console

from gi_core.errors import InputError, SectorlightError
from server.loadtest import _ask_clock, _ask_live, _player_name
from server.loadtest_clients import Watch, count_pops, read_reply
from server.loadtest_command import checked_url, read_paths, table_of
from server.loadtest_limits import Limits, missed
from server.loadtest_plot import _round_up, draw
from server.loadtest_record import Live, Recorder, Setting, percentile, report_of
from server.stream_header import StreamError

CACHE = {"hits": 7, "misses": 3, "player_volume_hits": 0, "player_volume_misses": 0}
SETTING = Setting(players=2, mode="stream", speed=5.0, pop_bound=0.2, same_clock=True)


def some_report(setting: Setting = SETTING, latencies: tuple[float, ...] = (4.0, 6.0, 30.0)) -> dict[str, Any]:
    def said(at: float, tick: int, recent: list[int], **members: Any) -> Live:
        times = {"tick": recent, "ms": [2.0 + 88.0 * (n == 110) for n in recent], "lateness_ms": [0.5 * n for n in recent]}
        return Live(at, {"tick": tick, "tick_rate": 30, "recent": times, "late_ticks": 5, "ticks": 100, "misses": 1, **members})

    recorder = Recorder()
    recorder.server(said(0.0, 100, [], memory_bytes=4, skipped=1, cache=dict.fromkeys(CACHE, 0)))
    recorder.server(said(1.2, 136, list(range(100, 136)), memory_bytes=6, skipped=3, cache=CACHE))
    for number, latency in enumerate(latencies):
        recorder.message(number + 0.5, 1000, latency)
    recorder.pops(0.5, 3)
    recorder.error(1.5, "x")
    recorder.server(said(3.0, 190, list(range(136, 190)), late_ticks=8, ticks=190, memory_bytes=5, skipped=3, cache=CACHE))
    return report_of(recorder, setting, 3.0, 0.5, False)


def test_a_report_sums_up() -> None:
    report = some_report()
    assert report["bytes_per_second_per_player"] == 500
    assert report["volume_ms"] == {"p50": 6.0, "p99": 30.0}
    # 90 ticks, of which one is no percent.
    assert report["tick_ms"] == {"p50": 2.0, "p99": 90.0, "max": 90.0}
    assert report["lateness_ms"] == {"p50": 72.0, "p99": 94.5, "max": 94.5}
    # Each tick in its own second, whenever the server was asked.
    assert [row["tick_ms_p99"] for row in report["per_second"]] == [90.0, 2.0, 2.0]
    assert [row["lateness_ms_p99"] for row in report["per_second"]] == [64.5, 79.5, 94.5]
    assert [row["memory_bytes"] for row in report["per_second"]] == [4, 6, 5]
    assert [row["skipped"] for row in report["per_second"]] == [0, 2, 0]
    assert (report["skipped"], report["memory_bytes_gained"], report["cache"]["hits"]) == (2, 1, 7)
    assert (report["late_ticks"], report["ticks"], report["misses"], report["pops"], report["errors"]) == (3, 90, 0, 3, 1)
    assert [row["bytes_per_player"] for row in report["per_second"]] == [500, 500, 500]
    assert [row["errors"] for row in report["per_second"]] == [0, 1, 0]
    json.dumps(report, allow_nan=False)


def test_latencies_of_another_machine_start_at_the_quickest() -> None:
    other = Setting(2, "stream", 5.0, 0.2, same_clock=False)
    assert some_report(other)["volume_ms"] == {"p50": 2.0, "p99": 26.0}
    assert some_report(other)["volume_ms_since"] == "the quickest frame"
    assert some_report(latencies=(-50.0, -49.0, -40.0))["volume_ms"] == {"p50": 1.0, "p99": 10.0}


def test_percentiles_are_values_that_occurred() -> None:
    assert percentile([3.0, 1.0, 2.0], 0.5) == 2.0
    assert percentile([1.0] * 99 + [9.0], 0.99) == 1.0
    assert percentile([1.0] * 98 + [9.0] * 2, 0.99) == 9.0
    assert percentile([], 0.5) is None


def test_errors_are_counted_but_not_all_quoted() -> None:
    recorder = Recorder()
    for number in range(1000):
        recorder.error(0.0, f"error {number}")
    assert recorder.total("errors") == 1000 == sum(recorder.errors.values())
    assert len(recorder.errors) <= 21


def test_only_great_changes_in_free_air_pop() -> None:
    before, after = np.full((6, 5, 3), 100, np.float32), np.full((6, 5, 3), 100, np.float32)
    after[:, 0], after[:, 1], after[:, 2] = 130, 115, 500
    after[0, 3] = 200  # one face of six: 17 % of the mean
    before[:, 4] = np.nan
    classes = np.array([1, 1, 0, 2, 1], np.uint8)
    assert count_pops(before, after, classes, floor=1.0, basis="cube", bound=0.2) == 1
    assert count_pops(before, after, classes, floor=1.0, basis="cube", bound=0.1) == 3
    assert count_pops(after, before, classes, floor=1.0, basis="cube", bound=0.2) == 1
    assert count_pops(before, after, classes, floor=40.0, basis="cube", bound=0.2) == 0


def test_limits_name_what_was_missed() -> None:
    report = some_report()
    held = {"tick_p99_ms": 90.0, "lateness_p99_ms": 94.5, "late_share": 3 / 90, "skipped": 2, "volume_p99_ms": 30.0, "megabits": 0.004}
    held |= {"misses": 0, "pops": 3, "errors": 1, "cache_miss_share": 0.3, "memory_gained_mb": 1e-6}
    assert set(held) == {member.name for member in fields(Limits)}
    assert list(missed(report, Limits(**held))) == []
    lines = list(missed(report, Limits(**{name: bound - 1e-7 for name, bound in held.items()})))
    assert [line.split()[0] for line in lines] == [f"--max-{name.replace('_', '-')}" for name in held]
    unknown = report_of(Recorder(), SETTING, 3.0, 0.5, False)
    lines = [line for line in missed(unknown, Limits(**held)) if "not known" in line]
    assert len(lines) == len(held) - len(["megabits", "pops", "errors"])  # which the clients count


def test_units_in_brackets_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    report = some_report() | {"error_messages": {"found [/] there": 2}}
    Console(width=120).print(table_of(report))
    shown = capsys.readouterr().out
    assert "p50 / p99 / max [ms]" in shown
    assert "found [/] there" in shown


def test_a_picture_and_a_table_of_any_report() -> None:
    for report in (some_report(), report_of(Recorder(), SETTING, 0.2, 0.95, True)):
        assert draw(report).size == (900, 940)
        assert table_of(report).row_count >= 10


@pytest.mark.parametrize(("value", "expected"), [(0, 1), (0.03, 0.05), (0.1, 0.1), (1, 1), (1.1, 2), (33.3, 50), (501, 1000)])
def test_axes_end_at_round_numbers(value: float, expected: float) -> None:
    assert _round_up(value) == pytest.approx(expected)


def test_path_files(tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    file.write_text("[[0, 1, 2], [3, 4, 5.5]]")
    assert read_paths(file) == [((0, 1, 2), (3, 4, 5.5))]
    file.write_text("[[[0, 1, 2], [3, 4, 5.5]], [[1, 1, 1], [2, 2, 2], [3, 3, 3]]]")
    assert [len(path) for path in read_paths(file)] == [2, 3]
    line = '{"type": "LineString", "coordinates": [[0, 2, 1], [3, 5.5, 4]]}'
    file.write_text(line)
    assert read_paths(file) == [((0, 1, 2), (3, 4, 5.5))]
    feature = f'{{"type": "Feature", "geometry": {line}, "properties": {{}}}}'
    file.write_text(f'{{"type": "FeatureCollection", "features": [{feature}, {feature}]}}')
    assert read_paths(file) == 2 * [((0, 1, 2), (3, 4, 5.5))]
    for text in (
        "",
        "{}",
        '{"type": "FeatureCollection", "features": []}',
        '{"type": "FeatureCollection", "features": [1]}',
        '{"type": "LineString", "coordinates": [[0, 2], [3, 5]]}',
        "[]",
        "[[]]",
        "[[0, 1, 2]]",
        "[[0, 1], [2, 3]]",
        "[[0, 1, NaN], [0, 1, 2]]",
        "[[0, 1, true], [0, 1, 2]]",
        "[1, 2, 3]",
    ):
        file.write_text(text)
        with pytest.raises(InputError, match="--path"):
            read_paths(file)
    with pytest.raises(InputError, match="none"):
        read_paths(tmp_path / "none")


def test_addresses() -> None:
    assert checked_url("http://127.0.0.1:8000/") == "http://127.0.0.1:8000"
    assert checked_url("https://[::1]:8000") == "https://[::1]:8000"
    for text in ("", "127.0.0.1:8000", "ftp://x", "http://", "http://x/v1", "http://x:99999", "http://x?a", "http://[::"):
        with pytest.raises(InputError, match="URL"):
            checked_url(text)


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Gi-Volume": "{"},
        {"Gi-Volume": "[]"},
        {"Gi-Tick": "x"},
        {"shape": [6, 4, 8, 8, 3]},
        {"shape": [6, 4, 8, 9, 4]},
        {"shape": []},
        {"shape": [6, 4, 8, math.inf, 4]},
        {"basis": "sh1"},
        {"basis": "x"},
        {"scale": math.nan},
        {"scale": 10**400},
    ],
)
def test_replies_that_do_not_fit_together_are_refused(headers: dict[str, Any]) -> None:
    facts = {"shape": [6, 4, 8, 8, 4], "scale": 1.0, "basis": "cube", "origin": [0, 0, 0]}
    facts |= {name: value for name, value in headers.items() if name in facts}
    given = {} if not headers else {"Gi-Volume": json.dumps(facts), "Gi-Tick": "3"} | {k: v for k, v in headers.items() if k not in facts}
    with pytest.raises(StreamError):
        read_reply(httpx.Response(200, content=bytes(6 * 4 * 8 * 8 * 4 * 2), headers=given))


HUGE, DEEP = "1" + "0" * 400, "[" * 100_000
STRANGE_FIGURES = {
    "tick": ["null", HUGE, "1e308", "NaN"],
    "tick_rate": [HUGE, "1e-320", "-1", "1e308"],
    "memory_bytes": ["-1e308", HUGE, "{}"],
    "cache": ['{"hits": 1e308}', "7"],
    "recent": ["[]", '{"tick": [1e999], "ms": [1], "lateness_ms": [1]}', '{"tick": [1], "ms": [NaN], "lateness_ms": [1]}'],
}


def asked(ask: Callable[[httpx.AsyncClient, Watch], Any], *texts: str) -> Recorder:
    """What is recorded of a server that gives these replies, in this order."""
    replies, recorder = iter(texts), Recorder()

    async def ask_all() -> None:
        transport = httpx.MockTransport(lambda request: httpx.Response(200, text=next(replies)))
        async with httpx.AsyncClient(transport=transport, base_url="http://x") as http:
            for at in range(len(texts)):
                await ask(http, Watch(recorder, lambda at=at: float(at), 0.2))

    asyncio.run(ask_all())
    return recorder


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in STRANGE_FIGURES.items() for value in values])
def test_whatever_a_server_says_of_itself_there_is_a_report_and_a_picture(name: str, value: str) -> None:
    said = {"tick": "9", "tick_rate": "30", "memory_bytes": "4", "recent": '{"tick": [8], "ms": [1.5], "lateness_ms": [0]}'}
    texts = ["{" + ", ".join(f'"{key}": {text}' for key, text in members.items()) + "}" for members in (said, said | {name: value})]
    report = report_of(asked(_ask_live, *texts), SETTING, 3.0, 0.5, False)
    json.dumps(report, allow_nan=False)
    draw(report)
    table_of(report)


@pytest.mark.parametrize("text", [DEEP, "[]", "no", "null"])
def test_what_is_no_object_is_an_error_and_no_crash(text: str) -> None:
    assert asked(_ask_live, text).total("errors") == 1
    with pytest.raises(SectorlightError, match="id"):
        _player_name(httpx.Response(201, text=text))


@pytest.mark.parametrize("name", ["", "a\nb", "../x", "\ud800", "x" * 65, 7, None])
def test_a_player_whose_name_is_no_id_is_refused(name: object) -> None:
    with pytest.raises(SectorlightError, match="id"):
        _player_name(httpx.Response(201, text=json.dumps({"id": name})))
    assert _player_name(httpx.Response(201, json={"id": "loadtest-1"})) == "loadtest-1"


@pytest.mark.parametrize("text", [DEEP, "[]", "{}", f'{{"paused": false, "rate": {HUGE}, "time": "2024-06-21T12:00"}}'])
def test_a_clock_that_makes_no_sense_is_no_jump(text: str) -> None:
    good = '{"paused": false, "rate": 1, "time": "2024-06-21T12:00:00"}'
    found = []

    async def ask(http: httpx.AsyncClient, watch: Watch) -> None:
        found.append(await _ask_clock(http, watch, found[-1] if found else None))

    assert not asked(ask, good, text).jumps
    assert found[1] == found[0]
