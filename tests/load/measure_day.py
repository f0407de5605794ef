"""A day of the live world, checked: midnight to midnight at a rate, the weather script on, players walking; prints a JSON report.

    python tests/load/measure_day.py DATASET [--rate 60] [--players 3] [--hours 24] [--checks 20] [--budget-mb 512]

At random ticks a player's published volume is compared with what a stateless query gives for that tick's very moment and weather: how
far the live world is behind, as a share of the query's light. Queries are another process's: the memory that is told of is the live
world's. Exceptions, late ticks and memory are watched all the time.
"""

import argparse
import json
import multiprocessing
import random
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path

import numpy as np

from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.lighting_model import make_lighting
from gi_core.live_volume import PublishedVolume
from gi_core.live_world import DEFAULT_BUDGET_BYTES
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.weather import Weather
from server.cli_serve import SWITCH_INTERVAL_S
from server.heap import give_memory_back
from server.live import Live, LiveOptions
from server.live_weather import scripted_weather
from server.players import Player
from server.routes.live import memory_bytes


def luminance(values: np.ndarray) -> np.ndarray:
    return values @ LUMINANCE_FROM_RGB.astype(np.float32)


@lru_cache(maxsize=1)
def engine_of(dataset: Path) -> Engine:
    """A process's engine."""
    return Engine(Dataset.open(dataset))


def staleness(dataset: Path, published: PublishedVolume, moment: datetime, weather: Weather) -> dict[str, float | str]:
    """How far a player's volume is from the query at the moment that it was filled for."""
    engine = engine_of(dataset)
    lighting = make_lighting(engine.dataset.world.location, moment, weather)
    query = engine.volume(published_centre(published.first_voxel), lighting)
    air = (query.mask == 1) | (query.mask == 2)
    seen, truth = luminance(published.values)[:, air], luminance(query.values)[:, air]
    error = np.abs(seen - truth) / np.maximum(truth, 0.02 * truth.mean())
    return {
        "moment": moment.isoformat(timespec="seconds"),
        "weather": weather.text,
        "query_mean_lx": float(truth.mean()),
        "median": float(np.median(error)),
        "p95": float(np.percentile(error, 95)),
        "bias": float(seen.sum() / truth.sum() - 1),
    }


def published_centre(first_voxel: np.ndarray) -> np.ndarray:
    """A position [m] whose volume begins at a voxel."""
    return (first_voxel + np.array([16, 8, 16])) * 3.125


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--rate", type=float, default=60.0, help="world seconds a real second")
    parser.add_argument("--players", type=int, default=3)
    parser.add_argument("--hours", type=float, default=24.0, help="of the world's time")
    parser.add_argument("--checks", type=int, default=20)
    parser.add_argument("--budget-mb", type=int, default=DEFAULT_BUDGET_BYTES >> 20, help="of resident sectors")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    # As the server has them.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    give_memory_back()
    dataset = Dataset.open(options.dataset)
    live = Live(dataset, LiveOptions(start_time="00:00", budget_bytes=options.budget_mb << 20))
    ticker = live.ticker
    ticker.wait_until_running(120)
    script = scripted_weather(options.seed, dataset.world.location)
    walking = [live.walking(Player(f"p{i}", speed=1.4, seed=i, walk_m=500.0), 0, False) for i in range(options.players)]
    ticker.apply(lambda state, tick: replace(state, weather=script, clock=state.clock.with_rate(tick, options.rate)))
    for player in walking:
        ticker.apply(lambda state, _, player=player: state.with_player(player)).result()
    time.sleep(5)
    first_ticks, first_late, first_skipped = ticker.stats.ticks, ticker.stats.late_ticks, ticker.stats.skipped
    seconds = options.hours * 3600 / options.rate
    rng = random.Random(options.seed)
    due = sorted(rng.uniform(0, seconds) for _ in range(options.checks))
    queries = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
    queries.submit(engine_of, options.dataset)
    started, checks, memory = time.monotonic(), [], []
    while time.monotonic() - started < seconds:
        now = time.monotonic() - started
        if len(memory) <= 24 * now / seconds:
            memory.append(round((memory_bytes() or 0) / 1e6, 1))
        if due and now >= due[0]:
            due.pop(0)
            state, tick = ticker.state, ticker.tick
            moment = state.clock.moment_at(tick)
            published = ticker.world.volumes.of_player[f"p{rng.randrange(options.players)}"].published
            checks.append(queries.submit(staleness, options.dataset, published, moment, state.weather.at(moment)))
        time.sleep(0.2)
    checks = [check.result() for check in checks]
    queries.shutdown()
    stats = ticker.stats
    ticks = stats.ticks - first_ticks
    report = {
        "dataset": dataset.world.name,
        "rate": options.rate,
        "players": options.players,
        "seconds": seconds,
        "ticks": ticks,
        "failed_ticks": stats.failed_ticks,
        "late_share": (stats.late_ticks - first_late) / ticks,
        "skipped": stats.skipped - first_skipped,
        "misses": stats.misses,
        "tick_ms_last_minute": stats.tick_ms,
        "memory_mb": memory,
        "staleness_median": float(np.median([c["median"] for c in checks])) if checks else None,
        "staleness_p95_median": float(np.median([c["p95"] for c in checks])) if checks else None,
        "checks": checks,
    }
    live.close()
    print(json.dumps(report, indent=1))
    return 1 if stats.failed_ticks else 0


if __name__ == "__main__":
    sys.exit(main())
