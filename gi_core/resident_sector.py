"""One sector's buffers on a device, and the kernels that light them (slides "Relighting", "Multiple bounces").

What changes seldom is worked out when it changes, and a pass only does what every bounce needs:

    snow changed    collect_bounces: what bricks send on of their feedback probes' light
    lamps changed   lamps_on_bricks: what bricks send out of lamps' light, and their own emission
    sun changed     sun_on_surfels, light_bricks: direct exitance of bricks
    every pass      bounce_bricks, gather_probes

On a processor the last two lines are one kernel, relight_sector.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl

from gi_core import factor_weights, relight_twin
from gi_core.arrays import AnyArray, Float32, UInt32
from gi_core.basis import FEEDBACK, SH_NORM, basis_of_size, conversion
from gi_core.constants import BASIS_SIZES
from gi_core.device import Device
from gi_core.layout import BOUNCE, MAX_DIRECTIONAL_LIGHTS
from gi_core.relight_input import RelightInput
from gi_core.relight_launch import SURFELS_PER_GROUP, RelightTask, launch_relight
from gi_core.rooms import outdoor_blend
from gi_core.sector import Sector, starts

VOXEL_GROUP = (8, 4, 1)  # work-items of fill_volume.cl along x, y, z; see SharedKernel
# gather_probes.cl reads whole vectors, beyond the last factor's codes and the last probe's scales.
VECTOR = 8
# Buffers that a resident sector reads and others hold: SunSamples and SurfelLights count them.
_LENT = ("sun_sample", "_lamps")


class LightOnDevice:
    """What all sectors share of one moment's light, uploaded once: sky patches, sun and moon."""

    def __init__(self, device: Device, given: RelightInput) -> None:
        self.given = given
        patches = np.zeros((len(given.patch_exitance), 4), np.float32)
        patches[:, :3] = given.patch_exitance
        self.patches = device.upload(patches)
        self.lights = device.upload(given.lights) if len(given.lights) else None
        self.identity = (given.lights.tobytes(), given.snow)
        """What direct light and bounces depend on; sky patches are neither's."""


