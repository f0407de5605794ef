"""Air between the nodes of haze at which bounces are tabulated: close to a table of its own, and without a step."""

import math

import numpy as np
import pytest

from gi_core import bounces
from gi_core.air import ColumnsAt
from gi_core.air_optics import AirOptics
from gi_core.atmosphere import AEROSOL_ALBEDO, Atmosphere
from gi_core.sky import clear_sky, horizontal_illuminance

SUN = np.ones(8)


def sky_light(haze: float, elevation: float) -> np.ndarray:
    """(3,) [lx] on level ground."""
    e = math.radians(elevation)
    return horizontal_illuminance(clear_sky(Atmosphere(haze, 0.0), np.array([math.cos(e), math.sin(e), 0.0]), SUN, 0.15))


@pytest.mark.parametrize(("haze", "tolerance"), [(0.18, 0.003), (0.9, 0.004), (1.7, 0.01)])  # worst seen 0.0019, 0.0032, 0.0077
def test_between_nodes_the_sky_is_that_of_a_table_of_its_own(monkeypatch: pytest.MonkeyPatch, haze: float, tolerance: float) -> None:
    blended = [sky_light(haze, elevation) for elevation in (40.0, 3.0, -6.0)]
    monkeypatch.setattr(bounces, "_NODE_HAZE", haze)
    bounces._log_tables.cache_clear()
    exact = [sky_light(haze, elevation) for elevation in (40.0, 3.0, -6.0)]
    bounces._log_tables.cache_clear()
    np.testing.assert_allclose(blended, exact, rtol=tolerance)
    assert not np.array_equal(blended, exact)  # or the nodes were not moved, and nothing was compared


@pytest.mark.parametrize("node", [0.15 / math.sqrt(2), 0.15, 0.6, 1.2])
@pytest.mark.parametrize("elevation", [30.0, -6.0])
def test_no_step_across_a_node(node: float, elevation: float) -> None:
    below, above = (sky_light(node * factor, elevation) for factor in (1 - 1e-9, 1 + 1e-9))
    np.testing.assert_allclose(below, above, rtol=1e-6)  # tables are float32 beyond the blend


def test_hazes_beyond_the_nodes_take_the_outermost() -> None:
    heights = np.array([0.0, 3.0])
    ends = [bounces.BouncesAt(haze, AEROSOL_ALBEDO, heights).air for haze in (0.15 / 8, 1e-3, 2.4, 50.0)]
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_allclose(ends[2], ends[3], rtol=1e-5)
    assert (ends[0] < ends[2]).any()


def test_optics_scatter_what_they_do_not_absorb() -> None:
    optics = AirOptics(0.4, 0.9)
    np.testing.assert_allclose(optics.scatter[0], optics.depth[0])
    np.testing.assert_allclose(optics.scatter[1], 0.9 * optics.depth[1])
    overhead = optics.sunlight(ColumnsAt(np.zeros(1)), np.array([[1.0]]))[0, 0]
    np.testing.assert_allclose(overhead, np.exp(-optics.depth.sum(axis=0)), rtol=2e-3)  # the table's columns; 0.1 % of the air
