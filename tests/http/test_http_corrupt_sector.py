"""A damaged sector file: its own light is refused by name, everything else keeps being served."""

import io
import logging
import math
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from serving import until

from gi_core.constants import VOXEL_NO_SECTOR
from server.app import create_app
from server.live import LiveOptions
from server.settings import Settings

Serving = Callable[[FastAPI], AbstractContextManager[httpx.Client]]
ProblemOf = Callable[[httpx.Response], dict[str, Any]]


def truncate(data: bytes) -> bytes:
    return data[: len(data) // 2]


def flip_a_bit(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def empty(_: bytes) -> bytes:
    return b""


def overwrite(data: bytes) -> bytes:
    return b"\xff" * len(data)


@pytest.fixture
def damaged_city(city: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "city"
    shutil.copytree(city, copy)
    return copy


@pytest.mark.parametrize("damage", [truncate, flip_a_bit, empty, overwrite])
def test_only_what_needs_the_damaged_sector_is_refused(
    damaged_city: Path,
    serving: Serving,
    problem_of: ProblemOf,
    moment: dict[str, Any],
    caplog: pytest.LogCaptureFixture,
    damage: Callable[[bytes], bytes],
) -> None:
    # The sectors at the city's two ends; a volume centred 30 m beyond one end does not reach the other.
    x, z = max(tuple(map(int, path.stem.split("_"))) for path in (damaged_city / "sectors").iterdir())
    file = damaged_city / "sectors" / f"{x}_{z}.gisec"
    original = file.read_bytes()
    file.write_bytes(damage(original))
    with serving(create_app(damaged_city, Settings())) as http, caplog.at_level(logging.ERROR):
        bounds = http.get("/v1/world").json()["bounds"]
        there = {**moment, "x": 64 * x + 10, "y": 10, "z": 64 * z + 10}
        elsewhere = {**moment, "x": bounds["minimum"][0] - 30, "y": 10, "z": bounds["minimum"][2]}
        for _ in range(2):  # refused the second time too: nothing half-read is kept
            refused = http.get("/v1/volume", params=there)
            problem = problem_of(refused)
            assert (refused.status_code, problem["code"]) == (503, "corrupt_file")
            assert file.name in problem["detail"]
            assert str(damaged_city) not in problem["detail"]  # the operator's folders are not the client's business
        assert file.name in caplog.text
        assert http.get("/v1/volume", params=elsewhere).status_code == 200
        assert problem_of(http.get(f"/v1/sectors/{x},{z}"))["code"] == "corrupt_file"

        ready = http.get("/readyz")
        assert (ready.status_code, ready.json()["status"]) == (200, "degraded")
        assert [entry["sector"] for entry in ready.json()["refused_sectors"]] == [[x, z]]
        assert file.name in ready.json()["refused_sectors"][0]["reason"]

        # Restored, it is served again without a restart.
        file.write_bytes(original)
        assert http.get("/v1/volume", params=there).status_code == 200
        assert http.get("/readyz").json()["status"] == "ready"


def test_a_truncated_or_missing_sector_is_named_before_anyone_asks_for_it(
    damaged_city: Path, serving: Serving, caplog: pytest.LogCaptureFixture
) -> None:
    first, last = sorted((damaged_city / "sectors").iterdir())[:: len(list((damaged_city / "sectors").iterdir())) - 1]
    first.write_bytes(truncate(first.read_bytes()))
    last.unlink()
    with caplog.at_level(logging.ERROR), serving(create_app(damaged_city, Settings())) as http:
        named = {tuple(entry["sector"]) for entry in http.get("/readyz").json()["refused_sectors"]}
    assert named == {tuple(map(int, path.stem.split("_"))) for path in (first, last)}
    assert first.name in caplog.text
    assert last.name in caplog.text


def test_a_live_world_reports_the_damaged_sector_and_heals_with_it(
    damaged_city: Path, serving: Serving, wait_until_live: Callable[[httpx.Client], None], street: tuple[float, ...]
) -> None:
    """Meanwhile the distant probe stands in its place, and ticks go on."""
    x, z = (math.floor(street[axis] / 64) for axis in (0, 2))
    file = damaged_city / "sectors" / f"{x}_{z}.gisec"
    original = file.read_bytes()
    file.write_bytes(truncate(original))
    with serving(create_app(damaged_city, Settings(live=LiveOptions(ticks_per_second=10)))) as http:
        wait_until_live(http)
        assert http.post("/v1/players", json={"id": "a", "path": [street], "speed": 0}).status_code == 201

        def volume(**query: Any) -> np.ndarray:
            return np.load(io.BytesIO(http.get("/v1/players/a/volume", params=query).content))

        (failure,) = until(lambda: http.get("/v1/live").json()["failures"])
        assert failure["sector"] == [x, z]
        assert file.name in failure["reason"]
        assert str(damaged_city) not in failure["reason"]
        until(lambda: http.get("/v1/players/a/volume").status_code == 200)
        missing = volume(mask=1) == VOXEL_NO_SECTOR
        assert missing.any()
        assert (volume()[:, missing].max(axis=(0, 2)) > 0).all()
        before = until(lambda: (live := http.get("/v1/live").json())["misses"] > 0 and live)
        file.write_bytes(original)
        after = until(lambda: (live := http.get("/v1/live").json())["failures"] == [] and live)
        assert after["failed_ticks"] == 0
        assert after["ticks"] > before["ticks"]
        until(lambda: (volume(mask=1)[missing] != VOXEL_NO_SECTOR).any())
