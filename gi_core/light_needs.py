"""How far each sector of a world is from the light it should have: one row for each, so that a thousand cost what ten do."""

import numpy as np

from gi_core.arrays import Float64, Int64
from gi_core.light_blend import LightVector, relative_changes

# Light that may be anything is as far off as can be.
WHOLLY = 1.0
# A LightVector says how much light may change at most. Of that, probes are taken to move by what they were last seen to, and this at least.
LEAST_SHARE = 0.25


class LightNeeds:
    """The ticker's alone. Rows are a stream_need.SectorTable's."""

    def __init__(self, sectors: int) -> None:
        self.relit_at: Int64 = np.zeros(sectors, np.int64)
        """(n,) the tick of each sector's last relight."""
        self.exact = np.zeros(sectors, bool)
        """(n,) whether a sector holds the very bytes of a query, for light that stands still."""
        self._change: Float64 = np.zeros(sectors)
        self._numbers: Float64 | None = None
        self._scale: Float64 = np.zeros(sectors)
        self._light: LightVector | None = None
        self._moved: Float64 = np.zeros(sectors)
        """(n,) what ``_light`` has changed since the last relight of each sector that is there."""
        self._share: Float64 = np.ones(sectors)
        """(n,) how much of that its probes move by, LEAST_SHARE at least."""

    def arrived(self, row: int, tick: int, light: LightVector, change: float) -> None:
        """A sector has come, which was lit under a light before ``tick``; its probes last moved by a share of their peak."""
        self._moved[row], self._share[row] = 0.0, 1.0
        self.relit(row, tick - 1, light, change)

    def disturb(self, row: int, change: float) -> None:
        """Something has changed a sector's light by a share of it: a lamp, a look at the shadow map."""
        self._change[row] = max(self._change[row], change)
        self.exact[row] = False

    def relit(self, row: int, tick: int, light: LightVector, change: float, exact: bool = False) -> None:
        """A sector was relit under a light, and its probes moved by a share of their peak: so far from settled are its bounces."""
        if self._numbers is None:
            self._numbers = np.zeros((len(self._change), len(light.numbers)))
        moved = float(self._moved[row])
        if moved > self._change[row] and not exact:  # else bounces, or what disturbed it, may be what moved its probes
            self._share[row] = min(max(change / moved, LEAST_SHARE), 1.0)
        self._numbers[row], self._scale[row] = light.numbers, light.scale
        self.relit_at[row], self._change[row], self.exact[row] = tick, change, exact
        self._moved[row] = 0.0
        if light is not self._light:
            self._light = None

    def at_most(self, row: int) -> float:
        """How far a sector may be from its light, as of the last ``changes``."""
        return float(max(self._change[row], self._moved[row]))

    def changes(self, rows: Int64, light: LightVector) -> Float64:
        """(k,) for the rows of all sectors that are there: how far each is from its light, by its bounces or by what the light has changed
        since its last relight.

        Rows whose light has changed at all are no longer exact.
        """
        if light is not self._light:
            self._light = light
            if self._numbers is not None:
                moved = self._moved[rows] = relative_changes(self._numbers[rows], self._scale[rows], light)
                self.exact[rows[moved > 0]] = False
        return np.maximum(self._change[rows], self._moved[rows] * self._share[rows])
