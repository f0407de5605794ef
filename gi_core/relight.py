"""The relighter: a sector's arrays on the device, and the two passes that light them (slides "Relighting", "Multiple bounces")."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

from gi_core.arrays import AnyArray, Float32
from gi_core.constants import ALBEDO_MAX
from gi_core.device import Device
from gi_core.layout import DIRECTIONAL_LIGHT, MAX_DIRECTIONAL_LIGHTS, SURFEL
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


class Launch:
    """A kernel with its arguments bound, and how many work-items it needs, rounded up to whole work-groups."""

    def __init__(self, kernel: cl.Kernel, items: int) -> None:
        self.kernel = kernel
        self.global_size = -(-items // GROUP) * GROUP


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
        weighted = sector.feedback_probe.shape[1] > 1 or not (sector.feedback_weight == 1).all()
        self.feedback_weight = device.upload(sector.feedback_weight) if weighted else None
        self.emission = None if sector.surfel_emission is None else device.upload(sector.surfel_emission)
        self.factor_starts = device.upload(sector.factor_starts)
        self.factor_source = device.upload(sector.factor_source)
        self.factor_weight = device.upload(sector.factor_weight)
        self.voxel_probe = device.upload(sector.voxel_probe)
        self.voxel_weight = device.upload(sector.voxel_weight)
        self.cubes = device.allocate(sector.probe_count * sector.basis_size * 16)
        self.exitance = device.allocate((sector.brick_count + sky_patches) * 16)
        self.lights = device.allocate(MAX_DIRECTIONAL_LIGHTS * DIRECTIONAL_LIGHT.dtype.itemsize)
        self._fill: cl.Kernel | None = None
        # Neither is there before the first sun or moon.
        self.sun_visibility: cl.Buffer | None = None
        self.plane_bits: cl.Buffer | None = None
        self._planes = b""
        self._given: RelightInput | None = None
        self._has_snow = bool(sector.surfel_snow.any())
        self._lamps: cl.Buffer | None = None
        self._launches: dict[tuple[int, bool], list[Launch]] = {}

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return sum(value.size for value in vars(self).values() if isinstance(value, cl.Buffer))

    def launches(self, given: RelightInput) -> list["Launch"]:
        """One pass over this sector under ``given``, whose light is on the device when this returns; empty without probes.

        Arguments are bound once for each number of lights: making a kernel takes longer than running it.
        """
        if self.sector.probe_count == 0:
            return []
        if given is not self._given:
            patches = np.zeros((len(given.patch_exitance), 4), np.float32)
            patches[:, :3] = given.patch_exitance
            cl.enqueue_copy(self.device.queue, self.exitance, patches, dst_offset=self.sector.brick_count * 16)
            if len(given.lights):
                cl.enqueue_copy(self.device.queue, self.lights, np.ascontiguousarray(given.lights))
                self._select_planes(given)
            self._given = given
        variant = (len(given.lights), self._has_snow and given.snow > 0)
        if variant not in self._launches:
            self._launches[variant] = [*([self._bind_bricks(*variant)] if self.sector.brick_count else []), self._bind_probes()]
        launches = self._launches[variant]
        if variant[1] and self.sector.brick_count:
            launches[0].kernel.set_arg(launches[0].kernel.num_args - 1, np.float32(given.snow))
        return launches

    def _select_planes(self, given: RelightInput) -> None:
        planes = given.lights["plane"].tobytes()
        surfels = self.sector.surfel_count
        if planes == self._planes or surfels == 0:
            return
        if self.sun_visibility is None:
            self.sun_visibility = self.device.upload(self.sector.sun_visibility)
            self.plane_bits = self.device.allocate(surfels)
        kernel = self.device.kernel("select_planes", DIRECTIONAL_LIGHTS=len(given.lights))
        words = np.uint32(self.sector.sun_visibility.shape[1])
        kernel.set_args(np.uint32(surfels), self.sun_visibility, words, self.lights, self.plane_bits)
        cl.enqueue_nd_range_kernel(self.device.queue, kernel, (surfels,), None)
        self._planes = planes

    def set_lamps(self, surfel_light: cl.Buffer | None) -> None:
        """Irradiance [lx] that lamps give each surfel: (S, 4) float32 on the device, or None where there are none.

        Read at every pass; its maker may change its contents between passes.
        """
        if surfel_light is not self._lamps:
            self._lamps = surfel_light
            self._launches.clear()

    def fill_volume(self, box: AnyArray, size: tuple[int, ...], target: cl.Buffer) -> None:
        """Enqueue this sector's part of a volume: ``box`` (1,) layout.VOLUME_BOX, its size (x, y, z), the volume's buffer."""
        if self._fill is None:
            sector = self.sector
            self._fill = self.device.kernel("fill_volume", BASIS_SIZE=sector.basis_size, VOXEL_PROBES=sector.voxel_probe.shape[3])
        self._fill.set_args(box, self.voxel_probe, self.voxel_weight, self.cubes, target)
        cl.enqueue_nd_range_kernel(self.device.queue, self._fill, size, None)

    def read_cubes(self) -> Float32:
        """The probes' cubes (P, B, 3) float32 [lx], after all that was enqueued."""
        cubes = np.zeros((self.sector.probe_count, self.sector.basis_size, 4), np.float32)
        self.device.read(self.cubes, cubes)
        return np.ascontiguousarray(cubes[..., :3])

    def write_cubes(self, cubes: Float32) -> None:
        """Set the probes' cubes (P, B, 3) float32 [lx]: where the next pass takes its feedback from."""
        if cubes.size:
            padded = np.zeros((*cubes.shape[:2], 4), np.float32)
            padded[..., :3] = cubes
            cl.enqueue_copy(self.device.queue, self.cubes, padded)

    def _bind_bricks(self, light_count: int, snow: bool) -> "Launch":
        sector = self.sector
        kernel = self.device.kernel(
            "relight_bricks",
            DIRECTIONAL_LIGHTS=light_count,
            FEEDBACK_PROBES=sector.feedback_probe.shape[1],
            HAS_FEEDBACK_WEIGHTS=int(self.feedback_weight is not None),
            HAS_EMISSION=int(self.emission is not None),
            HAS_SNOW=int(snow),
            HAS_LAMPS=int(self._lamps is not None),
        )
        arguments: list[Any] = [np.uint32(sector.brick_count), self.brick_starts, self.surfels, self.feedback_probe]
        if self.feedback_weight is not None:
            arguments.append(self.feedback_weight)
        arguments.append(self.cubes)
        if self.emission is not None:
            arguments.append(self.emission)
        if self._lamps is not None:
            arguments.append(self._lamps)
        if light_count:
            arguments += [self.plane_bits, self.lights]
        arguments.append(self.exitance)
        if snow:
            arguments.append(np.float32(0))  # launches() sets it
        kernel.set_args(*arguments)
        return Launch(kernel, sector.brick_count)

    def _bind_probes(self) -> "Launch":
        sector = self.sector
        kernel = self.device.kernel("gather_probes", BASIS_SIZE=sector.basis_size)
        kernel.set_args(
            np.uint32(sector.probe_count),
            self.factor_starts,
            self.factor_source,
            self.factor_weight,
            self.exitance,
            self.cubes,
        )
        return Launch(kernel, sector.probe_count)


