"""``sectorlight compare``: its options, its files, its refusals. What it measures is held elsewhere."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bake_jobs import cli_compare
from bake_jobs.cli_compare import sectors_of, split_states
from bake_jobs.compare import STAGES
from gi_core import sector_file
from gi_core.dataset import Dataset, write_world
from gi_core.engine import Engine
from gi_core.errors import DeviceError, InputError
from gi_core.grid import SectorIndex
from server import cli

RunCommand = Callable[..., Any]
SOURCE = "procedural:midtown?blocks=1x1&seed=1"
PART = ("--sectors=0:1,0:1",)
SMALL = ("--sectors", "1", "--points", "3", "--samples", "16")


def test_it_prints_a_table_and_writes_json_and_a_chart(sectorlight: RunCommand, city: Path, tmp_path: Path) -> None:
    part = tmp_path / "part"
    shutil.copytree(city, part)
    world = Dataset.open(part).world
    write_world(part, replace(world, sectors={index: facts for index, facts in world.sectors.items() if index != SectorIndex(1, 0)}))
    before = {path: path.stat().st_mtime_ns for path in part.rglob("*")}
    files = ("--json", str(tmp_path / "out.json"), "--plot", str(tmp_path / "out.png"))
    done = sectorlight("compare", str(part), *SMALL, "--states", "noon,dusk=19:00/clear:haze=0.5,cloud_cover=0.2", *files)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out.json").read_text())
    assert (report["preset"], report["basis"]) == ("draft", "cube")
    assert list(report["states"]) == ["noon", "dusk"]
    for stages in report["states"].values():
        assert tuple(stages) == (*STAGES, "shaded_rooms") == ("probes", "near", "mid", "shaded", "floor", "shaded_rooms")
        assert all({"n", "median", "p95", "bias", "nrmse"} <= set(numbers) for numbers in stages.values())
        assert stages["probes"]["n"] == 6 * 3
    assert len(report["sectors"]) == 1
    for word in ("noon", "dusk", *STAGES):
        assert word in done.stdout
    with Image.open(tmp_path / "out.png") as picture:
        assert picture.format == "PNG"
    # The city goes on beyond what was baked: light from there is missing, so the report is not believed, nor is anything written.
    assert {path: path.stat().st_mtime_ns for path in part.rglob("*")} == before
    assert "the report was not stored: sector" in done.stderr
    assert "name its --source" in done.stderr


def test_a_bake_of_many_sectors_measures_itself_once(sectorlight: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli_compare, "BAKE_POINTS", 3)
    monkeypatch.setattr(cli_compare, "BAKE_SAMPLES", 16)
    monkeypatch.setattr(cli, "REPORTED_SECTORS", 2)
    few, many = (("bake", SOURCE, "-o", str(tmp_path / name), "--quality", "draft", *more) for name, *more in (("a", *PART), ("b",)))
    assert sectorlight(*few).returncode == 0
    assert Dataset.open(tmp_path / "a").world.error_report is None
    # What surrounds one of two sectors comes from the source.
    for command in ((*few, "--report"), many):
        done = sectorlight(*command)
        assert done.returncode == 0, done.stderr
        assert "Errors beside the path tracer, 3 points of each of" in done.stderr
        report = Dataset.open(Path(command[3])).world.error_report
        assert report is not None
        assert (list(report["states"]), report["samples"]) == (["noon", "overcast"], 16)
    assert "Errors beside" not in sectorlight(*many).stderr, "it is there already"
    assert sectorlight(*many, "--restart", "--no-report").returncode == 0
    assert Dataset.open(tmp_path / "b").world.error_report is None

    def without_a_device(*_: object, **__: object) -> None:
        raise DeviceError("no OpenCL device")

    monkeypatch.setattr(cli_compare, "compare_dataset", without_a_device)
    done = sectorlight(*many)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (
        0,
        f"sectorlight: {tmp_path / 'b'} is whole, but was not measured: no OpenCL device",
    )
    assert sectorlight(*many, "--report").returncode == 2


def test_the_report_stays_in_the_dataset_and_is_quoted(sectorlight: RunCommand, city: Path, tmp_path: Path) -> None:
    copy = tmp_path / "city"
    shutil.copytree(city, copy)
    source = ("--source", SOURCE)
    done = sectorlight("compare", str(copy), *SMALL, "--states", "noon,overcast", *source, "--json", str(tmp_path / "out.json"))
    assert done.returncode == 0, done.stderr
    measured, kept = json.loads((tmp_path / "out.json").read_text()), Dataset.open(copy).world.error_report
    assert kept is not None
    # The whole city was baked: nothing beyond could be missing, and no source need be named.
    write_world(copy, replace(Dataset.open(copy).world, error_report=None))
    assert sectorlight("compare", str(copy), *SMALL, "--states", "noon").returncode == 0
    assert Dataset.open(copy).world.error_report is not None
    write_world(copy, replace(Dataset.open(copy).world, error_report=kept))
    assert kept["states"] == measured["states"]
    medians = [measured["states"][state]["shaded"]["median"] for state in ("noon", "overcast")]
    assert kept["expected_error"] == pytest.approx(np.median(medians))
    shown = sectorlight("info", str(copy))
    assert f"expected on surfaces: {100 * np.median(medians):.1f} %" in " ".join(shown.stdout.split())  # it may go on in the next line
    assert "overcast" in shown.stdout
    engine = Engine(Dataset.open(copy))
    volume = engine.volume(np.array([30.0, 5.0, 30.0]), engine.lighting("12:00", "clear"))
    assert volume.expected_error == pytest.approx(np.median(medians))
    assert engine.volume(np.array([30.0, 5.0, 30.0]), engine.lighting("12:00", "clear"), cascade=1).expected_error is None
    # Kept by a report that is not to be: one that was not asked to stay, and one of other lamps.
    lamps = tmp_path / "lamps.toml"
    lamps.write_text('[[lamp]]\nname = "one"\nposition = [30, 9, 5]\nlumens = 1.0\n')
    for more in (("--no-store",), ("--lamps", str(lamps))):
        assert sectorlight("compare", str(copy), *SMALL, "--states", "noon", *source, *more).returncode == 0
        assert Dataset.open(copy).world.error_report == kept


def test_a_dataset_that_is_dark_by_day_fails(sectorlight: RunCommand, city: Path, tmp_path: Path) -> None:
    """Every probe's weights set to nothing, as a bake that went wrong would have them: exit 1, nothing stored."""
    copy = tmp_path / "city"
    shutil.copytree(city, copy)
    dataset = Dataset.open(copy)
    sectors = dict(dataset.world.sectors)
    for index, facts in sectors.items():
        path = dataset.sector_path(index)
        sector, meta = sector_file.read(path)
        data = sector_file.encode(replace(sector, factor_scale=np.zeros_like(sector.factor_scale)), meta, dataset.world.sky_patches)
        path.write_bytes(data)
        sectors[index] = replace(facts, bytes=len(data))
    write_world(copy, replace(dataset.world, sectors=sectors))
    done = sectorlight("compare", str(copy), *SMALL, "--states", "noon,night", "--source", SOURCE)
    assert done.returncode == 1
    assert "this dataset is nonsense: receivers without any light by day, or with light that is no number, in" in done.stderr
    assert "night" not in done.stderr
    assert Dataset.open(copy).world.error_report is None


