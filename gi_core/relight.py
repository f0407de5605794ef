"""The relighter: a sector's arrays on the device, and the two passes that light them (slides "Relighting", "Multiple bounces")."""

from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from gi_core.arrays import Float32
from gi_core.constants import ALBEDO_MAX
from gi_core.device import Device
from gi_core.layout import SURFEL
from gi_core.relight_input import RelightInput
from gi_core.sector import Sector

# A query's light is this close to the fixed point of its bounces, as a share of the brightest value. Float32 sums of some hundred
# factors are good to 1e-6.
QUERY_RESIDUAL = 1e-5
# Passes between two looks at how far the light still moves; a look costs about as much as a pass.
_PASSES_PER_LOOK = 4
# With every albedo at ALBEDO_MAX in a closed room, 0.95 ** 512 is 4e-12.
MAX_PASSES = 512
# The loop loses at least 1 - ALBEDO_MAX of the light at every bounce.
_SLOWEST_RATE = ALBEDO_MAX
# Work-items per work-group; kernels guard against the last group's excess.
GROUP = 16


@dataclass(frozen=True)
class Converged:
    """cubes : (P, B, 3) float32 [lx]; residual : estimated distance to the fixed point as a share of the peak; passes : how many ran."""

    cubes: Float32
    residual: float
    passes: int


class ResidentSector:
    """One sector's buffers on a device. Only what the sector has: no emission, no buffer."""

    def __init__(self, device: Device, sector: Sector, sky_patches: int) -> None:
        self.sector = sector
        self.device = device
        surfels = np.zeros(sector.surfel_count, SURFEL.dtype)
        surfels["normal"], surfels["albedo"], surfels["snow"] = sector.surfel_normal, sector.surfel_albedo, sector.surfel_snow
        self.surfels = device.upload(surfels)
        self.brick_starts = device.upload(sector.brick_starts)
        self.feedback_probe = device.upload(sector.feedback_probe)
        self.feedback_weight = device.upload(sector.feedback_weight)
        self.emission = None if sector.surfel_emission is None else device.upload(sector.surfel_emission)
        self.sun_visibility = device.upload(sector.sun_visibility)
        self.factor_starts = device.upload(sector.factor_starts)
        self.factor_source = device.upload(sector.factor_source)
        self.factor_weight = device.upload(sector.factor_weight)
        self.voxel_probe = device.upload(sector.voxel_probe)
        self.voxel_weight = device.upload(sector.voxel_weight)
        self.cubes = device.allocate(sector.probe_count * sector.basis_size * 12)
        self.exitance = device.allocate((sector.brick_count + sky_patches) * 16)

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return sum(value.size for value in vars(self).values() if isinstance(value, cl.Buffer))

    def read_cubes(self) -> Float32:
        """The probes' cubes (P, B, 3) float32 [lx], after all that was enqueued."""
        cubes = np.zeros((self.sector.probe_count, self.sector.basis_size, 3), np.float32)
        self.device.read(self.cubes, cubes)
        return cubes

    def write_cubes(self, cubes: Float32) -> None:
        """Set the probes' cubes (P, B, 3) float32 [lx]: where the next pass takes its feedback from."""
        if cubes.size:
            cl.enqueue_copy(self.device.queue, self.cubes, np.ascontiguousarray(cubes, np.float32))


class Relighter:
    """Lights resident sectors on one device."""

    def __init__(self, device: Device) -> None:
        self.device = device

    def relight(self, residents: list[ResidentSector], given: RelightInput, passes: int = 1) -> None:
        """Enqueue passes over sectors; each pass adds one bounce to the cubes that a sector holds. Returns before the device is done."""
        # A query runs some hundred passes over one sector: arguments are bound once, launches repeat.
        lights = self.device.upload(given.lights) if len(given.lights) else None
        patches = np.zeros((len(given.patch_exitance), 4), np.float32)
        patches[:, :3] = given.patch_exitance
        launches = []
        for resident in residents:
            sector = resident.sector
            if sector.probe_count == 0:
                continue
            cl.enqueue_copy(self.device.queue, resident.exitance, patches, dst_offset=sector.brick_count * 16, is_blocking=False)
            if sector.brick_count:
                launches.append(self._bricks(resident, lights, len(given.lights)))
            launches.append(self._probes(resident))
        for _ in range(passes):
            for kernel, items in launches:
                cl.enqueue_nd_range_kernel(self.device.queue, kernel, (_whole_groups(items),), (GROUP,))
        self.device.queue.flush()

    def converge(self, resident: ResidentSector, given: RelightInput, residual: float = QUERY_RESIDUAL) -> Converged:
        """Relight a sector from darkness until what later bounces could still add is below ``residual`` times the peak.

        The remaining distance is estimated from how fast the change shrinks: change * rate / (1 - rate), as for any contraction.
        """
        sector = resident.sector
        after = np.zeros((sector.probe_count, sector.basis_size, 3), np.float32)
        if sector.probe_count == 0:
            return Converged(after, 0.0, 0)
        resident.write_cubes(after)
        passes, left, last_change = 0, 0.0, 0.0
        while passes < MAX_PASSES:
            self.relight([resident], given, _PASSES_PER_LOOK - 1)
            before = resident.read_cubes()
            self.relight([resident], given, 1)
            after = resident.read_cubes()
            passes += _PASSES_PER_LOOK
            peak, change = float(np.abs(after).max()), float(np.abs(after - before).max())
            if change <= np.finfo(np.float32).eps * peak:
                return Converged(after, 0.0, passes)
            rate = min((change / last_change) ** (1 / _PASSES_PER_LOOK), _SLOWEST_RATE) if last_change else _SLOWEST_RATE
            left, last_change = change * rate / (1 - rate) / peak, change
            if left <= residual:
                break
        return Converged(after, left, passes)

    def _bricks(self, resident: ResidentSector, lights: cl.Buffer | None, light_count: int) -> tuple[cl.Kernel, int]:
        sector = resident.sector
        kernel = self.device.kernel(
            "relight_bricks",
            DIRECTIONAL_LIGHTS=light_count,
            FEEDBACK_PROBES=sector.feedback_probe.shape[1],
            HAS_EMISSION=int(resident.emission is not None),
        )
        arguments = [
            np.uint32(sector.brick_count),
            resident.brick_starts,
            resident.surfels,
            resident.feedback_probe,
            resident.feedback_weight,
            resident.cubes,
        ]
        if resident.emission is not None:
            arguments.append(resident.emission)
        if lights is not None:
            arguments += [resident.sun_visibility, np.uint32(sector.sun_visibility.shape[1]), lights]
        kernel.set_args(*arguments, resident.exitance)
        return kernel, sector.brick_count

    def _probes(self, resident: ResidentSector) -> tuple[cl.Kernel, int]:
        sector = resident.sector
        kernel = self.device.kernel("gather_probes", BASIS_SIZE=sector.basis_size)
        kernel.set_args(
            np.uint32(sector.probe_count),
            resident.factor_starts,
            resident.factor_source,
            resident.factor_weight,
            resident.exitance,
            resident.cubes,
        )
        return kernel, sector.probe_count


def _whole_groups(items: int) -> int:
    return -(-items // GROUP) * GROUP
