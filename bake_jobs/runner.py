"""Bakes a whole dataset: several processes, a progress bar, nothing lost when it is interrupted.

Each sector is a pure function of scene, settings and index, and is written whole or not at all. A bake's id names its input and
settings in every sector file, so a bake that is started again skips what an earlier run of the same bake finished.
"""

import errno
import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from bake_jobs.config import BakeSettings, settings_for, with_knobs, with_target_error
from bake_jobs.geometry_clip import SectorCutter
from bake_jobs.sanity import expect_sense
from bake_jobs.scene import Scene, scene_digest
from bake_jobs.scene_source import load_scene
from bake_jobs.sector_job import SectorBaker
from bake_jobs.summary import print_own_errors, print_summary
from gi_core import distant_file, fine_file, geometry_file, sector_file
from gi_core.container import write_atomic
from gi_core.dataset import (
    COUNTS,
    DISTANT_FILE,
    WORLD_FILE,
    Dataset,
    SectorFacts,
    WorldInfo,
    fine_path,
    geometry_path,
    sector_path,
    write_world,
)
from gi_core.distant_transfer import DistantTransfer
from gi_core.errors import FormatError, InputError, SectorlightError
from gi_core.grid import SectorIndex
from gi_core.json_fields import LARGEST_INTEGER
from gi_core.outputs import expect_folder
from gi_core.sector import Sector
from gi_core.sun_table import SunTable

# Part of the bake id: raised whenever the same settings would give other bytes than before.
BAKER_VERSION = 10
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
SectorRange = tuple[tuple[int, int], tuple[int, int]]


class WorkerLostError(SectorlightError, RuntimeError):
    """A worker process died, most likely for want of memory."""

    code = "worker_lost"


class DatasetWriteError(SectorlightError, OSError):
    """The dataset's folder, which took a file when the bake began, takes no more: no space left, or somebody else's folder inside it."""

    code = "dataset_write"


@contextmanager
def _writing(path: Path, elsewhere: str = "choose another --output") -> Iterator[None]:
    """Tell what could not be written and what to do, instead of a traceback. ``elsewhere``: how to have it written in another place."""
    try:
        yield
    except OSError as error:
        remedy = "make room" if error.errno in NO_ROOM else "let it be written"
        raise DatasetWriteError(
            f"{error.filename or path}: {error.strerror or error}; finished sectors are kept: "
            f"{remedy} or {elsewhere}, and start the same bake again"
        ) from error


@dataclass(frozen=True)
class _Finished:
    index: SectorIndex
    facts: SectorFacts
    distant_sky: list[float]
    seconds: float
    transfer: DistantTransfer | None = None
    """None where an earlier run baked the sector and left none."""
    own_error: float | None = None
    """What probes err by themselves; None where no target error asked."""


