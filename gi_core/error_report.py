"""What ``sectorlight compare`` measured, as a dataset keeps it, and what it lets a reader of a volume expect.

{"states": {state: {stage: {"n", "median", "p95", "bias", "nrmse", "noise", "median_ci"}}}, "expected_error": ..., ...}
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

OWN, CUBE, FINE = "shaded", "shaded_cube", "shaded_fine"
OWN_ROOMS, CUBE_ROOMS = "shaded_rooms", "shaded_rooms_cube"
# Below this share of the mean a point is black to the eye, and dividing by it would only measure noise.
DARKEST_SHARE_OF_MEAN = 0.02


def expected_error(report: Mapping[str, Any] | None, own_basis: str, basis: str, cascade: int = 0, in_rooms: bool = False) -> float | None:
    """Median relative error of what a client reconstructs on surfaces: the median of the states' medians.

    own_basis, basis : the dataset's, and that of the volume; cascade : of the volume; in_rooms : whether it is an interior one. None
    where nothing like it was measured: without a report, for coarser cascades, and for harmonics poorer than the dataset's.
    """
    if report is None:
        return None
    if cascade == 0 and basis in (own_basis, "cube"):
        stage = ((OWN, CUBE), (OWN_ROOMS, CUBE_ROOMS))[in_rooms][basis != own_basis]
    elif cascade == -1 and basis == own_basis:
        stage = FINE
    else:
        return None
    states = report.get("states")
    found = [_median(stages, stage) for stages in states.values()] if isinstance(states, Mapping) else []
    known = [median for median in found if median is not None]
    return float(np.median(known)) if known else None


def _median(stages: Any, stage: str) -> float | None:
    """A report is JSON from a file: whatever does not fit was not measured."""
    numbers = stages.get(stage) if isinstance(stages, Mapping) else None
    median = numbers.get("median") if isinstance(numbers, Mapping) else None
    return float(median) if isinstance(median, int | float) else None
