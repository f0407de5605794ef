"""Answers queries about a dataset's light: deterministic, in buffers of its own, whatever else runs."""

import threading
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from gi_core.arrays import Float32, Float64, UInt8, UInt16
from gi_core.basis import convert, served_from
from gi_core.constants import BASIS_SIZES, FINE_VOXEL_SIZE_M, SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_NO_SECTOR
from gi_core.dataset import Dataset
from gi_core.device import shared_device
from gi_core.errors import FormatError, InputError, OutsideWorldError
from gi_core.fine_volume import ResidentFineVoxels, interpolated
from gi_core.grid import SectorIndex, volume_first_voxel
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_surfels import SurfelLights
from gi_core.lighting import Lighting
from gi_core.lighting_model import make_lighting
from gi_core.lights import lamps_digest, lamps_on
from gi_core.relight import Relighter
from gi_core.relight_input import relight_input
from gi_core.resident_sector import ResidentSector
from gi_core.sector import PROBE_IN_MARGIN
from gi_core.settings import NEUTRAL, Settings
from gi_core.sky_patches import face_exitance
from gi_core.user_sky import UserSky, lighting_with_sky
from gi_core.volume import SectorBox, Volume, box_mask, box_record, box_slices, nearest_columns, plan_boxes
from gi_core.world import Lamp

# Device memory that queries may keep sectors in.
RESIDENT_BYTES = 1 << 29
# Lit sectors that are remembered, some 20 kB each.
LIT_SECTORS = 1024
# A volume may be asked for this far above or below what the city itself reaches.
HEIGHT_MARGIN_M = 200.0


@dataclass(frozen=True, eq=False)
class Distant:
    """One texel per sector.

    values : (rows, cols, 6, 3) float32 [lx], rows towards +Z, columns towards +X
    origin : sector of texel (0, 0)
    valid : (rows, cols) uint8, 1 where the dataset has a sector
    """

    values: Float32
    origin: SectorIndex
    valid: UInt8


@dataclass(frozen=True, eq=False)
class LitProbes:
    """Probes near a point. position (n, 3) [m], world frame; cubes (n, 6, 3) [lx]; room, flags (n,); sectors (n,)."""

    position: Float64
    cubes: Float32
    room: UInt16
    flags: UInt8
    sectors: tuple[SectorIndex, ...]


@dataclass(frozen=True, eq=False)
class _Light:
    """One query's light. digest : of all in lighting and lamps that changes light."""

    lighting: Lighting
    lamps: tuple[Lamp, ...]
    settings: Settings
    digest: str


