"""The staleness sweep: light that stands is exact, light that runs is behind, and less so with more sectors a tick."""

from pathlib import Path

import numpy as np
import pytest

from gi_core import staleness_table
from gi_core.dataset import Dataset
from gi_core.errors import OutsideWorldError
from gi_core.lighting_model import make_lighting
from gi_core.lights import lamps_on
from gi_core.staleness_table import Row, flickering, no_lamps
from gi_core.staleness_table import staleness_table as table

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
STREET = np.array([5.0, 2.0, 30.0])


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(staleness_table, "PLACES", (1, 2))
        patch.setattr(staleness_table, "RATES", (1.0, 600.0))
        patch.setattr(staleness_table, "RUN_TICKS", 40)
        patch.setattr(staleness_table, "CHECKS", 4)
        return table(Dataset.open(GOLDEN), STREET)


def test_every_motion_is_swept_with_every_number_of_sectors(rows):
    assert [(row.moves, row.places) for row in rows] == [
        (moves, places) for moves in ("clock, 1 x", "clock, 600 x", "8 lamps, 3 Hz") for places in (1, 2)
    ]
    assert all(np.isfinite([row.median, row.p95, row.bias, row.changes]).all() for row in rows)
    assert all(row.tick_ms > 0 for row in rows if row.moves != "clock, 1 x")


def test_a_day_at_its_own_pace_is_never_behind(rows):
    assert max(row.median for row in rows if row.moves == "clock, 1 x") < 1e-3


def test_what_moves_faster_is_further_behind_and_more_sectors_a_tick_catch_up(rows):
    slow, half, fast_two = rows[0], rows[2], rows[3]
    assert half.changes > 100 * slow.changes > 0
    assert half.p95 > fast_two.p95 > slow.p95
    flicker_half, flicker_two = rows[4], rows[5]
    assert flicker_half.p95 > flicker_two.p95


def test_lamps_flicker_out_of_step_about_their_mean():
    lamps = flickering(STREET)
    levels = np.array([[lamp.lumens for lamp in lamps(tick)] for tick in range(10)])
    np.testing.assert_allclose(levels.mean(axis=0), 8000, rtol=1e-6)  # ten ticks are one turn of 3 Hz
    assert levels.min() >= 4000
    assert levels.max() <= 12_000
    assert len(set(levels[0].round())) > 3
    night = make_lighting(Dataset.open(GOLDEN).world.location, "23:30", "clear")
    assert len(lamps_on(lamps(0), night)) == staleness_table.LAMPS
    assert no_lamps(3) == ()


def test_a_place_beyond_the_world_is_refused():
    with pytest.raises(OutsideWorldError):
        table(Dataset.open(GOLDEN), np.array([9000.0, 2.0, 30.0]))