def bake(
    source: str,
    output: Path,
    quality: str = "talk",
    jobs: int | None = None,
    sectors: SectorRange | None = None,
    seed: int = 0,
    restart: bool = False,
    console: Console | None = None,
    knobs: Sequence[str] = (),
    target_error: float | None = None,
    on_baked: Callable[[float], None] | None = None,
) -> WorldInfo:
    """Bake a source into a dataset folder and print a summary.

    jobs : worker processes; None takes every core. sectors : half-open ranges ((x0, x1), (z0, z1)); None takes all.
    restart : bake everything anew instead of skipping finished sectors. seed : recorded with the dataset. knobs : ``config.with_knobs``.
    on_baked : called with the processor seconds of each sector that was baked
    target_error : spend probes until the bake's own estimate of each sector is below, at most 1000 a sector; None leaves it to the preset

    Raises InputError (SourceError among them) for input that cannot be baked, NonsenseError for a bake that cannot be right (sectors stay,
    without a world.json), WorkerLostError when a worker dies, DatasetWriteError when the folder cannot be written. An interrupt leaves
    finished sectors in place, and the same call resumes.
    """
    console = console or Console(stderr=True)
    settings = with_knobs(settings_for(quality), knobs) if knobs else settings_for(quality)
    if target_error is not None:
        settings = with_target_error(settings, target_error, knobs)
    if not 0 <= seed <= LARGEST_INTEGER:
        raise InputError(f"seed: expected a whole number of 0..{LARGEST_INTEGER}, found {seed}")
    expect_folder(output, "--output")
    scene = load_scene(source)
    for note in scene.notes:
        console.print(note, highlight=False, soft_wrap=True)
    table = SunTable.build(scene.location, settings.sun_declination_step_degrees, settings.sun_hour_step_degrees)
    bake_id = bake_identity(scene, settings, seed)
    wanted = _chosen(SectorCutter(scene).sectors(), sectors)
    with _writing(output):
        output.mkdir(parents=True, exist_ok=True)
        if restart:
            _clear(output)
    done = {i: f for i in wanted if (f := _finished(output, i, bake_id, settings.voxel_levels > 1)) is not None}
    remaining = [i for i in wanted if i not in done]
    known = _known_transfers(output, bake_id)
    done = {i: replace(finished, transfer=known.get(i)) for i, finished in done.items()}
    lacking = [i for i, finished in done.items() if finished.transfer is None]
    if done:
        console.print(f"{len(done)} of {len(wanted)} sectors are finished already; baking the other {len(remaining)}")
    if lacking:
        console.print(f"finding the distant light of {len(lacking)} finished sectors, which they do not hold themselves")
    report = _report_of(output, bake_id, wanted)
    tasks = [*((i, None) for i in remaining), *((i, done[i]) for i in lacking)]
    workers = max(1, min(jobs or os.cpu_count() or 1, len(tasks)))
    started = time.perf_counter()
    if tasks:
        # A world.json names a complete bake; while this one runs there is none.
        with _writing(output):
            (output / WORLD_FILE).unlink(missing_ok=True)
        with Progress(
            TextColumn("baking {task.fields[preset]}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("sectors in"),
            TimeElapsedColumn(),
            TextColumn("and"),
            TimeRemainingColumn(),
            TextColumn("to go"),
            console=console,
        ) as progress:
            task = progress.add_task("bake", total=len(wanted), completed=len(wanted) - len(tasks), preset=settings.preset)
            for finished in _run(scene, settings, table, bake_id, output, tasks, workers):
                is_new = finished.index not in done
                done[finished.index] = finished
                if is_new and on_baked is not None:
                    on_baked(finished.seconds)
                progress.advance(task)
    wall_seconds = time.perf_counter() - started

    def read(index: SectorIndex) -> Sector:
        return sector_file.read(sector_path(output, index))[0]

    expect_sense({i: done[i].facts for i in wanted}, read, settings.sky_sources)
    transfers = {i: found for i in wanted if (found := done[i].transfer) is not None}
    texels = distant_file.assemble({i: done[i].distant_sky for i in wanted}, transfers)
    if texels.transfer is None:
        console.print("The distant texture knows the sky alone: what suns send to so many sectors is more than its file may hold.")
    world = WorldInfo(
        name=scene.name,
        source=Path(source).name if Path(source).exists() else source,
        bake_id=bake_id,
        location=scene.location,
        bounds=scene.bounds,
        preset=settings.preset,
        basis=settings.basis,
        sky=settings.sky,
        sky_patches=settings.sky_sources,
        settings=settings.to_json(),
        seed=seed,
        sun_table=table,
        sectors={i: done[i].facts for i in wanted},
        rooms=scene.rooms,
        lamps=scene.lamps,
        dropped_triangles=asdict(scene.dropped),
        error_report=report,
        decals=scene.decals,
    )
    with _writing(output):
        distant = distant_file.encode(texels, bake_id)
        write_atomic(output / DISTANT_FILE, distant)
        write_world(output, world)
    print_summary(console, world, len(distant), sum(f.seconds for f in done.values()), wall_seconds, len(remaining), workers)
    print_own_errors(console, world, {i: f.own_error for i, f in done.items() if f.own_error is not None})
    return world


def bake_identity(scene: Scene, settings: BakeSettings, seed: int) -> str:
    """Of what a bake's bytes depend on: bakes that share it would write the same."""
    h = hashlib.blake2b(digest_size=16)
    record = {
        "scene": scene_digest(scene),
        "settings": settings.to_json(),
        "seed": seed,
        "baker": BAKER_VERSION,
        "format": sector_file.VERSION,
    }
    h.update(json.dumps(record, sort_keys=True).encode())
    return h.hexdigest()


def _chosen(available: list[SectorIndex], sectors: SectorRange | None) -> list[SectorIndex]:
    if sectors is None:
        return available
    (x0, x1), (z0, z1) = sectors
    chosen = [i for i in available if x0 <= i.x < x1 and z0 <= i.z < z1]
    if not chosen:
        xs, zs = [i.x for i in available], [i.z for i in available]
        raise InputError(
            f"--sectors={x0}:{x1},{z0}:{z1} holds no sector of this source; it has x {min(xs)}:{max(xs) + 1}, z {min(zs)}:{max(zs) + 1}"
        )
    return chosen


def _clear(output: Path) -> None:
    """Remove what a bake writes, and nothing else that the folder may hold."""
    for name in ("sectors", "geometry", "fine"):
        shutil.rmtree(output / name, ignore_errors=True)
    for name in (WORLD_FILE, DISTANT_FILE):
        (output / name).unlink(missing_ok=True)


def _known_transfers(output: Path, bake_id: str) -> dict[SectorIndex, DistantTransfer]:
    """What an earlier run of this very bake left in its distant file."""
    try:
        texels, found = distant_file.read(output / DISTANT_FILE)
    except (OSError, FormatError):
        return {}
    return distant_file.taken_apart(texels) if found == bake_id else {}


def _report_of(output: Path, bake_id: str, wanted: list[SectorIndex]) -> dict[str, Any] | None:
    """What ``compare`` measured of this very bake when it had these very sectors, or None."""
    try:
        world = Dataset.open(output).world
    except (InputError, FormatError):
        return None
    return world.error_report if world.bake_id == bake_id and set(world.sectors) == set(wanted) else None


def _facts(sector_bytes: bytes, geometry_bytes: int, fine_bytes: int | None, meta: dict[str, Any]) -> SectorFacts:
    counted = {name: int(meta[name]) for name in COUNTS if name not in ("bytes", "geometry_bytes")}
    digest = hashlib.blake2b(sector_bytes, digest_size=16).hexdigest()
    return SectorFacts(
        bytes=len(sector_bytes),
        digest=digest,
        geometry_bytes=geometry_bytes,
        fine_bytes=fine_bytes,
        estimated_error=meta.get("estimated_error"),
        **counted,
    )


def _finished(output: Path, index: SectorIndex, bake_id: str, has_fine: bool) -> _Finished | None:
    """A sector of this very bake that an earlier run completed, or None."""
    path, geometry, fine = sector_path(output, index), geometry_path(output, index), fine_path(output, index)
    if not path.is_file() or not geometry.is_file():
        return None
    try:
        data = path.read_bytes()
        sector, meta = sector_file.decode(data, str(path))
        others = [geometry_file.read(geometry)[1:]]
        if has_fine:
            others.append(fine_file.read(fine)[1:])
        if any(other != (index, bake_id) for other in [(sector.index, meta["bake_id"]), *others]):
            return None
        fine_bytes = fine.stat().st_size if has_fine else None
        return _Finished(
            index, _facts(data, geometry.stat().st_size, fine_bytes, meta), meta["distant_sky"], 0.0, own_error=meta.get("own_error")
        )
    except (OSError, FormatError, KeyError, TypeError, ValueError):
        return None  # damaged: bake it again


_baker: SectorBaker | None = None
_output = Path()


def _start_worker(arrays_path: Path, scene: Scene, settings: BakeSettings, table: SunTable, bake_id: str, output: Path) -> None:
    """Build what all sectors of a worker share. Ctrl-C is the parent's to handle: a worker finishes its sector."""
    global _baker, _output  # noqa: PLW0603 - a process pool's initialiser has no other place to leave what its tasks share
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if arrays_path.exists():
        with np.load(arrays_path, allow_pickle=False) as arrays:
            scene = Scene(**{**scene.__dict__, **{name: arrays[name] for name in arrays.files}})
    _baker = SectorBaker(scene, settings, table.directions, bake_id)
    _output = output


def _end_with_parent() -> None:
    """A parent that was killed closes nothing: its workers, who hold both ends of its queues, would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Workers that start in this block never see Ctrl-C, not even before they can ignore it; the parent sees it when the block ends."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _interrupts_into(queue: "SimpleQueue[Any]") -> Iterator[None]:
    """Ctrl-C, and what else would raise KeyboardInterrupt, comes as None out of a queue instead.

    Raised while the main thread takes the lock of a future, it would leave that locked, and a bake that shuts its workers down would wait
    for it for ever.
    """
    # Handlers are the main thread's to set.
    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    ours = [number for number in numbers if signal.getsignal(number) is signal.default_int_handler]
    try:
        for number in ours:
            signal.signal(number, lambda *_: queue.put(None))
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.default_int_handler)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that start in this block work out matrix products alone, unless the environment says otherwise.

    Sectors' matrices are small: a second thread of NumPy's spends its time waiting, a fifth of what a sector takes, and takes it from
    the next worker.
    """
    added = [name for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS") if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def _finish(index: SectorIndex, baked_earlier: _Finished | None) -> _Finished:
    """Bake a sector, or find what an earlier run's lacks."""
    assert _baker is not None
    if baked_earlier is not None:
        return replace(baked_earlier, transfer=_baker.transfers.transfer(sector_file.read(sector_path(_output, index))[0]))
    started = time.process_time()
    baked = _baker.bake(index)
    with _writing(_output):
        write_atomic(geometry_path(_output, index), baked.geometry_bytes)
        if baked.fine_bytes is not None:
            write_atomic(fine_path(_output, index), baked.fine_bytes)
        # The sector file comes last: where it is, all are.
        write_atomic(sector_path(_output, index), baked.sector_bytes)
    fine_bytes = None if baked.fine_bytes is None else len(baked.fine_bytes)
    facts = _facts(baked.sector_bytes, len(baked.geometry_bytes), fine_bytes, baked.meta)
    return _Finished(index, facts, baked.meta["distant_sky"], time.process_time() - started, baked.transfer, baked.meta.get("own_error"))


def _next_finished(done: "SimpleQueue[Future[_Finished] | None]") -> _Finished:
    """Waits for it. Raises KeyboardInterrupt for one that came meanwhile, and what the worker raised."""
    future = done.get()
    if future is None:
        raise KeyboardInterrupt
    return future.result()


def _run(
    scene: Scene,
    settings: BakeSettings,
    table: SunTable,
    bake_id: str,
    output: Path,
    tasks: Sequence[tuple[SectorIndex, _Finished | None]],
    workers: int,
) -> Iterator[_Finished]:
    """Finish sectors in worker processes, in whatever order they come."""
    names = ("vertices", "triangles", "albedo", "emission")
    empty = Scene(**{**scene.__dict__, **{n: getattr(scene, n)[:0] for n in names}})
    with tempfile.TemporaryDirectory(prefix="sectorlight-") as folder, _one_thread_each():
        arrays_path = Path(folder) / "scene.npz"
        with _writing(arrays_path, "set TMPDIR to another folder"):
            np.savez(arrays_path, **{n: getattr(scene, n) for n in names})
        pool = ProcessPoolExecutor(
            workers,
            # A forked child would inherit the parent's threads' locks.
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_start_worker,
            initargs=(arrays_path, empty, settings, table, bake_id, output),
        )
        done: SimpleQueue[Future[_Finished] | None] = SimpleQueue()
        pending = 0
        with _interrupts_into(done):
            try:
                # A few tasks ahead of the workers, so that an interrupt has little to wait for.
                for task in tasks:
                    with _interrupts_held():
                        pool.submit(_finish, *task).add_done_callback(done.put)
                    pending += 1
                    if pending == 2 * workers:
                        yield _next_finished(done)
                        pending -= 1
                for _ in range(pending):
                    yield _next_finished(done)
            except BrokenProcessPool as error:
                raise WorkerLostError(
                    "a worker process was killed, most likely for want of memory; finished sectors are kept: "
                    "start the same bake again with fewer --jobs"
                ) from error
            finally:
                pool.shutdown(wait=True, cancel_futures=True)
