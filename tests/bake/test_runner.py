"""The bake as a whole: the same bytes however it is run, and nothing lost when it is cut off."""

import dataclasses
import errno
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from bake_jobs import runner
from bake_jobs.runner import DatasetWriteError, bake
from bake_jobs.sanity import NonsenseError
from gi_core import distant_file
from gi_core.dataset import Dataset, write_world
from gi_core.errors import InputError, SourceError
from gi_core.grid import SectorIndex

ROOT = Path(__file__).parents[2]
SECTORS_WIDE, SECTORS_DEEP = 3, 2


def obj_text(wide=SECTORS_WIDE, deep=SECTORS_DEEP, height=9.0) -> str:
    """A ground of whole sectors and two boxes, one of them across a border."""
    lines, first = [], 1
    quads = [(0, 0, 0, 64 * wide, 0, 64 * deep)]
    for low, high in (((10, 0, 10), (24, height, 22)), ((55, 0, 30), (75, 2 * height, 50))):
        (x0, y0, z0), (x1, y1, z1) = low, high
        corners = [(x, y, z) for z in (z0, z1) for y in (y0, y1) for x in (x0, x1)]
        lines += [f"v {x} {y} {z}" for x, y, z in corners]
        faces = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
        lines += ["f " + " ".join(str(first + i) for i in face) for face in faces]
        first += 8
    for x0, y, z0, x1, _, z1 in quads:
        lines += [f"v {x} {y} {z}" for x, z in ((x0, z0), (x0, z1), (x1, z1), (x1, z0))]
        lines.append("f " + " ".join(str(first + i) for i in range(4)))
    return "\n".join(lines) + "\n"


def run(source, output, **options):
    options = {"quality": "draft", "jobs": 1, **options}
    with open(os.devnull, "w") as nowhere:
        return bake(str(source), output, console=Console(file=nowhere), **options)


