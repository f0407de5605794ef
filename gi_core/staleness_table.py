"""How far served light is behind: players' volumes beside what their bounces would converge to at that very tick.

    python -m gi_core.staleness_table DATASET X,Y,Z      a player who stands there; a table on stdout

Ticks are stepped one after another, 30 to a second of the clock's real time, so a busy machine changes nothing but what a tick takes. The
shadow map is off: what is left between the two is time alone.
"""

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from gi_core.arrays import Float32, Float64
from gi_core.clock_time import parse_time
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.error_report import DARKEST_SHARE_OF_MEAN
from gi_core.errors import InputError
from gi_core.light_blend import LightVector
from gi_core.light_track import LightTrack
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.live_sector import LiveLight
from gi_core.live_world import LiveWorld, TickPlayers
from gi_core.relight_input import relight_input
from gi_core.settings import NEUTRAL
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.weather import parse_weather
from gi_core.world import Lamp

TICK_RATE_HZ = 30.0
PLACES = (1, 2, 4, 8)  # one: two at every other tick, since a tick plans for the player's sector and another
RATES = (1.0, 60.0, 600.0)
MORNING, NIGHT = "08:00", "23:30"
# The clock starts to run when nothing was done for so many ticks, at the latest after a minute of them.
QUIET_TICKS, MOST_WARM_TICKS = 10, 1800
RUN_TICKS = 150
CHECKS = 10  # over the second half of the run
FLICKER_HZ = 3.0
LAMPS = 8


@dataclass(frozen=True)
class Row:
    """What moves, sectors relit in a tick, and the volume's error: median, 95th percentile and bias, of luminance, relative.

    changes : how far the converged light itself moves in a second, its median
    tick_ms : what a tick that relights takes, the median; NaN where none did
    """

    moves: str
    places: int
    median: float
    p95: float
    bias: float
    changes: float
    tick_ms: float


LampsAt = Callable[[int], tuple[Lamp, ...]]


def staleness_table(dataset: Dataset, position: Float64) -> list[Row]:
    """Rows for the clock at each of RATES, and for lamps that flicker, each with PLACES sectors in a tick.

    Raises OutsideWorldError for a position (3,) [m] beyond the dataset, CorruptFileError.
    """
    engine = Engine(dataset)
    cases: list[tuple[str, str, float, LampsAt]] = [(f"clock, {rate:g} x", MORNING, rate, no_lamps) for rate in RATES]
    cases.append((f"{LAMPS} lamps, {FLICKER_HZ:g} Hz", NIGHT, 0.0, flickering(position)))
    return [_row(name, engine, position, start, rate, lamps, places) for name, start, rate, lamps in cases for places in PLACES]


def no_lamps(_: int) -> tuple[Lamp, ...]:
    """None at any tick."""
    return ()


def flickering(position: Float64) -> LampsAt:
    """Lamps on a ring around a position, each half as bright again and half as dark in turn, none in step with another."""
    turns = 2 * np.pi * np.arange(LAMPS) / LAMPS
    places = [(position[0] + 12 * np.cos(turn), position[1] + 3.0, position[2] + 12 * np.sin(turn)) for turn in turns]

    def at(tick: int) -> tuple[Lamp, ...]:
        level = 1 + 0.5 * np.sin(2 * np.pi * FLICKER_HZ * tick / TICK_RATE_HZ + turns)
        return tuple(
            Lamp(f"flicker {i}", "point", (float(x), float(y), float(z)), float(8000 * level[i]), range_m=40.0)
            for i, (x, y, z) in enumerate(places)
        )

    return at


def _row(moves: str, engine: Engine, position: Float64, start: str, rate: float, lamps_at: LampsAt, places: int) -> Row:
    dataset = engine.dataset
    begin, clear = parse_time(start, dataset.world.location), parse_weather("clear")
    world = LiveWorld(dataset, shadow_map=False, places=max(places, 2))
    with ThreadPoolExecutor(1) as worker:
        track = LightTrack(dataset.world.location, worker, lambda _: clear)
        try:
            return _measured(moves, engine, world, track, position, begin, rate, lamps_at, places)
        finally:
            world.close()


