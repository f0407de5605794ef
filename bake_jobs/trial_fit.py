"""Voxel weights fitted to trial light, and what they leave: the bake's own estimate of its error."""

from collections.abc import Iterator

import numpy as np

from bake_jobs.adaptive import NEAR_SURFACE_M, Trial
from bake_jobs.config import BakeSettings
from bake_jobs.fit import fit_weights
from gi_core.arrays import Float32, Float64, Int64

# A face is fitted relative to its own light, but not below this share of the mean of the six: a face in the dark is no voxel's measure.
FAINT = 0.15
# As the judge does: errors relative to the light, or to this share of its mean where that is more.
JUDGED_FAINT = 0.02
VOXELS_AT_ONCE = 1024


class TrialFit:
    """Fits the voxels of one sector, and remembers how well."""

    def __init__(self, trial: Trial, lattice: Int64, settings: BakeSettings) -> None:
        """lattice : (V, 3) int64, world lattice indices of the sector's voxels."""
        self._trial, self._settings = trial, settings
        air = trial.air.lattice
        low = np.minimum(air.min(axis=0), lattice.min(axis=0)) if len(air) else lattice.min(axis=0)
        size = np.maximum(air.max(axis=0), lattice.max(axis=0)) - low + 1 if len(air) else lattice.max(axis=0) - low + 1
        number = np.full(tuple(size), -1, np.int64)
        number[tuple((air - low).T)] = np.arange(len(air))
        self._air_of_voxel = number[tuple((lattice - low).T)]
        self._errors: list[Float32] = []
        judged = trial.light.cube[trial.air.own & trial.air.in_band, trial.states.judged]
        self._faint = JUDGED_FAINT * judged.mean(axis=(0, 2), dtype=np.float64)[:, None] if len(judged) else np.zeros((1, 1))

    @property
    def estimated_error(self) -> float | None:
        """Median relative error of the held-out states at the sector's own voxels near surfaces; None where there is none."""
        return float(np.median(np.concatenate(self._errors))) if self._errors else None

    def shares(self, voxels: Int64, probes: Int64, closeness: Float64, by_distance: Float64) -> Float64:
        """Weights (n, c) of candidate probes (n, c) for some of the voxels.

        closeness : (n, c), 0 where the probe is not seen; by_distance : (n, c), what voxels get whose light is not known
        """
        found = np.array(by_distance, np.float64)
        air = self._air_of_voxel[voxels]
        for rows in _slices(np.flatnonzero(air >= 0)):
            # The nearest that are seen, in their order.
            order = np.argsort(closeness[rows] == 0, axis=1, kind="stable")[:, : self._settings.fit_candidates]
            near = np.take_along_axis(closeness[rows], order, axis=1)
            who = np.take_along_axis(probes[rows], order, axis=1)
            weight = self._fit(air[rows], who, near / near.sum(axis=1, keepdims=True))
            full = np.zeros((len(rows), closeness.shape[1]))
            np.put_along_axis(full, order, weight, axis=1)
            found[rows] = full
        return found

    def _fit(self, air: Int64, probes: Int64, prior: Float64) -> Float32:
        trial, settings = self._trial, self._settings
        states = trial.states
        target = trial.light.cube[air]
        of_probes = trial.probe_cube[probes]
        rows, columns = relative_rows(target, of_probes, states.fitted)
        weight = fit_weights(columns, rows, prior.astype(np.float32), settings.fit_ridge, settings.voxel_probes)
        near = trial.air.own[air] & trial.air.in_band[air] & (trial.light.clearance[air] <= NEAR_SURFACE_M)
        if near.any():
            truth = target[near][:, states.judged]
            blend = np.einsum("nc,ncsf->nsf", weight[near], of_probes[near][:, :, states.judged])
            self._errors.append((np.abs(blend - truth) / np.maximum(truth, self._faint)).astype(np.float32).ravel())
        return weight


def relative_rows(target: Float32, of_probes: Float32, fitted: slice, counts: Float64 | int = 1) -> tuple[Float32, Float32]:
    """What ``fit_weights`` fits: of light (n, S, 6) the rows (n, r), and of candidates' (n, c, S, 6) the columns (n, c, r), in the fitted
    states and relative to each face's own light; ``counts`` (n, 1, 6) is how much faces count, as a root."""
    scale = np.maximum(target, FAINT * target.mean(axis=2, keepdims=True))
    scale = (counts / np.maximum(scale, np.float32(1e-9))).astype(np.float32)
    rows = (target[:, fitted] * scale[:, fitted]).reshape(len(target), -1)
    return rows, (of_probes[:, :, fitted] * scale[:, None, fitted]).reshape(*of_probes.shape[:2], -1)


def _slices(rows: Int64) -> Iterator[Int64]:
    for start in range(0, len(rows), VOXELS_AT_ONCE):
        yield rows[start : start + VOXELS_AT_ONCE]