def files(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def times(folder):
    return {p.relative_to(folder).as_posix(): p.stat().st_mtime_ns for p in sorted(folder.rglob("*.gi*")) if p.parent != folder}


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("source") / "block.obj"
    path.write_text(obj_text())
    return path


@pytest.fixture(scope="module")
def reference(source, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reference") / "data"
    run(source, folder)
    return folder


@pytest.fixture
def baked(reference, tmp_path) -> Path:
    """A copy of the reference whose files are old, so that a rewritten one shows."""
    folder = tmp_path / "data"
    for name, data in files(reference).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        os.utime(path, (1_000_000_000, 1_000_000_000))
    return folder


def test_a_bake_holds_every_sector_and_opens_as_a_dataset(reference):
    dataset = Dataset.open(reference)
    assert set(dataset.world.sectors) == {SectorIndex(x, z) for x in range(SECTORS_WIDE) for z in range(SECTORS_DEEP)}
    for index, facts in dataset.world.sectors.items():
        sector = dataset.sector(index)
        assert facts.probes == sector.probe_count > 50
        assert facts.triangles == len(dataset.geometry(index).triangles)
    expected = {f"{kind}/{i}.{end}" for i in dataset.world.sectors for kind, end in (("sectors", "gisec"), ("geometry", "gigeo"))}
    assert set(files(reference)) == expected | {"world.json", "distant.gidist"}


def test_two_processes_give_the_same_bytes_as_one(source, reference, tmp_path):
    run(source, tmp_path / "two", jobs=2)
    assert files(tmp_path / "two") == files(reference)


def test_the_same_bake_again_rewrites_no_sector(source, reference, baked):
    before = times(baked)
    run(source, baked)
    assert times(baked) == before
    assert files(baked) == files(reference)


def truncate(path):
    path.write_bytes(path.read_bytes()[:-7])


def alter(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_only_missing_and_damaged_sectors_are_baked_again(source, reference, baked):
    """Each way to be unusable strikes another sector; one stays whole."""
    (baked / "sectors/0_0.gisec").unlink()
    truncate(baked / "sectors/1_0.gisec")
    alter(baked / "geometry/2_0.gigeo")
    (baked / "geometry/0_1.gigeo").write_bytes(b"")
    for kind, end in (("sectors", "gisec"), ("geometry", "gigeo")):  # whole, but under another's name
        (baked / kind / f"1_1.{end}").write_bytes((reference / kind / f"2_1.{end}").read_bytes())
    before = times(baked)
    run(source, baked, jobs=2)
    after = times(baked)
    assert {name for name in after if after[name] == before.get(name)} == {"sectors/2_1.gisec", "geometry/2_1.gigeo"}
    assert files(baked) == files(reference)


def test_what_an_older_bake_lacks_of_distant_light_is_found_from_its_finished_sectors(source, reference, baked):
    path, whole = baked / "distant.gidist", (reference / "distant.gidist").read_bytes()
    texels, bake_id = distant_file.decode(whole, "whole")
    assert texels.lights == ("sky", "full")
    path.write_bytes(distant_file.encode(replace(texels, transfer=None), bake_id))
    before = times(baked)
    run(source, baked)
    assert path.read_bytes() == whole
    assert times(baked) == before


def test_fine_voxels_are_files_of_their_own_and_baked_again_when_one_is_damaged(source, tmp_path):
    output, knobs = tmp_path / "data", ["voxel_levels=2"]
    world = run(source, output, knobs=knobs)
    whole = files(output)
    for index, facts in world.sectors.items():
        assert facts.fine_bytes == len(whole[f"fine/{index}.givox"])
    alter(output / "fine/1_0.givox")
    (output / "fine/0_0.givox").unlink()
    before = times(output)
    run(source, output, knobs=knobs)
    after = times(output)
    assert {name.split("/")[1].split(".")[0] for name in after if after[name] != before.get(name)} == {"0_0", "1_0"}
    assert files(output) == whole
    run(source, output, restart=True)
    assert not list(output.glob("fine/*"))


def test_another_source_bakes_everything_anew(source, baked, tmp_path):
    before = times(baked)
    other = tmp_path / "block.obj"
    other.write_text(obj_text(height=9.5))
    run(other, baked, jobs=2)
    after = times(baked)
    assert set(after) == set(before)
    assert all(after[name] != before[name] for name in after)
    Dataset.open(baked).sector(SectorIndex(0, 0))


def test_a_restart_bakes_everything_anew_and_removes_only_what_a_bake_writes(source, reference, baked):
    before = times(baked)
    (baked / "notes.txt").write_text("mine")
    (baked / "sectors" / "9_9.gisec").write_bytes(b"an old bake's")
    run(source, baked, restart=True)
    assert (baked / "notes.txt").read_text() == "mine"
    assert not (baked / "sectors" / "9_9.gisec").exists()
    after = times(baked)
    assert all(after[name] != before[name] for name in after)
    assert files(baked) == files(reference) | {"notes.txt": b"mine"}


def test_a_range_of_sectors_is_half_open_and_grows_into_the_whole(source, reference, tmp_path):
    world = run(source, tmp_path, sectors=((1, 3), (0, 1)))
    assert set(world.sectors) == {SectorIndex(1, 0), SectorIndex(2, 0)}
    part = files(tmp_path)
    for name, data in part.items():
        if name.startswith(("sectors/", "geometry/")):
            assert data == files(reference)[name]
    before = times(tmp_path)
    run(source, tmp_path)
    assert files(tmp_path) == files(reference)
    assert all(times(tmp_path)[name] == stamp for name, stamp in before.items())


def test_a_range_without_sectors_says_what_there_is(source, tmp_path):
    with pytest.raises(InputError, match=r"--sectors=7:9,0:2 .* x 0:3, z 0:2"):
        run(source, tmp_path, sectors=((7, 9), (0, 2)))
    assert not files(tmp_path)


def test_wrong_input_is_refused_before_anything_is_written(tmp_path):
    target = tmp_path / "out"
    with pytest.raises(SourceError, match="no such file"):
        run(tmp_path / "absent.obj", target)
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(SourceError):
        run(tmp_path / "empty.obj", target)
    with pytest.raises(InputError, match="draft, talk"):
        run(tmp_path / "absent.obj", target, quality="best")
    assert not target.exists()


def test_an_output_that_cannot_be_made_is_the_users_mistake_and_said_before_the_source_is_read(tmp_path):
    (tmp_path / "file").write_text("a letter")
    for name in ("file", "file/out"):
        with pytest.raises(InputError, match=rf"--output .*/{name}: expected a folder"):
            run(tmp_path / "absent.obj", tmp_path / name)
    assert (tmp_path / "file").read_text() == "a letter"


def test_only_a_full_disk_is_told_to_make_room(source, tmp_path, monkeypatch):
    for number, remedy in ((errno.EACCES, "let it be written or choose another --output"), (errno.ENOSPC, "make room or choose")):

        def refuse(*_, number=number, **__):
            raise OSError(number, os.strerror(number), str(tmp_path / "out"))

        monkeypatch.setattr(Path, "mkdir", refuse)
        with pytest.raises(DatasetWriteError, match=rf"/out: {os.strerror(number)}; finished sectors are kept: {remedy}"):
            run(source, tmp_path / "out")


def command(source, output, *options, **popen):
    arguments = [sys.executable, "-m", "server.cli", "bake", str(source), "-o", str(output), *options]
    return subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **popen)


def test_a_full_disk_ends_with_one_line_and_status_1(source, tmp_path):
    def no_file_above_20_kb():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    process = command(source, tmp_path / "out", "--quality=draft", "--jobs=1", preexec_fn=no_file_above_20_kb)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "Traceback" not in errors
    last = errors.strip().splitlines()[-1]
    assert last.startswith("sectorlight: ")
    assert "File too large" in last
    assert "--output" in last
    assert not [name for name in files(tmp_path) if "partial" in name]


def test_no_room_for_what_workers_share_names_the_folder_that_it_would_be_in(source, tmp_path):
    def no_file():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))

    process = command(source, tmp_path / "out", "--quality=draft", "--jobs=1", preexec_fn=no_file)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    last = errors.strip().splitlines()[-1]
    assert "scene.npz: File too large" in last
    assert "set TMPDIR" in last
    assert "--output" not in last


