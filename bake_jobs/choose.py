"""Which voxels become probes: greedily, the one that best explains the light of all voxels that see it.

The light of voxel v is a vector l(v), logarithms of the six faces in a few states, so that differences are relative errors. What chosen
probes explain of it is p(v), a blend of theirs; a new probe j can be blended in by a share t,

    p'(v) = p(v) + t (l(j) - p(v)),     t = clip(<l(v) - p(v), l(j) - p(v)> / |l(j) - p(v)|^2, 0, 1)

one step of Frank and Wolfe's towards the best blend. The gain of j is what |l(v) - p(v)|^2 falls by, summed over the voxels v that see j,
each by its importance. Where nothing is chosen yet, p explains nothing and counts as off by UNLIT. Probes are taken until the best gain is
less than a probe is worth: so a dense alley gets many and an empty plaza few, and all over a city the last probe is worth the same.

Pure: arrays in, a choice out.
"""

from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Bool, Float32, Float64, Int64

# Squared error of a voxel without any probe, in logarithms squared: as if its light were 2.7 times what it is.
UNLIT = 1.0
# A candidate may explain voxels this many voxels away; farther ones only from a lattice of every second, and of every fourth, voxel.
REACHES = ((2.5, 1), (5.0, 2), (8.0, 4))
# Two gains this close are equal, and the earlier candidate wins: rounding must not decide where a probe stands.
GAIN_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class Pairs:
    """Which candidates could explain which voxels: (v, j), sorted by v then j; n voxels.

    starts : (n + 1,) int64 into ``probe``; probe : (m,) int64, candidate voxels; voxel : (m,) int64
    by_probe : (m,) int64, pair numbers sorted by probe; probe_starts : (n + 1,) int64 into it
    """

    starts: Int64
    probe: Int64
    voxel: Int64
    by_probe: Int64
    probe_starts: Int64

    def within(self, voxels: Int64) -> "Pairs":
        """The pairs of some voxels (k,), ascending, with one another: voxel and candidate numbers are places in ``voxels``."""
        place = np.full(len(self.starts) - 1, -1)
        place[voxels] = np.arange(len(voxels))
        at, of_voxel = self.of_voxels(voxels)
        probe = place[self.probe[at]]
        return Pairs.of(of_voxel[probe >= 0], probe[probe >= 0], len(voxels))

    def of_voxels(self, voxels: Int64) -> tuple[Int64, Int64]:
        """Numbers (m,) of the pairs of some voxels (k,), and of each which of the k it is of."""
        return _of_runs(self.starts, voxels)

    @classmethod
    def of(cls, voxel: Int64, probe: Int64, count: int) -> "Pairs":
        """From unsorted pairs (m,) over ``count`` voxels."""
        order = np.lexsort((probe, voxel))
        voxel, probe = voxel[order], probe[order]
        by_probe = np.argsort(probe, kind="stable")
        starts, probe_starts = (np.concatenate([[0], np.cumsum(np.bincount(ids, minlength=count))]) for ids in (voxel, probe))
        return cls(starts, probe, voxel, by_probe, probe_starts)


def _of_runs(starts: Int64, runs: Int64) -> tuple[Int64, Int64]:
    """Members (m,) of some runs (k,), which begin at ``starts``, and of each which of the k it is of."""
    number = starts[runs + 1] - starts[runs]
    first = np.cumsum(number) - number
    at = np.arange(int(number.sum())) + np.repeat(starts[runs] - first, number)
    return at, np.repeat(np.arange(len(runs)), number)


def neighbour_pairs(lattice: Int64, any_step: Bool) -> tuple[Int64, Int64]:
    """Pairs (v, j) of voxels with world lattice indices (n, 3) that are close enough to explain one another. Each voxel explains itself.

    any_step : (n, 3), axes along which a voxel may explain far ones wherever it lies: across a strip that is too narrow for a thin lattice
    """
    low = lattice.min(axis=0) - 8
    shape = lattice.max(axis=0) - low + 9
    number = np.full(tuple(shape), -1, np.int64)
    number[tuple((lattice - low).T)] = np.arange(len(lattice))
    flat = np.ravel_multi_index(tuple((lattice - low).T), tuple(shape))
    voxels, probes = [], []
    nearer = -1.0
    for reach, step in REACHES:
        radius = int(reach)
        steps = np.arange(-radius, radius + 1)
        offset = np.stack([a.ravel() for a in np.meshgrid(steps, steps, steps, indexing="ij")], axis=1)
        distance = np.linalg.norm(offset, axis=1)
        offset = offset[(distance <= reach) & (distance > nearer)]
        nearer = reach
        coarse = np.flatnonzero(((lattice % step == 0) | any_step).all(axis=1))
        # From the few that explain to the many that are explained.
        for step_flat in offset @ np.array([shape[1] * shape[2], shape[2], 1]):
            found = number.reshape(-1)[flat[coarse] + step_flat]
            there = found >= 0
            voxels.append(found[there])
            probes.append(coarse[there])
    return np.concatenate(voxels), np.concatenate(probes)


