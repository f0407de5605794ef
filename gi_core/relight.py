"""The relighter: passes over resident sectors, a few each tick or until nothing moves any more (slide "Relighting")."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from gi_core.arrays import Float32
from gi_core.basis import FEEDBACK, basis_of_size
from gi_core.device import LANES, Device
from gi_core.grid import SectorIndex
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import LightOnDevice, ResidentSector

log = logging.getLogger("sectorlight.relight")

# A query's light is this close to the fixed point of its bounces, as a share of the brightest value. Float32 sums of some hundred
# factors are good to 1e-6.
QUERY_RESIDUAL = 1e-5
# Passes between two looks at how far the light still moves; a look costs about as much as a pass.
_PASSES_PER_LOOK = 4
# With every albedo at ALBEDO_MAX in a closed room, 0.95 ** 512 is 4e-12.
MAX_PASSES = 512


@dataclass(frozen=True)
class Converged:
    """What a query's bounces came to.

    cubes : (P, B, 3) float32 [lx]
    first_bounce : (P, B, 3) float32 [lx], sky and the first surface alone: what one pass from darkness gives
    residual : estimated distance to the fixed point as a share of the peak
    passes : how many ran
    """

    cubes: Float32
    first_bounce: Float32
    residual: float
    passes: int


class Relighter:
    """Lights resident sectors on one device."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self._light: LightOnDevice | None = None
        self._told_of: set[SectorIndex] = set()

    def relight(self, residents: Sequence[ResidentSector], given: RelightInput, passes: int | Sequence[int] = 1) -> None:
        """Enqueue passes over sectors, as many for each or a number of its own; each pass adds one bounce to the cubes that a sector holds.

        One sector's are on their way when this returns. Several go on side by side, and all but the first's are done.
        """
        for lane in self._begin(residents, given, passes)[1:LANES]:
            lane.finish()

    def begin(self, residents: Sequence[ResidentSector], given: RelightInput, passes: Sequence[int]) -> list[Callable[[], Float32]]:
        """As ``relight``, but all are on their way when this returns, and the cubes that they make as well: one function for each sector,
        to be called before anything else is done with it, which waits for them and gives them (P, B, 3) [lx]."""
        lanes = self._begin(residents, given, passes)
        reading = [resident.begin_reading(lane) for resident, lane in zip(residents, lanes, strict=True)]
        for lane in lanes[:LANES]:
            lane.flush()
        return reading

    def _begin(self, residents: Sequence[ResidentSector], given: RelightInput, passes: int | Sequence[int]) -> list[cl.CommandQueue]:
        """-> each sector's queue, the first being the device's own"""
        if self._light is None or self._light.given is not given:
            self._light = LightOnDevice(self.device, given)
        for resident in residents:
            resident.light(self._light)
        lanes = (self.device.queue, *self.device.lanes[1:])[: len(residents)]
        if len(lanes) > 1:
            # By the host: what queues wait for one another costs more than going on side by side gains.
            self.device.queue.finish()
        each = [passes] * len(residents) if isinstance(passes, int) else passes
        for place, (resident, count) in enumerate(zip(residents, each, strict=True)):
            resident.enqueue(lanes[place % len(lanes)], count)
        for lane in lanes:
            lane.flush()
        return [lanes[place % len(lanes)] for place in range(len(residents))]

    def converge(self, resident: ResidentSector, given: RelightInput) -> Converged:
        """Relight a sector from darkness until what later bounces could still add is below QUERY_RESIDUAL times the peak.

        The remaining distance is estimated from how fast the change shrinks: change * rate / (1 - rate), as for any contraction. Where
        MAX_PASSES were not enough the light is returned as it is, and the log tells so, once for a sector.
        """
        sector = resident.sector
        after = np.zeros((sector.probe_count, sector.basis_size, 3), np.float32)
        slowest = FEEDBACK[basis_of_size(sector.basis_size)].shrinks
        if sector.probe_count == 0:
            return Converged(after, after, 0.0, 0)
        resident.write_cubes(after)
        self.relight([resident], given, 1)
        first = resident.read_cubes()
        passes, left, last_change = 1, 0.0, 0.0
        while passes < MAX_PASSES:
            self.relight([resident], given, _PASSES_PER_LOOK - 1)
            before = resident.read_cubes()
            self.relight([resident], given, 1)
            after = resident.read_cubes()
            passes += _PASSES_PER_LOOK
            peak, change = float(np.abs(after).max()), float(np.abs(after - before).max())
            if change <= np.finfo(np.float32).eps * peak:
                return Converged(after, first, 0.0, passes)
            rate = min((change / last_change) ** (1 / _PASSES_PER_LOOK), slowest) if last_change else slowest
            left, last_change = change * rate / (1 - rate) / peak, change
            if left <= QUERY_RESIDUAL:
                break
        if left > QUERY_RESIDUAL and sector.index not in self._told_of:
            self._told_of.add(sector.index)
            log.warning(
                "sector %s: bounces given up after %d passes, %.1e of the brightest value from their fixed point; expected %.1e",
                f"{sector.index.x},{sector.index.z}",
                passes,
                left,
                QUERY_RESIDUAL,
            )
        return Converged(after, first, left, passes)
