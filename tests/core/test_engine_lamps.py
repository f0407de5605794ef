"""Lamps through the engine: on and off by the clock, movable while it runs, never leaving a trace."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.settings import NEUTRAL, Settings

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
HERE = np.array([10.0, 2.0, 20.0])


@pytest.fixture
def engine() -> Engine:
    return Engine(Dataset.open(GOLDEN))


def served(engine: Engine, time: str = "23:30", settings: Settings = NEUTRAL) -> np.ndarray:
    return engine.volume(HERE, engine.lighting(time, "clear"), settings).values


def test_lamps_light_the_night(engine):
    lit = served(engine)
    engine.lamps = ()
    gained = lit - served(engine)
    assert gained.max() > 1  # lx; the moonless sky gives a thousandth
    assert (gained >= -1e-5 * lit.max()).all()


def test_a_lamp_burns_by_its_schedule(engine):
    stage = next(lamp for lamp in engine.lamps if lamp.schedule == "night")
    engine.lamps = (stage,)
    night, noon = served(engine, "23:30"), served(engine, "12:00")
    engine.lamps = ()
    assert (night > served(engine, "23:30")).any()
    np.testing.assert_array_equal(noon, served(engine, "12:00"))


def test_a_lamp_that_goes_off_gives_the_first_bytes_back(engine):
    lamps, engine.lamps = engine.lamps, ()
    dark = served(engine).tobytes()
    engine.lamps = lamps
    assert served(engine).tobytes() != dark
    engine.lamps = ()
    assert served(engine).tobytes() == dark


def test_a_lamp_moves_without_a_bake(engine):
    lamp = engine.lamps[0]
    before = served(engine).tobytes()
    x, y, z = lamp.position
    engine.lamps = (replace(lamp, position=(x + 3, y, z)), *engine.lamps[1:])
    moved = served(engine).tobytes()
    engine.lamps = (lamp, *engine.lamps[1:])
    assert moved != before
    assert served(engine).tobytes() == before


def test_lights_factor_is_a_gain_on_lamps_alone(engine):
    lit, double = served(engine), served(engine, settings=Settings(lights_factor=2.0))
    none = served(engine, settings=Settings(lights_factor=0.0))
    engine.lamps = ()
    np.testing.assert_array_equal(none, served(engine))
    # Two converged answers, each within 1e-5 of its peak.
    np.testing.assert_allclose(double - none, 2 * (lit - none), atol=4e-5 * double.max())


def test_a_very_bright_lamp_stays_finite(engine):
    engine.lamps = tuple(replace(lamp, lumens=1e9) for lamp in engine.lamps)
    assert np.isfinite(served(engine)).all()


def test_snow_brightens_the_street(engine):
    clear = engine.volume(HERE, engine.lighting("12:00", "clear:snow=0")).values
    snowy = engine.volume(HERE, engine.lighting("12:00", "clear:snow=1")).values
    # Light from below, on faces that look down, is what the ground sends back.
    assert snowy[3].mean() > 1.5 * clear[3].mean()