def test_the_same_seed_gives_the_same_report(sectorlight: RunCommand, city: Path, tmp_path: Path) -> None:
    reports = []
    for number, seed in enumerate(("4", "4", "5")):
        path = tmp_path / f"{number}.json"
        assert (
            sectorlight("compare", str(city), *SMALL, "--states", "noon", "--seed", seed, "--no-store", "--json", str(path)).returncode == 0
        )
        reports.append(path.read_bytes())
    assert reports[0] == reports[1] != reports[2]


def test_lamps_of_a_file_take_the_place_of_the_datasets_own(sectorlight: RunCommand, city: Path, tmp_path: Path) -> None:
    reports = {}
    for name, lumens in (("bright", 1e6), ("dim", 1.0)):
        lamps, out = tmp_path / f"{name}.toml", tmp_path / f"{name}.json"
        lamps.write_text(f'[[lamp]]\nname = "one"\nposition = [30, 9, 5]\nlumens = {lumens}\nschedule = "night"\n')
        done = sectorlight("compare", str(city), *SMALL, "--states", "noon,night", "--lamps", str(lamps), "--json", str(out))
        assert done.returncode == 0, done.stderr
        reports[name] = json.loads(out.read_text())
        assert reports[name]["lamps_on"] == {"noon": 0, "night": 1}
    assert reports["bright"]["states"]["noon"] == reports["dim"]["states"]["noon"]
    assert reports["bright"]["states"]["night"] != reports["dim"]["states"]["night"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--states", "foggy_noon"), ("foggy_noon", "low_sun")),
        (("--states", "noon,noon"), ("distinct",)),
        (("--states", "a=25:00/clear"), ("25:00",)),
        (("--states", "a=12:00/hail"), ("hail", "overcast")),
        (("--sectors", "some"), ("some", "X0:X1,Z0:Z1")),
        (("--sectors", "0"), ("found '0'",)),
        (("--sectors", "900:901,0:1"), ("900:901,0:1", "info")),
        (("--sectors", "1:0,0:1"), ("X0 < X1",)),
        (("--source", "nowhere.glb"), ("nowhere.glb",)),
        (("--lamps", "nowhere.toml"), ("nowhere.toml",)),
        (("--device", "abacus"), ("abacus", "there are")),
        (("--json", "nowhere/out.json"), ("nowhere/out.json", "folder that exists")),
        (("--plot", "nowhere/out.png"), ("nowhere/out.png", "folder that exists")),
        (("--plot", "out.jpg"), ("out.jpg", ".png")),
    ],
)
def test_bad_input_is_one_clear_line(sectorlight: RunCommand, city: Path, options: tuple[str, ...], words: tuple[str, ...]) -> None:
    done = sectorlight("compare", str(city), *options)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "\n" not in done.stderr.strip()
    for word in words:
        assert word in done.stderr