@pytest.fixture(scope="module")
def long_source(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("long") / "plain.obj"
    path.write_text(obj_text(wide=4, deep=3))
    return path


@pytest.fixture(scope="module")
def long_reference(long_source, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("long_reference") / "data"
    run(long_source, folder, jobs=2)
    return folder


def wait_for_sectors(folder, process, count=2):
    """Until so many sectors are finished while the bake still runs."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        if len(list(folder.glob("sectors/*.gisec"))) >= count:
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.002)
    raise AssertionError("no sector after 60 s")


def children(pid):
    return [int(c) for c in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def expect_whole_and_resumable(folder, source, reference):
    left = files(folder)
    assert "world.json" not in left  # or a server would take it for complete
    expected = files(reference)
    for name, data in left.items():
        if not name.endswith(".partial"):
            assert data == expected[name]
    finished = {name for name in left if name.startswith("sectors/")}
    assert 0 < len(finished) < len([n for n in expected if n.startswith("sectors/")])
    before = times(folder)
    run(source, folder, jobs=2)
    resumed = {name: data for name, data in files(folder).items() if not name.endswith(".partial")}
    assert resumed == expected
    assert all(times(folder)[name] == before[name] for name in finished)


@pytest.mark.parametrize("stop", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_interrupted_bake_leaves_whole_files_and_resumes_to_the_same_bytes(long_source, long_reference, tmp_path, stop):
    process = command(long_source, tmp_path, "--quality=draft", "--jobs=2")
    wait_for_sectors(tmp_path, process)
    process.send_signal(stop)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert not [name for name in files(tmp_path) if name.endswith(".partial")]
    expect_whole_and_resumable(tmp_path, long_source, long_reference)


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds the workers through /proc")
def test_a_killed_worker_ends_the_bake_with_status_1_and_loses_nothing_finished(long_source, long_reference, tmp_path):
    process = command(long_source, tmp_path, "--quality=draft", "--jobs=2")
    wait_for_sectors(tmp_path, process)
    workers = [pid for pid in children(process.pid) if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    os.kill(workers[0], signal.SIGKILL)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "a worker process was killed" in errors.splitlines()[-1]
    assert "Traceback" not in errors
    expect_whole_and_resumable(tmp_path, long_source, long_reference)


def test_a_killed_bake_leaves_no_worker_behind(long_source, tmp_path):
    process = command(long_source, tmp_path, "--quality=draft", "--jobs=2")
    wait_for_sectors(tmp_path, process)
    process.kill()
    process.communicate(timeout=20)  # ends when the last process that can write there has


def test_the_bake_id_names_scene_settings_seed_and_versions(source, monkeypatch):
    from bake_jobs.config import settings_for
    from bake_jobs.scene_source import load_scene

    scene = load_scene(source)
    first = runner.bake_identity(scene, settings_for("draft"), 0)
    assert first == runner.bake_identity(load_scene(source), settings_for("draft"), 0)
    others = {runner.bake_identity(scene, settings_for("talk"), 0), runner.bake_identity(scene, settings_for("draft"), 1)}
    monkeypatch.setattr(runner, "BAKER_VERSION", runner.BAKER_VERSION + 1)
    others.add(runner.bake_identity(scene, settings_for("draft"), 0))
    assert len(others | {first}) == 4


def test_a_target_error_is_estimated_for_every_sector_and_misses_are_named(source, tmp_path):
    with (tmp_path / "said").open("w") as said:
        console = Console(file=said, width=200)
        world = bake(str(source), tmp_path / "out", "draft", 1, ((0, 2), (0, 1)), console=console, target_error=0.01, knobs=["band_m=10"])
    assert world.settings["target_error"] == 0.01
    estimates = {index: facts.estimated_error for index, facts in Dataset.open(tmp_path / "out").world.sectors.items()}
    assert all(estimate is not None for estimate in estimates.values())
    text = (tmp_path / "said").read_text()
    for index, estimate in estimates.items():
        assert (f"{index.x},{index.z} ({100 * estimate:.1f} %)" in text) == (estimate > 0.01)
    assert "estimated error" in text
    # Six sky scalars are no hundredth right, whatever lies between probes.
    assert "by what probes err by themselves" in text
    assert "--quality standard" in text


@pytest.mark.slow
def test_the_same_bake_once_more_keeps_its_error_report_and_any_other_drops_it(source, tmp_path):
    def reported(report):
        write_world(tmp_path, dataclasses.replace(Dataset.open(tmp_path).world, error_report=report))

    def report():
        return Dataset.open(tmp_path).world.error_report

    measured = {"expected_error": 0.05, "states": {}}
    run(source, tmp_path)
    reported(measured)
    kept = (tmp_path / "world.json").read_bytes()
    run(source, tmp_path)
    assert (tmp_path / "world.json").read_bytes() == kept
    run(source, tmp_path, sectors=((0, 2), (0, 1)))
    assert report() is None  # it was measured in sectors that are no longer there
    for options in ({"seed": 1}, {"restart": True}):
        run(source, tmp_path)
        reported(measured)
        run(source, tmp_path, **options)
        assert report() is None


def test_a_bake_that_makes_no_sense_ships_no_dataset(source, tmp_path, monkeypatch):
    def nonsense(*_):
        raise NonsenseError("this bake is nonsense")

    monkeypatch.setattr(runner, "expect_sense", nonsense)
    with pytest.raises(NonsenseError):
        run(source, tmp_path / "out")
    assert list((tmp_path / "out" / "sectors").iterdir())
    assert not (tmp_path / "out" / "world.json").exists()
