"""Served light as a client reads it: volumes, and beyond them the texture of distant sectors (slide "Distant shading").

    in a room              its interior volume; at its openings, on both sides, a mix with what is beyond (gi_core.rooms.light_shares)
    in a volume's box      the volume
    up to FADE_M beyond    its edge, faded into the texture
    farther                the texture alone

A client has one volume around its player, or cascades one in another, each fading into the next; a picture may take as many volumes as its
pixels need.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gi_core import ambient_cube
from gi_core.arrays import Float32, Float64, Int64
from gi_core.basis import average
from gi_core.constants import MAX_CASCADE, ROOM_OUTDOORS, SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.distant_file import DistantLight
from gi_core.engine import Distant, Engine
from gi_core.errors import InputError
from gi_core.lighting import Lighting
from gi_core.rooms import light_shares
from gi_core.settings import NEUTRAL, Settings
from gi_core.volume import Volume, sample_coefficients, sample_volume
from gi_core.world import Decal, Room

Indirect = Literal["on", "off", "split"]
Beyond = Literal["on", "off", "client", "cascades"]
# The served volume around a place, of the room that a number says; 0 is outdoors.
VolumeAt = Callable[[Float64, int], Volume]

SAMPLE_OFFSET_M = VOXEL_SIZE_M / 4
# Where openings are looked for: the reveals of a door lie in the very plane of its rim.
SURFACE_OFFSET_M = 0.02
# Neighbouring volumes overlap by 4 voxels along each axis, so that every sample lies between voxel centres even after snapping.
TILE_M = (np.array([VOLUME_SHAPE[2], VOLUME_SHAPE[0], VOLUME_SHAPE[1]]) - 4) * VOXEL_SIZE_M
# From an outermost voxel's centre to the other side's.
EXTENT_M = (np.array([VOLUME_SHAPE[2], VOLUME_SHAPE[0], VOLUME_SHAPE[1]]) - 1) * VOXEL_SIZE_M
# The pixels that these do not cover are far away.
MAX_VOLUMES = 128
# Steps through the air crowd near the eye; more volumes would make a far view of a city light all of it.
MAX_AIR_VOLUMES = 64
# Sampling holds some 300 bytes a point: 20 MB.
SAMPLES_AT_ONCE = 1 << 16
# Looking for the nearest of 128 volumes holds 3 kB a tile: 12 MB.
TILES_AT_ONCE = 1 << 12
# A quarter of a volume's width: no line shows where the texture, which is flat over tens of metres, takes over.
FADE_M = 25.0


@dataclass(frozen=True)
class Look:
    """What of the light a picture shows.

    indirect : where indirect light is drawn; split: in the right half only
    distant : what lies beyond the volumes; on: the distant texture, off: the nearest volume's edge, client: the texture beyond the one
        volume around the eye, cascades: beyond the coarser ones around that
    occlusion : whether what stands near, and decals, dim it
    interior : whether rooms are lit by their interior volumes, or by the outdoor one
    distant_light : what the distant texture knows: the sky alone, or all light; None is the best that was baked
    """

    indirect: Indirect = "on"
    distant: Beyond = "on"
    occlusion: bool = False
    interior: bool = True
    distant_light: DistantLight | None = None


PLAIN_LOOK = Look()


@dataclass(frozen=True, eq=False)
class ServedLight:
    """All that a picture knows of indirect light.

    volume_at : the served volume around a world position (3,) [m], of a room or outdoors
    distant : what lies beyond the volumes; None: their edge goes on for ever
    player : (3,) [m], the one place that there is a volume around; None: as many as points need, at most MAX_VOLUMES
    rooms : of the world; what lies in one reads its interior volume, and nothing beyond it but through an opening
    decals : of the world; they dim indirect light where a picture asks for occlusion
    coarser : cascades around ``player``, the next after the volume first
    """

    volume_at: VolumeAt
    distant: Distant | None = None
    player: Float64 | None = None
    rooms: tuple[Room, ...] = ()
    decals: tuple[Decal, ...] = ()
    coarser: tuple[Volume, ...] = ()

    @classmethod
    def of(
        cls, engine: Engine, lighting: Lighting, look: Look, eye: Float64, settings: Settings = NEUTRAL, basis: str | None = None
    ) -> "ServedLight":
        """An engine's light under the artists' settings, as a look has it, seen from an eye (3,) [m], of volumes in a basis, the dataset's
        where it is None. Raises InputError for a distant light that was not baked, CorruptFileError."""
        low, high = engine.dataset.world.bounds

        def volume_at(position: Float64, room: int) -> Volume:
            # A tile's centre may lie beyond the world's edge though its pixels do not.
            inside = np.clip(position, low, high)
            try:
                if room:
                    return engine.interior(inside, lighting, settings, basis, str(room))
                return engine.volume(inside, lighting, settings, basis)
            except InputError:  # a room without a probe, or out of the one volume's reach: nothing is known of it, the street's light least
                outdoors = engine.volume(inside, lighting, settings, basis)
                return replace(outdoors, values=np.zeros_like(outdoors.values))

        distant = None if look.distant == "off" else engine.distant(settings.light(lighting), look.distant_light)
        world, coarser = engine.dataset.world, range(1, MAX_CASCADE + 1) if look.distant == "cascades" else ()
        cascades = tuple(engine.volume(np.clip(eye, low, high), lighting, settings, basis, n) for n in coarser)
        player = eye if look.distant in ("client", "cascades") else None
        return cls(volume_at, distant, player, world.rooms if look.interior else (), world.decals, cascades)

    def irradiance(self, position: Float64, normal: Float32) -> Float32:
        """(n, 3) [lx] on surface points (n, 3) [m] with normals (n, 3), as a client samples it."""
        # sample_volume reads this far off the surface, which may be the next volume's.
        points = position + SAMPLE_OFFSET_M * normal
        result = np.zeros((len(points), 3), np.float32)
        for volume, some, share, is_room in self._parts(points, position + SURFACE_OFFSET_M * normal, MAX_VOLUMES):
            if is_room:
                light = sample_volume(volume.values, volume.origin, volume.voxel_size, position[some], normal[some])
            else:
                light = self._outdoors((volume, *self.coarser), position[some], normal[some])
            result[some] += share[:, None] * light
        return result

    def _outdoors(self, volumes: tuple[Volume, ...], position: Float64, normal: Float32) -> Float32:
        """(n, 3) [lx] on surface points (n, 3) [m] with normals (n, 3): the first volume's, then the others', then the texture's."""
        volume, *coarser = volumes
        light = sample_volume(volume.values, volume.origin, volume.voxel_size, position, normal)
        if not coarser and self.distant is None:
            return light
        points = position + volume.voxel_size / 4 * normal
        near = cascade_share(volume, points) if coarser else near_share(volume.origin, points, float(volume.voxel_size[0]))
        far = np.flatnonzero(near < 1)
        if coarser:
            beyond = self._outdoors(tuple(coarser), position[far], normal[far])
        else:
            assert self.distant is not None
            beyond = ambient_cube.evaluate(sample_distant(self.distant, points[far]), normal[far])
        light[far] += (1 - near[far])[:, None] * (beyond - light[far])
        return light

    def mean_irradiance(self, points: Float64) -> tuple[Float32, Float32]:
        """Of points (n, 3) [m] in the air: the mean over directions (n, 3) [lx], and how far volumes know it, ``near_share`` (n,).

        Of the distant texture nothing is taken: it is of the streets, not of the air above them.
        """
        result, known = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
        for volume, some, share, _ in self._parts(points, points, MAX_AIR_VOLUMES):
            mean = average(volume.values)[None]
            result[some] += share[:, None] * sample_coefficients(mean, volume.origin, volume.voxel_size, points[some])[:, 0]
            known[some] += share * near_share(volume.origin, points[some])
        return result, known

    def _parts(self, points: Float64, surface: Float64, most: int) -> Iterator[tuple[Volume, Int64, Float32, bool]]:
        """Volumes, at most ``most`` of each room and of the open air, the points (k,) that each lights, its share of their light (k,), and
        whether it is a room's. The shares of a point sum to 1."""
        shares = light_shares(points, self.rooms, surface)
        for number in np.unique(shares.room).tolist():
            share = shares.of(number, len(points))
            there = np.flatnonzero(share > 0)
            if self.player is None:
                centres, which = plan_volumes(points[there], most)
            else:
                centres, which = self.player[None], np.zeros(len(there), np.int64)
            for i, centre in enumerate(centres):
                members = there[which == i]
                volume = self.volume_at(centre, number)
                for start in range(0, len(members), SAMPLES_AT_ONCE):
                    some = members[start : start + SAMPLES_AT_ONCE]
                    yield volume, some, share[some], number != ROOM_OUTDOORS