def test_no_dataset_is_one_clear_line(sectorlight: RunCommand, tmp_path: Path) -> None:
    done = sectorlight("compare", str(tmp_path))
    assert done.returncode == 2
    assert str(tmp_path) in done.stderr


@pytest.mark.parametrize(
    ("text", "states"),
    [
        ("noon", ["noon"]),
        ("noon,low_sun", ["noon", "low_sun"]),
        ("a=12:00/clear:haze=1,snow=0,noon", ["a=12:00/clear:haze=1,snow=0", "noon"]),
        ("a=12:00/clear,b=13:00/fog", ["a=12:00/clear", "b=13:00/fog"]),
        ("", [""]),
        ("haze=1,noon", ["haze=1", "noon"]),
    ],
)
def test_commas_part_states_but_not_a_weather(text: str, states: list[str]) -> None:
    assert split_states(text) == states


def test_sectors_are_all_some_or_those_in_a_range(city: Path) -> None:
    known = sorted(Dataset.open(city).world.sectors)
    assert len(known) > 1
    assert sectors_of(city, "all", 0) == known
    assert len(sectors_of(city, "1", 0)) == 1
    assert sectors_of(city, "999999", 0) == known  # all of this city's sectors have probes
    first = known[0]
    assert sectors_of(city, ((first.x, first.x + 1), (first.z, first.z + 1)), 0) == [first]
    with pytest.raises(InputError, match="--sectors"):
        sectors_of(city, "-1", 0)
