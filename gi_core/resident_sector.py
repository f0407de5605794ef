"""One sector's buffers on a device, and the kernels that light them (slides "Relighting", "Multiple bounces").

What changes seldom is worked out when it changes, and a pass only does what every bounce needs:

    light changed   sun_on_surfels, light_bricks: direct exitance of bricks
    snow changed    collect_bounces: what bricks send on of their feedback probes' light
    every pass      bounce_bricks, gather_probes
"""

from typing import Any

import numpy as np
import pyopencl as cl

from gi_core import relight_twin
from gi_core.arrays import AnyArray, Float32, UInt32
from gi_core.basis import FEEDBACK, basis_of_size, conversion
from gi_core.constants import BASIS_SIZES
from gi_core.device import Device, run_1d
from gi_core.layout import BOUNCE
from gi_core.relight_input import RelightInput
from gi_core.sector import Sector, starts

VOXEL_GROUP = (8, 4, 1)  # work-items of fill_volume.cl along x, y, z; see run_1d
SURFELS_PER_GROUP = 8  # of sun_on_surfels.cl: a byte of a plane's bits


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
        self._groups = -(-sector.surfel_count // SURFELS_PER_GROUP)
        normal = np.zeros((3, SURFELS_PER_GROUP * self._groups), np.float32)
        normal[:, : sector.surfel_count] = sector.surfel_normal.T
        self.surfel_normal = device.upload(normal)
        self.brick_starts = device.upload(sector.brick_starts)
        self.brick_basis = None if sector.basis_size == BASIS_SIZES["cube"] else device.upload(relight_twin.brick_basis(sector))
        self.brick_emission = None if sector.surfel_emission is None else device.upload(_brick_emission(sector))
        self.factor_starts = device.upload(sector.factor_starts)
        self.factor_source = device.upload(sector.factor_source)
        self.factor_weight, self.factor_last = _upload_weights(device, sector.factor_weight)
        self.voxel_probe = device.upload(sector.voxel_probe)
        self.voxel_weight = device.upload(sector.voxel_weight)
        self.cubes = device.allocate(sector.probe_count * sector.basis_size * 16)
        self.direct = device.allocate((sector.brick_count + sky_patches) * 16)
        self.exitance = device.allocate((sector.brick_count + sky_patches) * 16)
        # None of these is there before something needs it.
        self.sun_visibility: cl.Buffer | None = None
        self.sun_share: cl.Buffer | None = None
        self.bounces: cl.Buffer | None = None
        self.bounce_starts: cl.Buffer | None = None
        self.sun_sample: cl.Buffer | None = None
        self._lamps: cl.Buffer | None = None
        self._converted: tuple[str, cl.Buffer, cl.Buffer] | None = None
        self._is_cube = sector.basis_size == BASIS_SIZES["cube"]
        self._has_snow = bool(sector.surfel_snow.any())
        self._light: LightOnDevice | None = None
        self._direct_of: object = None
        self._bounces_of: float | None = None
        self._kernels: dict[tuple[object, ...], cl.Kernel] = {}
        self._pass: list[tuple[cl.Kernel, int]] = []

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        own = sum(value.size for value in vars(self).values() if isinstance(value, cl.Buffer))
        return own + (sum(buffer.size for buffer in self._converted[1:]) if self._converted else 0)

    def prepare(self) -> None:
        """Do now what the first light would wait for, should another thread have the time."""
        if self.sector.probe_count and self.sector.brick_count:
            self._collect_bounces(0.0)
            self._bounces_of = 0.0

    def set_lamps(self, surfel_light: cl.Buffer | None) -> None:
        """Irradiance [lx] that lamps give each surfel: (S, 4) float32 on the device, or None where there are none.

        To be called again when the contents have changed.
        """
        if surfel_light is not None or self._lamps is not None:
            self._lamps, self._direct_of = surfel_light, None

    def set_sun_sample(self, sun_sample: cl.Buffer | None) -> None:
        """The surfels' samples of the sun's shadow map: uint8 on the device, padded to whole groups of
        eight, or None without a map.

        To be called again when the contents have changed.
        """
        if sun_sample is not None or self.sun_sample is not None:
            self.sun_sample, self._direct_of = sun_sample, None

    def light(self, light: LightOnDevice) -> None:
        """Enqueue what the passes need to know of the light; nothing when it is as it was."""
        if self.sector.probe_count == 0:
            return
        if light is not self._light:
            behind = self.sector.brick_count * 16
            for sources in (self.exitance, self.direct):
                cl.enqueue_copy(self.device.queue, sources, light.patches, byte_count=light.patches.size, dst_offset=behind)
            self._light = light
        if self.sector.brick_count == 0:
            return
        snow = light.given.snow if self._has_snow else 0.0
        if self._bounces_of != snow:
            self._collect_bounces(snow)
            self._bounces_of = snow
        if self._direct_of != light.identity:
            if light.lights is not None:
                self._light_surfels(light)
            self._light_bricks(light, snow)
            self._direct_of = light.identity

    def enqueue_pass(self) -> None:
        """Enqueue one pass: one more bounce on the cubes that the sector holds."""
        if not self._pass:
            self._pass = self._bind_pass()
        for kernel, items in self._pass:
            run_1d(self.device, kernel, items)

    def gather_first_bounce(self, cubes: cl.Buffer) -> None:
        """Enqueue what one pass from darkness gives, into other cubes than the sector's own: sky and the first surface alone."""
        if self.sector.probe_count:
            run_1d(self.device, self._gather("first", self.direct, cubes), self.sector.probe_count)

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
            kernel = self._kernel("convert_probes", FROM_SIZE=own, TO_SIZE=size)
            kernel.set_args(np.uint32(rows), source, matrix, target)
            run_1d(self.device, kernel, rows)
        return target

    def fill_volume(
        self, box: AnyArray, size: tuple[int, ...], target: cl.Buffer, cubes: cl.Buffer | None = None, basis: str | None = None
    ) -> None:
        """Enqueue this sector's part of a volume: ``box`` (1,) layout.VOLUME_BOX, its size (x, y, z), the volume's buffer.

        ``cubes`` are shown in place of the sector's own; they, and the volume, are in ``basis`` where it is given.
        """
        sector = self.sector
        coefficients = sector.basis_size if basis is None else BASIS_SIZES[basis]
        kernel = self._kernel("fill_volume", BASIS_SIZE=coefficients, VOXEL_PROBES=sector.voxel_probe.shape[3])
        kernel.set_args(box, self.voxel_probe, self.voxel_weight, self.cubes if cubes is None else cubes, target)
        whole = tuple(-(-count // group) * group for count, group in zip(size, VOXEL_GROUP, strict=True))
        cl.enqueue_nd_range_kernel(self.device.queue, kernel, whole, VOXEL_GROUP)

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

    def _kernel(self, name: str, **defines: int) -> cl.Kernel:
        # Making a kernel takes longer than running it.
        key = (name, *defines.values())
        if key not in self._kernels:
            self._kernels[key] = self.device.kernel(name, **defines)
        return self._kernels[key]

    def _light_surfels(self, light: LightOnDevice) -> None:
        count = len(light.given.lights)
        if self.sun_visibility is None:
            self.sun_visibility = self.device.upload(self.sector.sun_visibility)
        if self.sun_share is None or self.sun_share.size < count * self._groups * SURFELS_PER_GROUP * 4:
            self.sun_share = self.device.allocate(count * self._groups * SURFELS_PER_GROUP * 4)
        kernel = self._kernel("sun_on_surfels", DIRECTIONAL_LIGHTS=count, HAS_SUN_MAP=int(self.sun_sample is not None))
        arguments: list[Any] = [np.uint32(self._groups), self.surfel_normal, self.sun_visibility]
        arguments += [np.uint32(4 * self.sector.sun_visibility.shape[1]), light.lights]
        if self.sun_sample is not None:
            arguments.append(self.sun_sample)
        kernel.set_args(*arguments, self.sun_share)
        run_1d(self.device, kernel, self._groups)

    def _light_bricks(self, light: LightOnDevice, snow: float) -> None:
        count = len(light.given.lights)
        kernel = self._kernel(
            "light_bricks",
            DIRECTIONAL_LIGHTS=count,
            HAS_EMISSION=int(self.brick_emission is not None),
            HAS_SNOW=int(snow > 0),
            HAS_LAMPS=int(self._lamps is not None),
        )
        arguments: list[Any] = [np.uint32(self.sector.brick_count), self.brick_starts, self.surfel_albedo]
        arguments += [buffer for buffer in (self.brick_emission, self._lamps) if buffer is not None]
        if count:
            arguments += [self.sun_share, np.uint32(self._groups * SURFELS_PER_GROUP), light.lights]
        arguments.append(self.direct)
        if snow > 0:
            arguments.append(np.float32(snow))
        kernel.set_args(*arguments)
        run_1d(self.device, kernel, self.sector.brick_count)

    def _collect_bounces(self, snow: float) -> None:
        """Bounces of the sector under this much snow. Which there are does not depend on the snow: the first time counts them."""
        sector, device = self.sector, self.device
        weighted = sector.feedback_probe.shape[1] > 1 or not (sector.feedback_weight == 1).all()
        kernel = self._kernel(
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
            normals = [self.surfel_normal, np.uint32(self._groups * SURFELS_PER_GROUP)] if self._is_cube else []
            kernel.set_args(
                np.uint32(sector.brick_count),
                self.brick_starts,
                self.surfel_albedo,
                *normals,
                probe,
                *weight,
                bounce_starts,
                bounces,
                count,
                *last,
            )
            run_1d(self.device, kernel, sector.brick_count)

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

    def _bind_pass(self) -> list[tuple[cl.Kernel, int]]:
        sector = self.sector
        bound: list[tuple[cl.Kernel, int]] = []
        if sector.probe_count and sector.brick_count:
            kernel = self._kernel("bounce_bricks", BASIS_SIZE=sector.basis_size)
            basis = [] if self.brick_basis is None else [self.brick_basis]
            arguments = (self.bounce_starts, self.bounces, self.direct, self.cubes, *basis, self.exitance)
            kernel.set_args(np.uint32(sector.brick_count), *arguments)
            bound.append((kernel, sector.brick_count))
        if sector.probe_count:
            bound.append((self._gather("pass", self.exitance, self.cubes), sector.probe_count))
        return bound

    def _gather(self, use: str, sources: cl.Buffer, cubes: cl.Buffer) -> cl.Kernel:
        """gather_probes.cl from other sources into other cubes: a kernel for each use, since arguments stay bound."""
        sector = self.sector
        key = ("gather_probes", use)
        if key not in self._kernels:
            self._kernels[key] = self.device.kernel("gather_probes", BASIS_SIZE=sector.basis_size)
        kernel = self._kernels[key]
        weights = [buffer for buffer in (self.factor_weight, self.factor_last) if buffer is not None]
        kernel.set_args(np.uint32(sector.probe_count), self.factor_starts, self.factor_source, *weights, sources, cubes)
        return kernel


def _brick_emission(sector: Sector) -> Float32:
    """(N, 4) float32 [lx]: pi times the mean emission of each brick's surfels."""
    assert sector.surfel_emission is not None
    means = relight_twin.brick_means(sector, sector.surfel_emission)
    return np.pad(np.float32(np.pi) * means, ((0, 0), (0, 1)))


def _upload_weights(device: Device, weights: Float32) -> tuple[cl.Buffer, cl.Buffer | None]:
    """Factor weights (F, B) as gather_probes.cl takes them: whole vectors of 4 or 8 numbers, and the ninth apart where there is one."""
    size = weights.shape[1]
    vectors = np.pad(weights, ((0, 0), (0, 8 - size))) if 4 < size < 8 else weights[:, :8]
    return device.upload(vectors), device.upload(weights[:, 8]) if size > 8 else None
