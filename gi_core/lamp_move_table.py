"""After one of many lamps has moved: ticks until served light is within a thousandth of its fixed point.

    python -m gi_core.lamp_move_table DATASET X,Y,Z [--lamps 200] [--moves 40]      around a player there; a table on stdout

Lamps stand in the streets of the player's volume, and no others are lit. Ticks are stepped one after another without a shadow map, so a
busy machine changes nothing.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gi_core.arrays import Float64
from gi_core.constants import VOXEL_OUTDOORS, VOXEL_SIZE_M
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.live_world import LiveWorld, TickPlayers
from gi_core.staleness_table import NIGHT, live_light, parse_position, settle
from gi_core.volume import Volume
from gi_core.world import Lamp

PLACES = (2, 4, 8)
MOVED_M = 3.0
CLOSE = 1e-3
MOST_TICKS = 200
LUMENS = 8000.0


@dataclass(frozen=True)
class Row:
    """Sectors relit in a tick, and for each move the ticks until the volume's light (B, 16, 32, 32, 3) lies everywhere within CLOSE.

    of_brightest, of_mean : of its brightest value, and of its mean, which is far stricter; 0 where it already lay there, MOST_TICKS
        where it came no closer in so many
    """

    places: int
    of_brightest: list[int]
    of_mean: list[int]


def lamp_move_table(dataset: Dataset, position: Float64, lamps: int, moves: int) -> list[Row]:
    """A row for each of PLACES, the same lamps and moves in all.

    Raises OutsideWorldError for a position (3,) [m] beyond the dataset, InputError where its volume has no street, CorruptFileError.
    """
    engine = Engine(dataset)
    lighting = engine.lighting(NIGHT, "clear")
    standing = street_lamps(engine.volume(position, lighting), lamps)
    player = TickPlayers(("one",), position[None], np.zeros((1, 3)))
    rows = []
    for places in PLACES:
        world, now, tick, row = LiveWorld(dataset, shadow_map=False, places=places), standing, 0, Row(places, [], [])
        try:
            for number in range(moves):
                tick = settle(world, tick, player, live_light(world, lighting, now, standing=True))
                old = now[number % lamps]
                x, y, z = old.position
                new = replace(old, position=(x + MOVED_M, y, z))
                now = engine.lamps = tuple(new if lamp is old else lamp for lamp in now)
                goal = engine.volume(position, lighting).values
                world.lamps_moved([(np.array(lamp.position), lamp.range_m) for lamp in (old, new)])
                light, errors = live_light(world, lighting, now, standing=False), []
                for _ in range(MOST_TICKS):
                    published = world.published("one")
                    assert published is not None
                    errors.append(float(np.abs(published.values - goal).max()))
                    if errors[-1] <= CLOSE * goal.mean():
                        break
                    world.tick(tick, player, light)
                    tick += 1
                for found, scale in ((row.of_brightest, goal.max()), (row.of_mean, goal.mean())):
                    found.append(next((i for i, error in enumerate(errors) if error <= CLOSE * scale), MOST_TICKS))
        finally:
            world.close()
        rows.append(row)
    return rows


def street_lamps(volume: Volume, count: int) -> tuple[Lamp, ...]:
    """Lamps of a fixed seed in the second voxel above the street, with street on their east side too. Raises InputError without any."""
    air = volume.mask == VOXEL_OUTDOORS
    lowest = np.where(air.any(axis=0), air.argmax(axis=0), len(air))
    street = lowest <= min(lowest.min() + 1, len(air) - 2)
    columns = np.argwhere(street[:, :-1] & street[:, 1:])
    if not len(columns):
        raise InputError("position: expected a place with streets within 50 m of it")
    rng = np.random.default_rng(0)
    z, x = columns[rng.integers(0, len(columns), count)].T
    places = volume.origin + VOXEL_SIZE_M * np.stack([x, lowest[z, x] + 1, z], axis=1) + rng.uniform(-1, 1, (count, 3)) * (1, 0, 1)
    return tuple(Lamp(f"lamp {i}", "point", (x, y, z), LUMENS) for i, (x, y, z) in enumerate(places.tolist()))


def main() -> None:
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("position", help="X,Y,Z [m]")
    parser.add_argument("--lamps", type=int, default=200)
    parser.add_argument("--moves", type=int, default=40)
    given = parser.parse_args()
    rows = lamp_move_table(Dataset.open(given.dataset), parse_position(given.position), given.lamps, given.moves)
    print("| sectors a tick | within 1e-3 of the brightest: median | most | of the mean: median | most |\n|---|---|---|---|---|")
    for row in rows:
        figures = " | ".join(f"{_text(float(np.median(ticks)))} | {_text(max(ticks))}" for ticks in (row.of_brightest, row.of_mean))
        print(f"| {row.places} | {figures} |")


def _text(ticks: float) -> str:
    return f"{ticks:g}" if ticks < MOST_TICKS else "not in time"


if __name__ == "__main__":
    main()
