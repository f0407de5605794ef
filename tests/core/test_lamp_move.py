"""The sweep of a lamp that moves: served light is behind at first, comes close in a few ticks, and lamps hang over streets."""

from pathlib import Path

import numpy as np
import pytest

from gi_core import lamp_move_table
from gi_core.constants import VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.lamp_move_table import MOVED_M, street_lamps
from gi_core.lamp_move_table import lamp_move_table as table

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
STREET = np.array([5.0, 2.0, 30.0])


@pytest.fixture
def engine() -> Engine:
    return Engine(Dataset.open(GOLDEN))


def test_a_moved_lamp_is_followed_within_a_few_ticks(engine):
    for row in table(engine.dataset, STREET, lamps=2, moves=4):
        assert len(row.of_brightest) == len(row.of_mean) == 4
        # Two sectors, both lit at every tick: more than one tick is for bounces alone. The bound is what other systems need.
        assert all(1 <= bright <= mean <= 9 for bright, mean in zip(row.of_brightest, row.of_mean, strict=True))


def test_light_that_is_never_close_is_told(engine, monkeypatch):
    monkeypatch.setattr(lamp_move_table, "PLACES", (2,))
    monkeypatch.setattr(lamp_move_table, "MOST_TICKS", 3)
    monkeypatch.setattr(lamp_move_table, "CLOSE", 1e-12)
    (row,) = table(engine.dataset, STREET, lamps=1, moves=1)
    assert row.of_mean == [3]


def test_lamps_hang_over_streets_and_stay_there_when_they_move(engine):
    volume = engine.volume(STREET, engine.lighting("12:00", "clear"))
    lamps = street_lamps(volume, 50)
    assert len({lamp.position for lamp in lamps}) == 50
    for lamp in lamps:
        for moved in (0.0, MOVED_M):
            x, y, z = np.round((np.array(lamp.position) + np.array([moved, 0, 0]) - volume.origin) / VOXEL_SIZE_M).astype(int)
            assert volume.mask[y, z, x] == VOXEL_OUTDOORS
            assert volume.mask[y - 1, z, x] == VOXEL_OUTDOORS
    volume.mask[:] = VOXEL_SOLID
    with pytest.raises(InputError, match="streets within 50 m"):
        street_lamps(volume, 1)