def _measured(
    moves: str,
    engine: Engine,
    world: LiveWorld,
    track: LightTrack,
    position: Float64,
    begin: datetime,
    rate: float,
    lamps_at: LampsAt,
    places: int,
) -> Row:
    player = TickPlayers(("one",), position[None], np.zeros((1, 3)))
    warm = settle(world, 0, player, live_light(world, track.at(begin, 0.0), lamps_at(0), standing=True))
    errors, biases, before, changes, took_ms = [], [], None, [], []
    due = set(np.linspace(RUN_TICKS // 2, RUN_TICKS - 1, CHECKS).astype(int).tolist())
    for step in range(RUN_TICKS):
        moment = begin + timedelta(seconds=rate * step / TICK_RATE_HZ)
        lighting = track.at(moment, rate)
        if lamps_at(step) != lamps_at(step - 1):
            world.lamps_moved([(np.array(lamp.position), lamp.range_m) for lamp in lamps_at(step)])
        if places > 1 or step % 2 == 0:
            light = live_light(world, lighting, lamps_at(step), standing=False)
            begun = time.perf_counter()
            if world.tick(warm + step, player, light).relit:
                took_ms.append((time.perf_counter() - begun) * 1e3)
        if step not in due:
            continue
        engine.lamps = lamps_at(step)
        query = engine.volume(position, lighting)
        published = world.published("one")
        assert published is not None
        seen, truth = (_luminance(values)[:, query.own] for values in (published.values, query.values))
        errors.append((np.abs(seen - truth) / np.maximum(truth, DARKEST_SHARE_OF_MEAN * truth.mean())).ravel())
        biases.append(float(seen.sum() / truth.sum() - 1))
        if before is not None:
            gone_s = (step - before[0]) / TICK_RATE_HZ
            changes.append(float(np.median(np.abs(truth - before[1]) / np.maximum(before[1], 1e-9))) / gone_s)
        before = step, truth
    found = np.concatenate(errors)
    figures = (np.median(found), np.quantile(found, 0.95), np.mean(biases), np.median(changes), np.median(took_ms) if took_ms else np.nan)
    return Row(moves, places, *(float(figure) for figure in figures))


def settle(world: LiveWorld, tick: int, players: TickPlayers, light: LiveLight) -> int:
    """Ticks from this one on until nothing has been done for some; the number of the next."""
    quiet, last = 0, tick + MOST_WARM_TICKS
    while quiet < QUIET_TICKS and tick < last:
        report = world.tick(tick, players, light)
        at_work = report.missing or world.streamer.loading or report.relit or report.settled or report.filled
        quiet = 0 if at_work or world.published(players.ids[0]) is None else quiet + 1
        tick += 1
        time.sleep(0.001)  # loaders are threads
    return tick


def live_light(world: LiveWorld, lighting: Lighting, lamps: tuple[Lamp, ...], standing: bool) -> LiveLight:
    """A tick's light: dynamic lamps, those that are on, and settings that change nothing."""
    info = world.dataset.world
    given = relight_input(lighting, info.sun_table, info.sky, info.sky_patches)
    return LiveLight(lighting, given, LightVector.of(given), (), lamps_on(lamps, lighting), NEUTRAL, standing)


def _luminance(values: Float32) -> Float32:
    return np.asarray(values @ LUMINANCE_FROM_RGB.astype(np.float32), np.float32)


def parse_position(text: str) -> Float64:
    """(3,) [m] from X,Y,Z. Raises InputError."""
    parts = text.split(",")
    if len(parts) != 3:
        raise InputError(f"position: expected X,Y,Z as in 48,4,3, found {text[:40]!r}")
    return np.array([float(part) for part in parts])


def main() -> None:
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("position", help="X,Y,Z [m]")
    given = parser.parse_args()
    rows = staleness_table(Dataset.open(given.dataset), parse_position(given.position))
    titles = ("what moves", "converged light moves by, in a second", "sectors a tick", "median", "95th percentile", "bias", "tick [ms]")
    print(f"| {' | '.join(titles)} |\n" + "|---" * len(titles) + "|")
    for row in rows:
        figures = f"{row.median:.2%} | {row.p95:.2%} | {row.bias:+.2%} | {row.tick_ms:.1f}"
        print(f"| {row.moves} | {row.changes:.2%} | {row.places} | {figures} |")


if __name__ == "__main__":
    main()