class ResidentSector:
    """One sector's buffers on a device. Only what the sector has and what the light asks for: no emission, no buffer."""

    def __init__(self, device: Device, sector: Sector, sky_patches: int) -> None:
        self.sector = sector
        self.device = device
        self.surfel_albedo = device.upload(np.concatenate([sector.surfel_albedo, sector.surfel_snow[:, None]], axis=1))
        self.groups = -(-sector.surfel_count // SURFELS_PER_GROUP)
        self.plane_bytes = 4 * sector.sun_visibility.shape[1]
        self.sky_patches = sky_patches
        normal = np.zeros((3, SURFELS_PER_GROUP * self.groups), np.float32)
        normal[:, : sector.surfel_count] = sector.surfel_normal.T
        self.surfel_normal = device.upload(normal)
        self.brick_starts = device.upload(sector.brick_starts)
        self.brick_basis = None if sector.basis_size == BASIS_SIZES["cube"] else self._find_brick_basis()
        self.brick_emission = None if sector.surfel_emission is None else device.upload(_brick_emission(sector))
        self.factor_starts = device.upload(sector.factor_starts)
        self.factor_source = device.upload(sector.factor_source)
        self.sky_starts = device.upload(sector.sky_starts)
        self.factor_code = _factor_code(device, sector)
        self.factor_scale = device.upload(padded(factor_weights.device_scale(sector.factor_codes)))
        self.voxel_probe, self.voxel_weight = (device.upload(values) for values in outdoor_blend(sector))
        self.cubes = device.allocate(sector.probe_count * sector.basis_size * 16)
        self.direct = device.allocate(sector.brick_count * 16)
        self.exitance = device.allocate((sector.brick_count + sky_patches) * 16)
        # None of these is there before something needs it.
        self.sun_visibility: cl.Buffer | None = None
        self.sun_share: cl.Buffer | None = None
        self.bounces: cl.Buffer | None = None
        self.bounce_starts: cl.Buffer | None = None
        self.sun_sample: cl.Buffer | None = None
        self.lamps_on_bricks: cl.Buffer | None = None
        self._lamps: cl.Buffer | None = None
        self._converted: tuple[str, cl.Buffer, cl.Buffer] | None = None
        self._is_cube = sector.basis_size == BASIS_SIZES["cube"]
        self._has_snow = bool(sector.surfel_snow.any())
        self._light: LightOnDevice | None = None
        self._direct_of: object = None
        self._lamps_of: float | None = None
        self._bounces_of: float | None = None
        self._no_bounces: cl.Buffer | None = None
        self._held: Float32 | None = None
        """The very array that was written last, where it never changes and nothing was relit since."""
        self._is_lit_anew = True

    @property
    def nbytes(self) -> int:
        """Bytes on the device, without what is lent to it: lamps' light and samples of the sun."""
        own = sum(value.size for name, value in vars(self).items() if isinstance(value, cl.Buffer) and name not in _LENT)
        return own + (sum(buffer.size for buffer in self._converted[1:]) if self._converted else 0)

    @property
    def host_nbytes(self) -> int:
        """Bytes of the sector's arrays that are kept in the host's memory beside the device's."""
        arrays = [value for value in vars(self.sector).values() if isinstance(value, np.ndarray)]
        return sum(array.nbytes for array in arrays if any(array.strides))  # without strides it is one zero, whatever its shape

    def unused_nbytes(self, lamps: bool) -> int:
        """Bytes on the device that light may yet ask for: each directional light's share, lamps by brick if there are ``lamps``, and probes
        in the cube that is served."""
        share = 4 * MAX_DIRECTIONAL_LIGHTS * self.groups * SURFELS_PER_GROUP - (0 if self.sun_share is None else int(self.sun_share.size))
        cube = 0 if self._is_cube or self._converted else 16 * BASIS_SIZES["cube"] * self.sector.probe_count
        by_brick = 16 * self.sector.brick_count if lamps and self.lamps_on_bricks is None else 0
        return max(share, 0) + by_brick + cube

    def prepare(self) -> None:
        """Do now what the first light would wait for, should another thread have the time."""
        if self.sector.probe_count and self.sector.brick_count:
            self._collect_bounces(0.0)
            self._bounces_of = 0.0

    def release_host_arrays(self) -> None:
        """Let go of the host's copies of what is only read on the device, two thirds of them: their places are taken by zeros that have the
        same shape and no memory."""
        if self.sun_visibility is None:
            self.sun_visibility = self.device.upload(self.sector.sun_visibility)
        gone = ("factor_code", "factor_source", "surfel_albedo", "surfel_snow", "sun_visibility", "voxel_probe", "voxel_weight")
        arrays: dict[str, AnyArray] = {name: getattr(self.sector, name) for name in gone}
        empty: dict[str, Any] = {name: np.broadcast_to(a.dtype.type(0), a.shape) for name, a in arrays.items()}
        self.sector = replace(self.sector, **empty)

    def set_lamps(self, surfel_light: cl.Buffer | None) -> None:
        """Irradiance [lx] that lamps give each surfel: (S, 4) float32 on the device, or None where there are none.

        To be called again when the contents have changed.
        """
        if surfel_light is not None or self._lamps is not None:
            self._lamps, self._lamps_of, self._direct_of = surfel_light, None, None
            if surfel_light is None:
                self.lamps_on_bricks = None

    def set_sun_sample(self, sun_sample: cl.Buffer | None) -> None:
        """The surfels' samples of the sun's shadow map: uint8 on the device, padded to whole groups of
        eight, or None without a map.

        To be called again when the contents have changed.
        """
        if sun_sample is not None or self.sun_sample is not None:
            self.sun_sample, self._direct_of = sun_sample, None

    def light(self, light: LightOnDevice) -> None:
        """Get ready for passes under this light; nothing to do when it is as it was. ``enqueue`` follows.

        What seldom changes is enqueued here, in the device's own queue.
        """
        if self.sector.probe_count == 0:
            return
        if light is not self._light and len(light.given.patch_exitance) != self.sky_patches:
            raise ValueError(f"expected the exitance of {self.sky_patches} sky patches, got {len(light.given.patch_exitance)}")
        self._light = light
        if self.sector.brick_count == 0:
            return
        snow = light.given.snow if self._has_snow else 0.0
        if self._bounces_of != snow:
            self._collect_bounces(snow)
            self._bounces_of = snow
        if self._lamps is not None and self._lamps_of != snow:
            self._light_by_lamps(snow)
            self._lamps_of = snow
        if self._direct_of != light.identity:
            if light.lights is not None:
                self._make_room_for_sun(len(light.given.lights))
            self._direct_of, self._is_lit_anew = light.identity, True

    def enqueue(self, queue: cl.CommandQueue, passes: int) -> None:
        """Enqueue passes, each one more bounce on the cubes that the sector holds. ``light`` comes first."""
        self._held = None
        if self.sector.probe_count:
            self._run(queue, passes, self.bounce_starts, self.cubes)

    def enqueue_first_bounce(self, cubes: cl.Buffer) -> None:
        """Enqueue what one pass from darkness gives, into other cubes than the sector's own: sky and the first surface alone."""
        if self.sector.probe_count:
            self._no_bounces = self._no_bounces or self.device.allocate(4 * (self.sector.brick_count + 1))
            self._run(self.device.queue, 1, self._no_bounces, cubes)

    def converted(self, basis: str, cubes: cl.Buffer | None = None) -> cl.Buffer:
        """The sector's light, or other ``cubes`` of its probes, in a basis that is served: a buffer that the next call writes again.

        Raises InputError for a basis that is richer than the sector's.
        """
        source = self.cubes if cubes is None else cubes
        own, size = self.sector.basis_size, BASIS_SIZES[basis]
        if own == size:
            return source
        rows = self.sector.probe_count * size
        if self._converted is None or self._converted[0] != basis:
            matrix = self.device.upload(conversion(basis_of_size(own), basis))
            self._converted = basis, matrix, self.device.allocate(16 * rows)
        _, matrix, target = self._converted
        if rows:
            self.device.shared_kernel("convert_probes", FROM_SIZE=own, TO_SIZE=size).launch_1d(
                rows, np.uint32(rows), source, matrix, target
            )
        return target

    def fill_volume(
        self, box: AnyArray, size: tuple[int, ...], target: cl.Buffer, cubes: cl.Buffer | None = None, basis: str | None = None
    ) -> None:
        """Enqueue this sector's part of a volume: ``box`` (1,) layout.VOLUME_BOX, its size (x, y, z), the volume's buffer.

        ``cubes`` are shown in place of the sector's own; they, and the volume, are in ``basis`` where it is given.
        """
        sector = self.sector
        coefficients = sector.basis_size if basis is None else BASIS_SIZES[basis]
        kernel = self.device.shared_kernel("fill_volume", BASIS_SIZE=coefficients, VOXEL_PROBES=sector.voxel_probe.shape[3])
        whole = tuple(-(-count // group) * group for count, group in zip(size, VOXEL_GROUP, strict=True))
        kernel.launch(whole, VOXEL_GROUP, box, self.voxel_probe, self.voxel_weight, self.cubes if cubes is None else cubes, target)

    def read_cubes(self) -> Float32:
        """The probes' cubes (P, B, 3) float32 [lx], after all that was enqueued."""
        return self.begin_reading(self.device.queue)()

    def begin_reading(self, queue: cl.CommandQueue) -> Callable[[], Float32]:
        """Enqueue a copy of the cubes behind what else is in a queue; what this returns waits for it and gives them."""
        cubes = np.empty((self.sector.probe_count, self.sector.basis_size, 4), np.float32)
        copied = cl.enqueue_copy(queue, cubes, self.cubes, is_blocking=False) if cubes.size else None

        def finish() -> Float32:
            if copied is not None:
                copied.wait()
            return np.ascontiguousarray(cubes[..., :3])

        return finish

    def write_cubes(self, cubes: Float32) -> None:
        """Set the probes' cubes (P, B, 3) float32 [lx]: where the next pass takes its feedback from. Read-only ones, which are taken never
        to change, cost nothing while the sector holds them."""
        if cubes.size and cubes is not self._held:
            padded = np.zeros((*cubes.shape[:2], 4), np.float32)
            padded[..., :3] = cubes
            cl.enqueue_copy(self.device.queue, self.cubes, padded)
            self._held = None if cubes.flags.writeable else cubes

    def _find_brick_basis(self) -> cl.Buffer:
        """(N, B) float32, worked out on the device."""
        bricks, size = self.sector.brick_count, self.sector.basis_size
        found = cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, max(4 * bricks * size, 16))
        if bricks:
            norm = self.device.upload(SH_NORM[:size].astype(np.float32))
            normals = (self.surfel_normal, np.uint32(self.groups * SURFELS_PER_GROUP))
            directional = np.float32(FEEDBACK[basis_of_size(size)].directional)
            kernel = self.device.shared_kernel("brick_basis", BASIS_SIZE=size)
            kernel.launch_1d(bricks, np.uint32(bricks), self.brick_starts, *normals, norm, directional, found)
        return found

    def _run(self, queue: cl.CommandQueue, passes: int, bounce_starts: cl.Buffer | None, cubes: cl.Buffer) -> None:
        assert self._light is not None
        snow = self._light.given.snow if self._has_snow else 0.0
        glow = self.brick_emission if self.lamps_on_bricks is None else self.lamps_on_bricks
        launch_relight(self, RelightTask(passes, self._is_lit_anew, self._light, snow, glow, bounce_starts, cubes), queue)
        self._is_lit_anew = False

    def _make_room_for_sun(self, lights: int) -> None:
        if self.sun_visibility is None:
            self.sun_visibility = self.device.upload(self.sector.sun_visibility)
        nbytes = lights * self.groups * SURFELS_PER_GROUP * 4
        if self.sun_share is None or self.sun_share.size < nbytes:
            self.sun_share = self.device.allocate(nbytes)

    def _light_by_lamps(self, snow: float) -> None:
        bricks = self.sector.brick_count
        self.lamps_on_bricks = self.lamps_on_bricks or self.device.allocate(bricks * 16)
        kernel = self.device.shared_kernel("lamps_on_bricks", HAS_EMISSION=int(self.brick_emission is not None), HAS_SNOW=int(snow > 0))
        surfels = (self.brick_starts, self.surfel_albedo, self._lamps)
        kernel.launch_1d(bricks, np.uint32(bricks), *surfels, self.brick_emission, np.float32(snow), self.lamps_on_bricks)

    def _collect_bounces(self, snow: float) -> None:
        """Bounces of the sector under this much snow. Which there are does not depend on the snow: the first time counts them."""
        sector, device = self.sector, self.device
        weighted = sector.feedback_probe.shape[1] > 1 or not (sector.feedback_weight == 1).all()
        kernel = self.device.shared_kernel(
            "collect_bounces",
            BASIS_SIZE=sector.basis_size,
            FEEDBACK_PROBES=sector.feedback_probe.shape[1],
            HAS_FEEDBACK_WEIGHTS=int(weighted),
            HAS_SNOW=int(snow > 0),
            BOUNCE_ALBEDO_PERMILLE=round(1000 * FEEDBACK[basis_of_size(sector.basis_size)].albedo_max),
        )
        probe = device.upload(sector.feedback_probe)
        weight = [device.upload(sector.feedback_weight)] if weighted else []
        count = device.allocate(4 * sector.brick_count)

        def collect(bounce_starts: cl.Buffer, bounces: cl.Buffer) -> None:
            last = [np.float32(snow)] if snow > 0 else []
            surfels = [self.surfel_normal, np.uint32(self.groups * SURFELS_PER_GROUP)] if self._is_cube else []
            bricks = np.uint32(sector.brick_count)
            read = (self.brick_starts, self.surfel_albedo, *surfels, probe, *weight)
            kernel.launch_1d(sector.brick_count, bricks, *read, bounce_starts, bounces, count, *last)

        if self.bounce_starts is None:
            # A surfel reads one face of the cube for each axis.
            most = (3 if self._is_cube else 1) * sector.feedback_probe.shape[1]
            # Not zeroed: most of it is never touched, and so never takes memory.
            scratch = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, most * sector.surfel_count * BOUNCE.dtype.itemsize)
            collect(device.upload(most * sector.brick_starts), scratch)
            counted: UInt32 = np.zeros(sector.brick_count, np.uint32)
            device.read(count, counted)
            self.bounce_starts = device.upload(starts(counted))
            self.bounces = device.allocate(int(counted.sum()) * BOUNCE.dtype.itemsize)
        assert self.bounces is not None
        collect(self.bounce_starts, self.bounces)


def _brick_emission(sector: Sector) -> Float32:
    """(N, 4) float32 [lx]: pi times the mean emission of each brick's surfels."""
    assert sector.surfel_emission is not None
    means = relight_twin.brick_means(sector, sector.surfel_emission)
    return np.pad(np.float32(np.pi) * means, ((0, 0), (0, 1)))


def _factor_code(device: Device, sector: Sector) -> cl.Buffer:
    """(F, B) codes as gather_probes.cl reads them, and behind them VECTOR zeros. Of harmonics they are worked out on the device: there
    are twice as many as files have, and NumPy took half of the time that a sector took to get there."""
    basis, factors = sector.basis_size, sector.factor_count
    if basis == BASIS_SIZES["cube"]:
        return device.upload(padded(sector.factor_code))
    found = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, factors * basis + VECTOR)
    cl.enqueue_fill_buffer(device.queue, found, np.uint8(0), factors * basis, VECTOR)
    if factors:
        kernel = device.shared_kernel("expand_factors", BASIS_SIZE=basis, FACE_STEPS=factor_weights.FACE_STEPS)
        roots = device.upload_once(factor_weights.device_roots)
        kernel.launch_1d(factors, np.uint32(factors), device.upload(sector.factor_code.T), roots, found)
    return found


def padded(values: AnyArray) -> AnyArray:
    """The values in one row, and behind them zeros for the last vector to reach into."""
    return np.concatenate([values.reshape(-1), np.zeros(VECTOR, values.dtype)])