class Chooser:
    """Probes chosen so far, and what they leave unexplained."""

    def __init__(self, light: Float32, importance: Float64, pairs: Pairs, may: Bool) -> None:
        """light : (n, d) logarithms, scaled so that |l(v) - l(j)|^2 is a mean squared relative error; importance : (n,);
        may : (n,) which voxels can become probes."""
        self._light, self._importance, self._pairs, self._may = light, importance, pairs, may.copy()
        self._explained = np.zeros_like(light)
        self._covered = np.zeros(len(light), bool)
        # Pairs by which something can be gained, as probe of each and where each voxel's begin: about half of all.
        useful = may[pairs.probe] & (importance[pairs.voxel] > 0)
        self._open = pairs.probe[useful]
        self._open_starts = np.concatenate([[0], np.cumsum(useful)])[pairs.starts]
        self._open_gain = np.zeros(len(self._open))
        self._gain = np.zeros(len(light))
        self.chosen: list[int] = []
        self._refresh(np.arange(len(light)))

    @property
    def error(self) -> Float64:
        """(n,): squared error of each voxel, as far as the steps went."""
        off = self._light - self._explained
        return np.where(self._covered, np.einsum("nd,nd->n", off, off), UNLIT)

    def take(self, *probes: int) -> None:
        """Choose voxels, one after the other."""
        touched = [self._blend_in(probe) for probe in probes]
        if touched:
            self._refresh(touched[0] if len(touched) == 1 else np.unique(np.concatenate(touched)))

    def _blend_in(self, probe: int) -> Int64:
        """Explain voxels by one probe more; which (t,). What others would gain there is to be worked out anew."""
        self.chosen.append(probe)
        self._may[probe] = False
        pairs = self._pairs
        touched = pairs.voxel[pairs.by_probe[pairs.probe_starts[probe] : pairs.probe_starts[probe + 1]]]
        step, share = self._steps(touched, np.full(len(touched), probe))
        self._explained[touched] += share[:, None] * step
        self._covered[touched] = True
        return touched

    def take_best(self, worth: float, most: int) -> None:
        """Choose until no probe gains as much as ``worth``, or ``most`` more are chosen."""
        for _ in range(most):
            gain = np.where(self._may, np.round(self._gain / GAIN_STEP), -1)
            best = int(np.argmax(gain))
            if gain[best] * GAIN_STEP < worth or not self._may[best]:
                return
            self.take(best)

    def _steps(self, voxel: Int64, probe: Int64) -> tuple[Float32, Float32]:
        """For pairs (m,): way (m, d) from what is explained to the probe's light, and how far to go along it (m,)."""
        explained = self._explained[voxel]
        step = self._light[probe] - explained
        off = self._light[voxel] - explained
        squared = np.einsum("md,md->m", step, step)
        share = np.clip(np.einsum("md,md->m", off, step) / np.maximum(squared, 1e-12), 0, 1)
        return step, np.where(self._covered[voxel], share, 1).astype(np.float32)

    def _refresh(self, voxels: Int64) -> None:
        """Work out anew what every probe would gain at these voxels."""
        at, of_voxel = _of_runs(self._open_starts, voxels)
        probe = self._open[at]
        explained, covered = self._explained[voxels], self._covered[voxels]
        off = self._light[voxels] - explained
        # |off - t step|^2 at the best t, from scalar products. take: three times as fast as indexing, and this is where the time goes.
        step = self._light.take(probe, axis=0)
        step -= explained.take(of_voxel, axis=0)
        along, length = np.einsum("md,md->m", off.take(of_voxel, axis=0), step), np.einsum("md,md->m", step, step)
        share = np.clip(along / np.maximum(length, 1e-12), 0, 1)
        fall = share * (2 * along - share * length)
        # A voxel without any probe takes all of its first one's light, whatever it misses.
        bare = ~covered.take(of_voxel)
        if bare.any():
            own = np.einsum("kd,kd->k", off, off).take(of_voxel)
            fall = np.where(bare, UNLIT - (own - 2 * along + length), fall)
        gain = np.maximum(fall, 0) * self._importance[voxels].take(of_voxel)
        self._gain += np.bincount(probe, gain - self._open_gain[at], len(self._gain))
        self._open_gain[at] = gain
