"""What features hold on the device is what their buffers hold, each counted once. Times are for a quiet machine to tell."""

import pytest

from gi_core.bench import SURFELS_PER_BRICK, TALK_SURFELS, Measurement
from gi_core.bench_features import bench_features
from gi_core.device import shared_device
from gi_core.layout import SURFEL_WORD

BAKED = {"emission", "feedback_weights"}
GROUPED = -(-TALK_SURFELS // 8) * 8
WORDS = -(-TALK_SURFELS // 32)


@pytest.fixture(scope="module")
def rows() -> dict[str, Measurement]:
    return {row.name.removeprefix("feature_"): row for row in bench_features(shared_device(), rounds=1)}


def test_every_feature_has_a_row_beside_the_same_tick_without_it(rows: dict[str, Measurement]) -> None:
    assert list(rows) == ["sun", "moon", "snow", "lamps", "emission", "feedback_weights", "shadow_map", "interior", "fog"]
    for name, row in rows.items():
        assert row.ratio == pytest.approx(row.baseline / row.median)
        assert {"us_added", "bytes_added"} <= set(row.sizes)
        assert ({"us_left", "bytes_left"} <= set(row.sizes)) == (name not in BAKED)


def test_bytes_are_those_of_two_sectors_each_counted_once(rows: dict[str, Measurement]) -> None:
    added = {name: row.sizes["bytes_added"] for name, row in rows.items()}
    # Place and cell, the share of the sun, the number of the map.
    assert added["shadow_map"] == 2 * GROUPED * (16 + 1 + 2)
    # The sum of static lamps and that with dynamic ones, by surfel, and what bricks make of it; surfels' places in words, and 32 planes of
    # bits, the fewest there are.
    summed = 2 * 16 * TALK_SURFELS + 16 * (TALK_SURFELS // SURFELS_PER_BRICK)
    assert added["lamps"] == 2 * (summed + SURFEL_WORD.dtype.itemsize * WORDS + 32 * 4 * WORDS)
    # Four probes and weights for each of 16 * 20 * 20 voxels.
    assert added["interior"] == 2 * 6400 * 4 * (2 + 4)
    assert added["snow"] == added["fog"] == 0


def test_what_is_off_again_leaves_nothing_but_what_the_next_sunrise_needs(rows: dict[str, Measurement]) -> None:
    left = {name: row.sizes["bytes_left"] for name, row in rows.items() if name not in BAKED}
    assert {name for name, count in left.items() if count} == {"sun", "moon"}
    for name in ("sun", "moon"):
        assert left[name] == rows[name].sizes["bytes_added"]