class Relighter:
    """Lights resident sectors on one device."""

    def __init__(self, device: Device) -> None:
        self.device = device

    def relight(self, residents: list[ResidentSector], given: RelightInput, passes: int = 1) -> None:
        """Enqueue passes over sectors; each pass adds one bounce to the cubes that a sector holds. Returns before the device is done."""
        launches = [launch for resident in residents for launch in resident.launches(given)]
        for _ in range(passes):
            for launch in launches:
                cl.enqueue_nd_range_kernel(self.device.queue, launch.kernel, (launch.global_size,), (GROUP,))
        self.device.queue.flush()

    def converge(self, resident: ResidentSector, given: RelightInput, residual: float = QUERY_RESIDUAL) -> Converged:
        """Relight a sector from darkness until what later bounces could still add is below ``residual`` times the peak.

        The remaining distance is estimated from how fast the change shrinks: change * rate / (1 - rate), as for any contraction.
        """
        sector = resident.sector
        after = np.zeros((sector.probe_count, sector.basis_size, 3), np.float32)
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
            rate = min((change / last_change) ** (1 / _PASSES_PER_LOOK), _SLOWEST_RATE) if last_change else _SLOWEST_RATE
            left, last_change = change * rate / (1 - rate) / peak, change
            if left <= residual:
                break
        return Converged(after, first, left, passes)
