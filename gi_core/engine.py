"""Answers queries about a dataset's light: deterministic, in buffers of its own, whatever else runs."""

import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from gi_core.arrays import Bool, Float32, Float64, Int64, UInt8, UInt16
from gi_core.basis import convert, served_from
from gi_core.coarse_volume import CoarseSums, KeptCoarse, covered_sectors
from gi_core.constants import (
    BASIS_SIZES,
    FINE_VOXEL_SIZE_M,
    ROOM_OUTDOORS,
    SECTOR_SIZE_M,
    VOLUME_SHAPE,
    VOXEL_INDOORS,
    VOXEL_NO_SECTOR,
    VOXEL_SIZE_M,
    VOXEL_SOLID,
)
from gi_core.dataset import Dataset
from gi_core.device import shared_device
from gi_core.distant_file import DistantLight
from gi_core.error_report import expected_error
from gi_core.errors import FormatError, InputError, OutsideWorldError
from gi_core.fine_volume import interpolated, merge
from gi_core.grid import SectorIndex, volume_first_voxel
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_surfels import SurfelLights
from gi_core.lighting import Lighting
from gi_core.lighting_model import make_lighting
from gi_core.lights import lamps_digest, lamps_on
from gi_core.relight import Relighter
from gi_core.relight_input import relight_input
from gi_core.resident_sector import ResidentSector
from gi_core.rooms import find_room, nearest, rooms_of, rooms_with_light
from gi_core.sector import PROBE_IN_MARGIN
from gi_core.settings import NEUTRAL, Settings
from gi_core.sky_patches import face_exitance
from gi_core.user_sky import UserSky, lighting_with_sky
from gi_core.volume import SectorBox, Volume, box_mask, box_record, box_rooms, box_slices, nearest_columns, plan_boxes
from gi_core.voxel_grid import ResidentGrid, VoxelGrid
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
    light : sky, as in the talk, or full: sun, lamps and all bounces too
    """

    values: Float32
    origin: SectorIndex
    valid: UInt8
    light: DistantLight = "sky"


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


@dataclass(frozen=True, eq=False)
class _Lit:
    """A sector's probes (P, B, 3) float32 [lx] under a light, and how far their bounces are from their fixed point (relight.Converged)."""

    cubes: Float32
    residual: float


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
        self._fine: dict[SectorIndex, ResidentGrid] = {}
        self._coarse = KeptCoarse()
        self._lit: OrderedDict[tuple[str, Settings, SectorIndex], _Lit] = OrderedDict()

    @property
    def device_name(self) -> str:
        """The device's platform, name and version."""
        return self._device.name

    def lighting(self, time: str, weather: str) -> Lighting:
        """Sun, moon and sky at the dataset's place. Raises UnknownTimeError, UnknownWeatherError."""
        lighting = make_lighting(self.dataset.world.location, time, weather)
        return lighting if self.sky is None else lighting_with_sky(lighting, self.sky)

    def lit_sector(self, index: SectorIndex, lighting: Lighting) -> Float32:
        """The light of a sector's probes (P, B, 3) float32 [lx], in the dataset's basis, bounces converged to relight.QUERY_RESIDUAL.

        Raises SectorMissingError, CorruptFileError.
        """
        return self._lit_sector(index, self._light(lighting, NEUTRAL)).cubes

    def _light(self, lighting: Lighting, settings: Settings) -> _Light:
        """What a query is lit by, worked out once for all its sectors."""
        lamps = lamps_on(self.lamps, lighting)
        return _Light(lighting, lamps, settings, lighting.digest + lamps_digest(lamps))

    def _lit_sector(self, index: SectorIndex, light: _Light) -> _Lit:
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
            lit = self._lit[key] = _Lit(cubes, found.residual)
            while len(self._lit) > LIT_SECTORS:
                self._lit.popitem(last=False)
            return lit

    def _residual(self, sectors: Iterable[SectorIndex], light: _Light) -> float:
        """The greatest of some sectors, at least one."""
        return max(self._lit_sector(index, light).residual for index in sectors)

    def volume(
        self, position: Float64, lighting: Lighting, settings: Settings = NEUTRAL, basis: str | None = None, cascade: int = 0
    ) -> Volume:
        """The outdoor volume centred on a world position (3,) [m], under the artists' settings, in the dataset's basis or a poorer one.

        cascade : 0, the talk's volume; n of 1 to 3, 2^n as wide from as many voxels; -1, half as wide, from fine voxels near surfaces

        Raises InputError for a basis that the dataset cannot be served in and for a cascade -1 without fine voxels, OutsideWorldError,
        CorruptFileError.
        """
        light, basis = self._light(lighting, settings), self._served(basis)
        self._expect_inside(position)
        if cascade < 0:
            return self._fine_volume(position, light, basis)
        return self._volume(position, light, basis) if cascade == 0 else self._coarse_volume(position, light, basis, cascade)

    def _volume(self, position: Float64, light: _Light, basis: str) -> Volume:
        first = volume_first_voxel(position)
        boxes, values, mask = self._empty_volume(position, first, basis)
        with self._lock:
            target = self._device.allocate(values.nbytes)
            unlit = [box for box in boxes if not self._fill(box, light, target, mask, basis)]
            self._device.read(target, values)
        has_light = mask[0] != VOXEL_NO_SECTOR
        for box in unlit:  # it has air, but no probe: lit like columns without a sector, by the nearest that are
            has_light[box_slices(box)[1:]] = False
        _fill_columns(values, has_light)
        sectors = tuple(box.index for box in boxes)
        return Volume(values, mask, first, sectors, basis, self._expected_error(basis), residual=self._residual(sectors, light))

    def _empty_volume(self, position: Float64, first: Int64, basis: str) -> tuple[list[SectorBox], Float32, UInt8]:
        """What a volume reads, at least one box, and its light and mask to be filled. Raises OutsideWorldError."""
        boxes = [box for box in plan_boxes(first) if box.index in self.dataset.world.sectors]
        if not boxes:
            raise OutsideWorldError(self._outside(position))
        values = np.zeros((BASIS_SIZES[basis], *VOLUME_SHAPE, 3), np.float32)
        return boxes, values, np.full(VOLUME_SHAPE, VOXEL_NO_SECTOR, np.uint8)

    def _fine_volume(self, position: Float64, light: _Light, basis: str) -> Volume:
        world = self.dataset.world
        if not world.has_fine_voxels:
            raise InputError("cascade -1: this dataset has no fine voxels; expected 0 to 3, or a bake with --quality reference")
        coarse = self._volume(position, light, basis)
        first = volume_first_voxel(position, -1)
        values, mask = interpolated(coarse, first)
        boxes = [box for box in plan_boxes(first, FINE_VOXEL_SIZE_M) if box.index in world.sectors]
        for box in boxes:
            if world.sectors[box.index].fine_bytes is None or not world.sectors[box.index].probes:
                continue
            filled = np.zeros_like(values)
            with self._lock:
                resident = self._lit_resident(box.index, light)
                if box.index not in self._fine:
                    self._fine[box.index] = ResidentGrid(
                        self._device, self.dataset.fine_voxels(resident.sector).outdoors(resident.sector.probe_room)
                    )
                fine = self._fine[box.index]
                target = self._device.allocate(values.nbytes)
                fine.fill(box, target, resident.converted(basis), basis)
                self._device.read(target, filled)
            merge(fine, box, filled, values, mask)
        sectors = tuple(box.index for box in boxes)
        return Volume(values, mask, first, sectors, basis, self._expected_error(basis, -1), cascade=-1, residual=coarse.residual)

    def _coarse_volume(self, position: Float64, light: _Light, basis: str, cascade: int) -> Volume:
        first = volume_first_voxel(position, cascade)
        sectors = [index for index in covered_sectors(first, cascade) if index in self.dataset.world.sectors]
        if not sectors:
            raise OutsideWorldError(self._outside(position))
        parts = {}
        # Sectors on the device first: where not all fit, loading one would drop the next.
        for index in sorted(sectors, key=lambda index: index not in self._residents):
            with self._lock:  # sector by sector: other queries wait for one, not for all
                lit = self._lit_sector(index, light)
                parts[index] = self._coarse.get(index, cascade, lambda index: self._resident(index).sector), lit
        sums = CoarseSums(first, BASIS_SIZES[basis])
        for index in sectors:
            voxels, lit = parts[index]
            sums.add(voxels, convert(lit.cubes, self.dataset.world.basis, basis))
        values, mask, has_light = sums.finish()
        _fill_columns(values, has_light)
        residual = max(lit.residual for _, lit in parts.values())
        return Volume(values, mask, first, tuple(sectors), basis, self._expected_error(basis, cascade), cascade, residual)

    def interior(
        self,
        position: Float64,
        lighting: Lighting,
        settings: Settings = NEUTRAL,
        basis: str | None = None,
        room: str | None = None,
    ) -> Volume:
        """The interior volume centred on a world position (3,) [m]: light of one room, and of no air beside it (gi_core.rooms).

        room : its name or number; None takes the room that the position lies in, or all rooms where it lies in none

        A room that holds no voxel's centre has the light of its nearest probe at each voxel, and no voxel of the mask is its own.

        Raises InputError for a room that there is none of, and where the volume reaches no voxel or no probe of it; else as ``volume``.
        """
        rooms = self.dataset.world.rooms
        wanted = int(rooms_of(np.asarray(position)[None], rooms)[0]) if room is None else find_room(rooms, room)
        light, basis = self._light(lighting, settings), self._served(basis)
        self._expect_inside(position)
        first = volume_first_voxel(position)
        boxes, values, mask = self._empty_volume(position, first, basis)
        lit_rooms = np.full(VOLUME_SHAPE, ROOM_OUTDOORS, np.uint16)
        reached: set[int] = set()
        lit: list[SectorIndex] = []
        with self._lock:
            target = self._device.allocate(values.nbytes)
            for box in boxes:
                sector = self._resident(box.index).sector
                kind, room_here = box_mask(box, sector), box_rooms(box, sector, sector.voxel_room)
                kind[(kind == VOXEL_INDOORS) & ~_in_room(room_here, wanted)] = VOXEL_SOLID
                mask[box_slices(box)] = kind
                if not (kind == VOXEL_INDOORS).any():
                    continue
                reached.update(np.unique(room_here[kind == VOXEL_INDOORS]).tolist())
                lit_rooms[box_slices(box)] = box_rooms(box, sector, rooms_with_light(sector))
                if sector.probe_count:
                    lit.append(box.index)
                    resident = self._lit_resident(box.index, light)
                    grid = VoxelGrid(sector.voxel_first, sector.voxel_class, sector.voxel_probe, sector.voxel_weight)
                    ResidentGrid(self._device, grid).fill(box, target, resident.converted(basis), basis)
            self._device.read(target, values)
        inside = _in_room(lit_rooms, wanted)
        sectors, expected = tuple(box.index for box in boxes), self._expected_error(basis, in_rooms=True)
        if wanted and not reached and (found := self._between_voxels(wanted, sectors, first, light, basis)) is not None:
            values, lit = found
            return Volume(values, mask, first, sectors, basis, expected, residual=self._residual(lit, light), rooms=(wanted,))
        if not inside.any():
            there = f"room {rooms[wanted - 1].name!r}" if wanted else "a room"
            lacks = f"has no probe in {there}" if reached else f"reaches no voxel of {there}; GET /v1/world lists rooms"
            raise InputError(f"kind=interior: the volume around this place {lacks}")
        values = np.ascontiguousarray(values[(slice(None), *nearest(inside))])
        return Volume(values, mask, first, sectors, basis, expected, residual=self._residual(lit, light), rooms=tuple(sorted(reached)))

    def _between_voxels(
        self, room: int, sectors: Sequence[SectorIndex], first: Int64, light: _Light, basis: str
    ) -> tuple[Float32, list[SectorIndex]] | None:
        """Values of a volume in which each voxel has what the nearest probe of a room has, and the sectors that these are of; None where
        there is none within the volume."""
        places, cubes, lit = [], [], []
        for index in sectors:
            with self._lock:
                sector = self._resident(index).sector
                place = sector.probe_position / VOXEL_SIZE_M + index.origin / VOXEL_SIZE_M - 0.5 - first
                within = ((place > -1) & (place < np.array(VOLUME_SHAPE)[[2, 0, 1]])).all(axis=1)
                chosen = np.flatnonzero((sector.probe_room == room) & (sector.probe_flags & PROBE_IN_MARGIN == 0) & within)
                if len(chosen):
                    places.append(place[chosen])
                    cubes.append(convert(self._lit_sector(index, light).cubes[chosen], self.dataset.world.basis, basis))
                    lit.append(index)
        if not lit:
            return None
        y, z, x = np.indices(VOLUME_SHAPE, np.float32)
        closest, least = np.zeros(VOLUME_SHAPE, np.int64), np.full(VOLUME_SHAPE, np.inf, np.float32)
        for number, (at_x, at_y, at_z) in enumerate(np.concatenate(places).astype(np.float32)):
            squared = (x - at_x) ** 2 + (y - at_y) ** 2 + (z - at_z) ** 2
            nearer = squared < least
            closest[nearer], least[nearer] = number, squared[nearer]
        return np.ascontiguousarray(np.moveaxis(np.concatenate(cubes)[closest], 3, 0), dtype=np.float32), lit

    def distant(self, lighting: Lighting, light: DistantLight | None = None) -> Distant:
        """One texel per sector of the whole world (slide "Distant shading").

        light : sky, as in the talk, or full; None takes the best that was baked. Lamps are the dataset's own, as they were baked.
        Raises InputError for a light that was not baked, CorruptFileError.
        """
        texels = self.dataset.distant()
        transfer = texels.transfer
        if light == "full" and transfer is None:
            raise InputError("light full: this dataset's distant texture knows the sky alone; expected sky, or bake it again")
        if light == "sky" or transfer is None:
            values = texels.sky[..., None] * face_exitance(lighting)
            return Distant(values.astype(np.float32), texels.origin, texels.valid)
        world = self.dataset.world
        values = np.zeros((*texels.valid.shape, 6, 3), np.float32)
        given = relight_input(lighting, world.sun_table, world.sky, world.sky_patches)
        values[texels.valid > 0] = transfer.light(given, lighting)
        return Distant(values, texels.origin, texels.valid, "full")

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
                cubes = self._lit_sector(index, light).cubes
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
        resident = self._lit_resident(box.index, light)
        sector = resident.sector
        if sector.probe_count:
            resident.fill_volume(box_record(box, sector), box.size, target, resident.converted(basis), basis)
        mask[box_slices(box)] = box_mask(box, sector)
        return sector.probe_count > 0

    def _lit_resident(self, index: SectorIndex, light: _Light) -> ResidentSector:
        """A sector on the device, with its probes lit."""
        cubes = self._lit_sector(index, light).cubes
        resident = self._resident(index)
        resident.write_cubes(cubes)
        return resident

    def _served(self, basis: str | None) -> str:
        """The basis that is meant. Raises InputError for one that the dataset cannot be served in."""
        own = self.dataset.world.basis
        if basis is not None and basis not in served_from(own):
            raise InputError(f"basis: this dataset was baked in {own}; expected {' or '.join(served_from(own))}, found {basis}")
        return own if basis is None else basis

    def _expected_error(self, basis: str, cascade: int = 0, in_rooms: bool = False) -> float | None:
        return expected_error(self.dataset.world.error_report, self.dataset.world.basis, basis, cascade, in_rooms)

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
        return sum(held.nbytes for kept in (self._residents, self._fine, self._lights) for held in kept.values())

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


def _in_room(room: UInt16, wanted: int) -> Bool:
    """Which of these rooms are the wanted one; of 0, any."""
    return np.asarray(room == wanted if wanted else room != ROOM_OUTDOORS, np.bool_)


def _fill_columns(values: Float32, has_light: Bool) -> None:
    """Light columns (32, 32) of a volume (B, 16, 32, 32, 3) that have none as the nearest that have some."""
    if has_light.any() and not has_light.all():
        lack, near = nearest_columns(has_light)
        values[:, :, lack[:, 0], lack[:, 1]] = values[:, :, near[:, 0], near[:, 1]]