class Engine:
    """Lights sectors of one dataset on one device. Safe to call from several threads; the device is used by one at a time."""

    def __init__(self, dataset: Dataset, device: str | None = None, sky: UserSky | None = None) -> None:
        """``device`` is part of an OpenCL device's description; ``sky`` takes the place of the model's. Raises DeviceError."""
        self.dataset = dataset
        self.sky = sky
        self.failed_sectors: dict[SectorIndex, str] = {}
        self.lamps: tuple[Lamp, ...] = dataset.world.lamps
        """Lamps of the world, each on by its schedule. Assign another tuple to move, add or remove some: nothing is baked again."""
        self._device = shared_device(device)
        self._relighter = Relighter(self._device)
        self._lock = threading.RLock()
        self._residents: OrderedDict[SectorIndex, ResidentSector] = OrderedDict()
        self._shadows = ShadowGeometry(dataset.geometry, dataset.world.sectors)
        self._lights: dict[SectorIndex, SurfelLights] = {}
        self._fine: dict[SectorIndex, ResidentFineVoxels] = {}
        self._lit: OrderedDict[tuple[str, Settings, SectorIndex], Float32] = OrderedDict()

    @property
    def device_name(self) -> str:
        """The device's platform, name and version."""
        return self._device.name

    def lighting(self, time: str, weather: str) -> Lighting:
        """Sun, moon and sky at the dataset's place. Raises UnknownTimeError, UnknownWeatherError."""
        lighting = make_lighting(self.dataset.world.location, time, weather)
        return lighting if self.sky is None else lighting_with_sky(lighting, self.sky)

    def lit_sector(self, index: SectorIndex, lighting: Lighting, settings: Settings = NEUTRAL) -> Float32:
        """The light of a sector's probes (P, B, 3) float32 [lx], in the dataset's basis, bounces converged to relight.QUERY_RESIDUAL.

        Raises SectorMissingError, CorruptFileError.
        """
        return self._lit_sector(index, self._light(lighting, settings))

    def _light(self, lighting: Lighting, settings: Settings) -> _Light:
        """What a query is lit by, worked out once for all its sectors."""
        lamps = lamps_on(self.lamps, lighting)
        return _Light(lighting, lamps, settings, lighting.digest + lamps_digest(lamps))

    def _lit_sector(self, index: SectorIndex, light: _Light) -> Float32:
        key = (light.digest, light.settings, index)
        with self._lock:
            if key in self._lit:
                self._lit.move_to_end(key)
                return self._lit[key]
            resident, settings = self._resident(index), light.settings
            world = self.dataset.world
            given = relight_input(settings.light(light.lighting), world.sun_table, world.sky, world.sky_patches)
            self._set_lamps(resident, settings.brightened(light.lamps))
            found = self._relighter.converge(resident, given)
            cubes = settings.cubes(found.first_bounce, found.cubes, resident.sector.probe_room)
            # Every later query gets this very array.
            cubes.setflags(write=False)
            self._lit[key] = cubes
            while len(self._lit) > LIT_SECTORS:
                self._lit.popitem(last=False)
            return cubes

    def volume(self, position: Float64, lighting: Lighting, settings: Settings = NEUTRAL, basis: str | None = None) -> Volume:
        """The volume centred on a world position (3,) [m], under the artists' settings, in the dataset's basis or one that is poorer.

        Raises InputError for a basis that the dataset cannot be served in, OutsideWorldError, CorruptFileError.
        """
        own = self.dataset.world.basis
        basis = own if basis is None else basis
        if basis not in served_from(own):
            raise InputError(f"basis: this dataset was baked in {own}; expected {' or '.join(served_from(own))}, found {basis}")
        self._expect_inside(position)
        first = volume_first_voxel(position)
        boxes = [box for box in plan_boxes(first) if box.index in self.dataset.world.sectors]
        if not boxes:
            raise OutsideWorldError(self._outside(position))
        values = np.zeros((BASIS_SIZES[basis], *VOLUME_SHAPE, 3), np.float32)
        mask = np.full(VOLUME_SHAPE, VOXEL_NO_SECTOR, np.uint8)
        light = self._light(lighting, settings)
        with self._lock:
            target = self._device.allocate(values.nbytes)
            unlit = [box for box in boxes if not self._fill(box, light, target, mask, basis)]
            self._device.read(target, values)
        has_light = mask[0] != VOXEL_NO_SECTOR
        for box in unlit:  # it has air, but no probe: lit like columns without a sector, by the nearest that are
            has_light[box_slices(box)[1:]] = False
        if has_light.any() and not has_light.all():
            lack, nearest = nearest_columns(has_light)
            values[:, :, lack[:, 0], lack[:, 1]] = values[:, :, nearest[:, 0], nearest[:, 1]]
        report = self.dataset.world.error_report
        expected = None if report is None else report.get("expected_error")
        return Volume(values, mask, first, tuple(box.index for box in boxes), basis, expected)

    def fine_volume(self, position: Float64, lighting: Lighting, settings: Settings = NEUTRAL, basis: str | None = None) -> Volume:
        """As ``volume``, of cascade -1: half as wide at the same number of voxels. Where a sector has no fine voxels, or a place none that
        is near a surface, the coarse ones are interpolated. Raises InputError where the dataset has no fine voxels at all."""
        if not self.dataset.world.has_fine_voxels:
            raise InputError("cascade: this dataset has no fine voxels; expected 0 or more, or a bake with --quality reference")
        coarse = self.volume(position, lighting, settings, basis)
        first = volume_first_voxel(position, -1)
        values, mask = interpolated(coarse, first)
        sectors = self.dataset.world.sectors
        boxes = [box for box in plan_boxes(first, FINE_VOXEL_SIZE_M) if box.index in sectors and sectors[box.index].fine_bytes is not None]
        light = self._light(lighting, settings)
        for box in boxes:
            filled = np.zeros_like(values)
            with self._lock:
                cubes = self._lit_sector(box.index, light)
                resident = self._resident(box.index)
                if not resident.sector.probe_count:
                    continue
                resident.write_cubes(cubes)
                fine = self._fine_voxels(resident)
                target = self._device.allocate(values.nbytes)
                fine.fill(box, target, resident.converted(coarse.basis), coarse.basis)
                self._device.read(target, filled)
            fine.merge(box, filled, values, mask)
        return Volume(values, mask, first, tuple(box.index for box in boxes), coarse.basis, coarse.expected_error, cascade=-1)

    def distant(self, lighting: Lighting) -> Distant:
        """One texel per sector of the whole world, lit by the sky alone (slide "Distant shading"). Raises CorruptFileError."""
        texels = self.dataset.distant()
        values = texels.sky[..., None] * face_exitance(lighting)
        return Distant(values.astype(np.float32), texels.origin, texels.valid)

    def probes(self, position: Float64, radius: float, lighting: Lighting) -> LitProbes:
        """Probes within ``radius`` [m] of a world position (3,) [m], each from the sector that it lies in: row by row, as stored.

        A sector's copies of its neighbours' probes, which it keeps so that no seam shows, are left out.

        Raises OutsideWorldError, CorruptFileError.
        """
        self._expect_inside(position)
        low, high = (np.floor((np.asarray(position)[[0, 2]] + sign * radius) / SECTOR_SIZE_M) for sign in (-1, 1))
        touched = [i for i in self.dataset.world.sectors if low[0] <= i.x <= high[0] and low[1] <= i.z <= high[1]]
        found = []
        light = self._light(lighting, NEUTRAL)
        for index in sorted(touched, key=lambda i: (i.z, i.x)):
            with self._lock:
                cubes = self._lit_sector(index, light)
                sector = self._resident(index).sector
            world = sector.probe_position + index.origin
            own = sector.probe_flags & PROBE_IN_MARGIN == 0
            near = np.flatnonzero(own & (np.linalg.norm(world - position, axis=1) <= radius))
            faces = convert(cubes[near], self.dataset.world.basis, "cube")
            found.append((world[near], faces, sector.probe_room[near], sector.probe_flags[near], [index] * len(near)))
        if not found:
            raise OutsideWorldError(self._outside(position))
        position_, cubes_, room, flags = (np.concatenate([part[i] for part in found]) for i in range(4))
        return LitProbes(position_, cubes_, room, flags, tuple(s for part in found for s in part[4]))

    def _fill(self, box: SectorBox, light: _Light, target: cl.Buffer, mask: UInt8, basis: str) -> bool:
        """Fill a sector's part of a volume and its mask; whether the sector has a probe, and so any light."""
        cubes = self._lit_sector(box.index, light)
        resident = self._resident(box.index)
        sector = resident.sector
        resident.write_cubes(cubes)
        if sector.probe_count:
            size = tuple(int(n) for n in box.size)
            resident.fill_volume(box_record(box, sector), size, target, resident.converted(basis), basis)
        mask[box_slices(box)] = box_mask(box, sector)
        return sector.probe_count > 0

    def _set_lamps(self, resident: ResidentSector, lamps: tuple[Lamp, ...]) -> None:
        index = resident.sector.index
        if index not in self._lights:
            self._lights[index] = SurfelLights(self._device, resident.sector, self._shadows)
        lights = self._lights[index]
        lights.set_static(lamps)
        resident.set_lamps(lights.buffer)

    def _resident(self, index: SectorIndex) -> ResidentSector:
        found = self._residents.get(index)
        if found is None:
            try:
                sector = self.dataset.sector(index)
            except FormatError as error:
                self.failed_sectors[index] = str(error)
                raise
            self.failed_sectors.pop(index, None)
            found = self._residents[index] = ResidentSector(self._device, sector, self.dataset.world.sky_patches)
            while len(self._residents) > 1 and self._resident_bytes() > RESIDENT_BYTES:
                evicted, _ = self._residents.popitem(last=False)
                self._lights.pop(evicted, None)
                self._fine.pop(evicted, None)
        self._residents.move_to_end(index)
        return found

    def _resident_bytes(self) -> int:
        return sum(held.nbytes for kept in (self._residents, self._fine) for held in kept.values())

    def _fine_voxels(self, resident: ResidentSector) -> ResidentFineVoxels:
        index = resident.sector.index
        if index not in self._fine:
            self._fine[index] = ResidentFineVoxels(self._device, self.dataset.fine_voxels(resident.sector))
        return self._fine[index]

    def _expect_inside(self, position: Float64) -> None:
        low, high = self.dataset.world.bounds
        if not np.isfinite(position).all() or not low[1] - HEIGHT_MARGIN_M <= position[1] <= high[1] + HEIGHT_MARGIN_M:
            raise OutsideWorldError(self._outside(position))
        beyond = np.maximum(low - position, position - high)[[0, 2]]
        if (beyond > SECTOR_SIZE_M).any():
            raise OutsideWorldError(self._outside(position))

    def _outside(self, position: Float64) -> str:
        low, high = (", ".join(f"{v:.1f}" for v in corner) for corner in self.dataset.world.bounds)
        here = ", ".join(f"{v:g}" for v in position)
        return f"position ({here}) is outside this world; expected x, y, z [m] within ({low}) and ({high})"
