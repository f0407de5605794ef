"""How far sectors are from their light: by bounces, by what disturbed them, and by what light has changed."""

import numpy as np
import pytest

from gi_core.light_blend import LightVector
from gi_core.light_needs import LEAST_SHARE, LightNeeds

ROWS = np.arange(2)


def light(level: float) -> LightVector:
    return LightVector(np.array([level, 0.0]), 100.0)


@pytest.mark.parametrize(("share", "taken"), [(0.5, 0.5), (0.01, LEAST_SHARE), (7.0, 1.0)])
def test_what_light_changes_counts_as_far_as_probes_were_seen_to_move(share, taken):
    needs = LightNeeds(2)
    for row in ROWS:
        needs.arrived(row, 1, light(100.0), 0.0)
    np.testing.assert_allclose(needs.changes(ROWS, light(99.0)), 0.01)  # nothing is known yet: all of it
    needs.relit(0, 2, light(99.0), 0.01 * share)
    np.testing.assert_allclose(needs.changes(ROWS, light(97.0)), [max(0.02 * taken, 0.01 * share), 0.03])
    needs.arrived(0, 3, light(97.0), 0.0)
    np.testing.assert_allclose(needs.changes(ROWS, light(96.0)), [0.01, 0.04])


def test_what_disturbed_a_sector_says_nothing_of_how_it_follows_light():
    needs = LightNeeds(2)
    for row in ROWS:
        needs.arrived(row, 1, light(100.0), 0.0)
    needs.disturb(0, 0.5)
    np.testing.assert_allclose(needs.changes(ROWS, light(99.0)), [0.5, 0.01])
    needs.relit(0, 2, light(99.0), 0.0)
    np.testing.assert_allclose(needs.changes(ROWS, light(98.0)), [0.01, 0.02])
