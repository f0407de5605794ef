"""The load test against a stand-in server: it reports what happened, each mishap where it belongs, and leaves no player behind."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from server.loadtest import LoadTestError, Options, Stage, run

StandingIn = Callable[..., AbstractContextManager[tuple[Any, str]]]
CONTRACT = {"players", "seconds", "tick_ms", "late_ticks", "volume_ms", "bytes_per_second_per_player", "misses", "pops", "errors"}
COMMAND = [sys.executable, "-c", "from server.cli import main; main()", "loadtest"]


def measure(url: str, **options: Any) -> dict[str, Any]:
    return run(Options(url, **{"players": 2, "seconds": 1.7, **options}), lambda stage: None)


@pytest.mark.parametrize("mode", ["stream", "fetch"])
def test_a_server_that_behaves(standing_in: StandingIn, mode: str) -> None:
    with standing_in() as (world, url):
        report = measure(url, mode=mode, players=3)
        assert not world.players
        assert len(world.made) == 3
        assert all(wish["speed"] == 5.0 and "path" not in wish for wish in world.made)
        assert sorted(wish["seed"] for wish in world.made) == [0, 1, 2]
    assert set(report) >= CONTRACT
    assert report["players"] == 3
    assert report["seconds"] == pytest.approx(1.7, abs=1.0)
    mishaps = [report[name] for name in ("errors", "misses", "late_ticks", "skipped", "pops", "memory_bytes_gained")]
    assert mishaps == [0] * 6, report["error_messages"]
    assert report["tick_ms"] == {"p50": 1.5, "p99": 3.0, "max": 3.0}
    assert report["lateness_ms"] == {"p50": 0.25, "p99": 0.25, "max": 0.25}
    assert report["ticks"] == pytest.approx(30 * report["seconds"], abs=30)
    assert report["cache"]["hits"] == 5 * report["ticks"]
    assert report["memory_bytes"] == 150_000_000
    assert 0 <= report["volume_ms"]["p50"] <= report["volume_ms"]["p99"] < 5000
    assert report["bytes_per_second_per_player"] > 0
    assert len(report["per_second"]) == int(report["seconds"])
    assert [row["memory_bytes"] for row in report["per_second"]] == [150_000_000] * len(report["per_second"])
    if mode == "stream":
        # A full frame at first, then a slab every SLAB_TICKS, and nothing else.
        assert report["full_frames"] == 3
        assert 3 * (1 + 2) <= report["frames"] <= 3 * (1 + 10)
        assert report["volume_ms_since"] == "the tick"
    else:
        assert report["frames"] > 3 * 10


def test_progress_tells_of_players_warm_up_and_test(standing_in: StandingIn) -> None:
    stages: list[Stage] = []
    with standing_in() as (_, url):
        run(Options(url, players=3, seconds=1.2, warm_up_s=1.5), stages.append)
    found = {name: [stage for stage in stages if stage.name == name] for name in dict.fromkeys(stage.name for stage in stages)}
    assert list(found) == ["new players", "warm-up", "3 players"]
    assert [(stage.done, stage.whole) for stage in found["new players"]] == [(1, 3), (2, 3), (3, 3)]
    assert len(found["warm-up"]) == 2
    assert found["3 players"][-1].done == 1.2
    for some in found.values():
        assert [stage.done for stage in some] == sorted(stage.done for stage in some)


def test_a_warm_up_is_not_counted(standing_in: StandingIn) -> None:
    with standing_in() as (_, url):
        started = time.monotonic()
        report = measure(url, warm_up_s=1.0)
        assert time.monotonic() - started >= 2.7
    assert report["seconds"] == pytest.approx(1.7, abs=0.9)
    assert report["ticks"] == pytest.approx(30 * report["seconds"], abs=20)


@pytest.mark.parametrize("mode", ["stream", "fetch"])
def test_pops_are_counted(standing_in: StandingIn, mode: str) -> None:
    with standing_in(pops=True, since=0, every=2) as (_, url):
        report = measure(url, mode=mode)
    # One voxel of each of two players, every tick; who fetches may come too late for some.
    assert (30 if mode == "stream" else 5) <= report["pops"] <= 2 * 30 * (report["seconds"] + 1)
    assert report["errors"] == 0
    assert sum(row["pops"] for row in report["per_second"]) <= report["pops"]


def test_a_larger_bound_lets_them_pass(standing_in: StandingIn) -> None:
    with standing_in(pops=True, since=0, every=2) as (_, url):
        assert measure(url, pop_bound=0.7)["pops"] == 0  # 1 to 3 is a change by two thirds of the greater


def test_a_jump_of_the_clock_excuses_pops(standing_in: StandingIn) -> None:
    with standing_in(pops=True, clock_jumps=True, since=0, every=6) as (_, url):
        report = measure(url)
    assert report["pops"] == 0
    assert report["pops_in_jumps"] > 0
    assert any(row["jump"] for row in report["per_second"])


def test_a_lost_frame_is_an_error_and_a_full_one_is_asked_for(standing_in: StandingIn) -> None:
    # Ticks at which the volume moves, so that there is a frame to lose.
    with standing_in(drops_frames=True, since=20, every=20) as (world, url):
        report = measure(url, seconds=2.2)
        assert world.asked_full >= 2
    assert 2 <= report["errors"] <= 12
    assert report["full_frames"] >= 4
    assert all("FrameLostError" in text for text in report["error_messages"])


def test_a_server_that_still_warms_up_is_asked_again(standing_in: StandingIn) -> None:
    with standing_in(starts_after=3) as (world, url):
        report = measure(url, seconds=1.0)
        assert world.refused == 3
    assert report["errors"] == 0
    assert report["frames"] > 2


def test_players_whose_replies_were_lost_are_deleted_too(standing_in: StandingIn) -> None:
    with standing_in(loses_replies=True) as (world, url):
        with pytest.raises(LoadTestError, match="POST /v1/players: status 500"):
            measure(url, seconds=1.0)
        assert world.made
        assert not world.players


@pytest.mark.parametrize(("fault", "text"), [("sends_garbage", "StreamError"), ("closes", "closed"), ("fails_volumes", "status 500")])
def test_errors_are_counted_and_the_test_goes_on(standing_in: StandingIn, fault: str, text: str) -> None:
    with standing_in(**{fault: True, "since": 0, "every": 15}) as (world, url):
        report = measure(url, seconds=2.0, mode="fetch" if fault == "fails_volumes" else "stream")
        assert not world.players
    assert report["errors"] >= 2
    assert any(text in message for message in report["error_messages"])
    assert report["frames"] > 2  # more than the first of each player


def test_late_and_skipped_ticks_misses_and_memory_are_what_the_server_gained(standing_in: StandingIn) -> None:
    with standing_in(is_late=True, misses=True, skips=True, grows=True, since=0, every=10) as (_, url):
        report = measure(url)
    assert 4 <= report["late_ticks"] == report["misses"] == report["skipped"] <= 12
    assert report["memory_bytes_gained"] == 1_000_000 * report["late_ticks"]
    assert report["tick_ms"] == {"p50": 1.5, "p99": 50.0, "max": 50.0}
    assert report["lateness_ms"]["p99"] == pytest.approx(50 - 1000 / 30, abs=0.001)


def test_percentiles_are_of_each_tick_of_the_whole_test(standing_in: StandingIn) -> None:
    """Late at the beginning and never again: whoever asks in the end how the last ticks went does not hear of it."""
    seen: list[Any] = []
    with standing_in(is_late=True, since=0, every=1, until=45) as (world, url):
        options = Options(url, players=1, seconds=3.7)
        report = run(options, lambda stage: seen.append(stage.recorder))
        assert world.tick > 45
    assert seen[0] is None, "before there are clients"
    seen = [recorder for recorder in seen if recorder is not None]
    ticks = len(seen[0].every("tick_ms"))
    # Ticks in order and none twice; the one that is under way when the server is asked is told of the next time.
    assert ticks == pytest.approx(report["ticks"], abs=1)
    assert report["tick_ms"]["max"] == 50.0
    assert 50.0 in seen[0].seconds[0].tick_ms
    assert max(seen[0].seconds[3].tick_ms) == 3.0
    assert report["per_second"][0]["tick_ms_p99"] == 50.0
    assert report["per_second"][2]["tick_ms_p99"] == 3.0


def test_a_server_without_live_figures(standing_in: StandingIn) -> None:
    with standing_in(has_no_live=True) as (_, url):
        report = measure(url)
    assert report["tick_ms"] == report["lateness_ms"] == {"p50": None, "p99": None, "max": None}
    assert report["skipped"] is None
    assert report["misses"] is None
    assert report["errors"] > 0
    assert report["frames"] > 0


def test_paths_speed_and_token_reach_the_server(standing_in: StandingIn, tmp_path: Path) -> None:
    path, token = tmp_path / "path.json", tmp_path / "token"
    path.write_text("[[[0, 1, 2], [3, 4, 5]], [[6, 7, 8], [9, 0, 1.5], [6, 7, 8]]]")
    token.write_text("0123456789abcdef\n")
    with standing_in(token="0123456789abcdef") as (world, url):
        options = ["--players", "3", "--seconds", "1", "--path", str(path), "--speed", "30", "--token-file", str(token), "--seed", "9"]
        done = subprocess.run([*COMMAND, url, *options], check=False, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        assert not world.players
        wishes = sorted(world.made, key=lambda wish: wish["seed"])
        there, round_and_round = [[0, 1, 2], [3, 4, 5]], [[6, 7, 8], [9, 0, 1.5], [6, 7, 8]]
        assert [wish["path"] for wish in wishes] == [there, round_and_round, there]
        assert [wish["loop"] for wish in wishes] == [False, True, False]
        assert all(wish["speed"] == 30 for wish in world.made)
        refused = subprocess.run([*COMMAND, url], check=False, capture_output=True, text=True, timeout=60)
    assert refused.returncode == 2
    assert "--token-file" in refused.stderr
    assert "\n" not in refused.stderr.strip()


def test_files_thresholds_and_exit_status(standing_in: StandingIn, tmp_path: Path) -> None:
    out, plot = tmp_path / "out.json", tmp_path / "out.png"
    with standing_in(is_late=True, skips=True, grows=True, since=0, every=10) as (_, url):
        limits = ["--max-tick-p99-ms", "4", "--max-late-share", "0.01", "--max-misses", "0", "--max-errors", "0", "--max-megabits", "24"]
        limits += ["--max-lateness-p99-ms", "1", "--max-skipped", "0", "--max-cache-miss-share", "0.9", "--max-memory-gained-mb", "0.5"]
        command = [*COMMAND, url, "--seconds", "1.2", "--json", str(out), "--plot", str(plot), *limits]
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    lines = [line for line in done.stderr.splitlines() if line.startswith("sectorlight: ")]
    assert [line.split(":")[1].strip() for line in lines] == [
        "--max-tick-p99-ms 4",
        "--max-lateness-p99-ms 1",
        "--max-late-share 0.01",
        "--max-skipped 0",
        "--max-memory-gained-mb 0.5",
    ]
    assert lines[0].endswith("was 50")
    assert set(json.loads(out.read_text())) >= CONTRACT
    with Image.open(plot) as picture:
        picture.load()
        assert len(picture.getcolors(1 << 20)) > 4
    assert all(name in done.stdout for name in ("tick p50", "lateness p50", "skipped", "cache hits"))


def test_ctrl_c_deletes_the_players_and_still_reports(standing_in: StandingIn, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    with standing_in() as (world, url):
        command = [*COMMAND, url, "--players", "2", "--seconds", "600", "--json", str(out)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            deadline = time.monotonic() + 60
            while len(world.players) < 2 and time.monotonic() < deadline:
                time.sleep(0.05)
            time.sleep(1.5)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=30)
        assert process.returncode == 130, errors
        assert "Traceback" not in errors
        assert len(world.made) == 2
        assert not world.players
    report = json.loads(out.read_text())
    assert report["interrupted"]
    assert report["frames"] > 0
    assert report["errors"] == 0, report["error_messages"]


def test_a_server_that_dies_is_a_report_full_of_errors(standing_in: StandingIn, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    with standing_in() as (world, url):
        command = [*COMMAND, url, "--players", "2", "--seconds", "3", "--json", str(out), "--max-errors", "0"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        deadline = time.monotonic() + 60
        while len(world.players) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(1.0)
    with process:
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 1, errors
    assert "Traceback" not in errors
    assert "--max-errors 0" in errors
    assert json.loads(out.read_text())["errors"] > 2