def cascade_share(volume: Volume, points: Float64) -> Float32:
    """How much of the light of points (n, 3) [m] is their cascade's and not the next one's: 1 from two voxels inside its
    outermost centres on, 0 at those. (n,)"""
    place = (points - volume.origin) / volume.voxel_size
    inside = np.minimum(place, EXTENT_M / VOXEL_SIZE_M - place).min(axis=1)
    return np.asarray(np.clip(inside / 2, 0, 1), np.float32)


def near_share(origin: Float64, points: Float64, voxel_size_m: float = VOXEL_SIZE_M) -> Float32:
    """How much of the light of points (n, 3) [m] is their volume's: 1 between its voxel centres, of which the first is at ``origin``
    (3,) [m], 0 from FADE_M beyond them. (n,)"""
    beyond = np.linalg.norm(points - np.clip(points, origin, origin + EXTENT_M * (voxel_size_m / VOXEL_SIZE_M)), axis=1)
    return np.asarray(np.clip(1 - beyond / FADE_M, 0, 1), np.float32)


def sample_distant(distant: Distant, points: Float64) -> Float32:
    """Cubes (n, 6, 3) [lx] of the distant texture at points (n, 3) [m]: bilinear between the centres of sectors that there are.

    0 where none of the four is: no sector within 64 m.
    """
    rows, columns = distant.valid.shape
    at = points[:, [0, 2]] / SECTOR_SIZE_M - 0.5 - np.array(distant.origin)
    at = np.clip(at, 0, [columns - 1, rows - 1])
    first = np.floor(at).astype(np.int64)
    share = (at - first).astype(np.float32)
    total, weights = np.zeros((len(points), 6, 3), np.float32), np.zeros(len(points), np.float32)
    for right in (0, 1):
        for down in (0, 1):
            column, row = np.minimum(first[:, 0] + right, columns - 1), np.minimum(first[:, 1] + down, rows - 1)
            weight = (share[:, 0] if right else 1 - share[:, 0]) * (share[:, 1] if down else 1 - share[:, 1])
            weight = weight * distant.valid[row, column]
            total += weight[:, None, None] * distant.values[row, column]
            weights += weight
    return np.asarray(total / np.maximum(weights, np.float32(1e-6))[:, None, None], np.float32)


def plan_volumes(points: Float64, most: int = MAX_VOLUMES) -> tuple[Float64, Int64]:
    """Centres (v, 3) [m] of the volumes that cover points (n, 3) [m], and which one each point reads (n,).

    A fixed lattice of overlapping volumes; when more than ``most`` would be needed those with the fewest points are left out, and
    their points read the nearest of the others.
    """
    tile = np.floor(points / TILE_M).astype(np.int64)
    first = tile.min(axis=0)
    shape = tuple(tile.max(axis=0) - first + 1)
    # One number per tile: sorting rows would take longer than everything else that a picture needs.
    keys, tile_of, counts = np.unique(np.ravel_multi_index(tuple((tile - first).T), shape), return_inverse=True, return_counts=True)
    centres = (np.stack(np.unravel_index(keys, shape), axis=1) + first + 0.5) * TILE_M
    kept = np.sort(np.argsort(-counts, kind="stable")[:most])
    nearest = np.empty(len(centres), np.int64)
    for start in range(0, len(centres), TILES_AT_ONCE):
        some = slice(start, start + TILES_AT_ONCE)
        nearest[some] = np.argmin(np.linalg.norm(centres[some, None] - centres[None, kept], axis=2), axis=1)
    return centres[kept], nearest[tile_of]
