"""The golden dataset's live world, and the engine whose queries say what it should show."""

import pytest
from live_run import GOLDEN

from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.live_world import LiveWorld


@pytest.fixture
def engine() -> Engine:
    """Without the dataset's lamps, some of which burn by day."""
    made = Engine(Dataset.open(GOLDEN))
    made.lamps = ()
    return made


@pytest.fixture
def world():
    made = LiveWorld(Dataset.open(GOLDEN), shadow_map=False)
    yield made
    made.close()
