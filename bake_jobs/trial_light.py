"""Light at many points of a sector, for placing probes and weighing them: coarse, quick, and a function of the world alone.

The points are the voxels of the air. Each looks along a cube map of a few rays; what they meet is keyed by world cells, twice as wide with
every doubling of the distance, and by principal direction, as surfels are. A cell is lit at one point of its surface:

    M = albedo (E_sun + E_sky + E_bounced) + pi L,     E_bounced: the same one bounce on, from a few rays, later ones as a series

That point is found by a ray through the middle of the cell, not among the hits; so neither which sector asks nor what else it asks about
changes a number, and two neighbours place the same probes along their border. The price: where a cell is larger than a closed place (4 m
beyond 8 m, 8 m beyond 16 m), its point may lie beyond the wall or the ceiling. That misplaces a probe or a weight, but leaks no light: the
bake casts its own rays.
"""

from dataclasses import dataclass

import numpy as np

from bake_jobs.distinct import distinct
from bake_jobs.gbuffer import cube_map_pattern
from bake_jobs.rays import SURFACE_OFFSET_M, Hits, RayScene
from bake_jobs.surfels import KEY_OFFSET_M, principal_direction
from bake_jobs.trial_states import TrialStates
from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.arrays import Bool, Float32, Float64, Int32, Int64
from gi_core.lights import light_records
from gi_core.lights_twin import PLACE, unshadowed
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.world import Lamp

CELL_M = 2.0
DOUBLE_BEYOND_M = 8.0
MAX_LEVEL = 8
# What these take at once stays in a processor's cache.
LOOKED_FROM_AT_ONCE, POINTS_AT_ONCE = 64, 256
BOUNCE_RAYS = 16
START_M = 0.02
# Bits of a cell's x, y and z in its key, after its level and before its direction; half of each range is negative.
_BITS = (18, 12, 18)
_HALF = np.array([1 << (bits - 1) for bits in _BITS])


@dataclass(frozen=True, eq=False)
class Cells:
    """Lit cells: key : (k,) int64, ascending, -1 for the sky; exitance : (k, S) float32, what each sends out in each state."""

    key: Int64
    exitance: Float32


@dataclass(frozen=True, eq=False)
class TrialLight:
    """cube : (n, S, 6) float32, irradiance of the six faces at each point in each state, luminance
    clearance : (n,) float32 [m], to the nearest surface that a ray met
    cells : what was met
    """

    cube: Float32
    clearance: Float32
    cells: Cells


class TrialScene:
    """A scene that points can be lit in."""

    def __init__(
        self, ray_scene: RayScene, albedo: Float32, emission: Float32, lamps: tuple[Lamp, ...], states: TrialStates, edge: int
    ) -> None:
        """albedo, emission : (m, 3) of the scene's triangles; edge : rays along an edge of a cube map face."""
        self._rays = ray_scene
        self.states = states
        weights = LUMINANCE_FROM_RGB.astype(np.float32)
        self._albedo, self._emission = albedo @ weights, emission @ weights
        self._lamps = lamps
        self._pattern = cube_map_pattern(edge)
        self._sky = states.sky_radiance(self._pattern.direction)
        self._bounce = _cosine_directions(BOUNCE_RAYS)

    def light(self, points: Float64, known: Cells | None = None) -> TrialLight:
        """Light at points (n, 3) [m], world frame. ``known``: cells that were lit before, which need not be lit again."""
        keys, clearance = self._look(points)
        unique, of_ray = distinct(keys.reshape(-1))
        cells = self._lit(unique, known)
        return TrialLight(self._gather(of_ray.reshape(keys.shape), keys < 0, cells.exitance), clearance, cells)

    def around(self, start: Float64, normal: Float32) -> Float32:
        """(k, S): the sky, and what surfaces around send on of sun and sky; from START_M off a surface (k, 3) [m] with normals (k, 3)."""
        states, rays = self.states, BOUNCE_RAYS
        directions = _turned(self._bounce, normal).reshape(-1, 3)
        origins = np.repeat(start, rays, axis=0)
        hits = self._rays.closest(origins, directions)
        of_sky = np.zeros((len(start) * rays, states.count), np.float32)
        of_sky[~hits.hit] = states.sky_radiance(directions[~hits.hit])
        sky = of_sky.reshape(len(start), rays, states.count).sum(axis=1) * np.float32(np.pi / rays)
        openness = 1 - hits.hit.reshape(len(start), rays).mean(axis=1, dtype=np.float32)
        met = np.flatnonzero(hits.hit)
        at = origins[met] + directions[met] * (hits.distance[met, None] - SURFACE_OFFSET_M)
        albedo = self._albedo[hits.triangle[met]]
        sunlit = self._suns(at, hits.normal[met]) @ states.sun_irradiance
        of_cell = met // rays
        # What it meets sees about as much sky as it does itself, and later bounces lose what leaves through that opening.
        onward = albedo[:, None] * (sunlit + sky[of_cell]) / (1 - albedo * (1 - openness[of_cell]))[:, None]
        bounced = np.zeros((len(start) * rays, states.count), np.float32)
        bounced[met] = onward
        return sky + bounced.reshape(len(start), rays, states.count).mean(axis=1)

    def _lit(self, keys: Int64, known: Cells | None) -> Cells:
        if known is None or not len(known.key):
            return Cells(keys, self._exitance(keys))
        at = np.minimum(np.searchsorted(known.key, keys), len(known.key) - 1)
        exitance = known.exitance[at]
        new = np.flatnonzero(known.key[at] != keys)
        exitance[new] = self._exitance(keys[new])
        return Cells(keys, exitance)

    def _look(self, points: Float64) -> tuple[Int64, Float32]:
        """Cell keys (n, r) of what each point's rays meet, -1 for the sky; and the distance (n,) of the nearest hit."""
        direction = self._pattern.direction
        keys = np.empty((len(points), len(direction)), np.int64)
        clearance = np.empty(len(points), np.float32)
        local = self._rays.local(points)
        for start in range(0, len(points), LOOKED_FROM_AT_ONCE):
            some = local[start : start + LOOKED_FROM_AT_ONCE]
            hits = self._rays.closest_from(np.repeat(some, len(direction), axis=0), np.tile(direction, (len(some), 1)))
            distance = hits.distance.reshape(len(some), -1)
            clearance[start : start + len(some)] = distance.min(axis=1)
            # A ray into a corner may end a rounding beyond the edge, in the next cell: keys are taken a little before the end.
            reach = np.where(np.isfinite(distance), distance - np.float32(KEY_OFFSET_M), 0)[:, :, None]
            at = some[:, None] + direction * reach
            key = _cell_keys(at.reshape(-1, 3), hits, distance.reshape(-1))
            keys[start : start + len(some)] = key.reshape(len(some), -1)
        return keys, clearance

    def _exitance(self, keys: Int64) -> Float32:
        """(k, S): what cells send out; nothing for the key -1, which is the sky."""
        is_sky = keys < 0
        position, normal, triangle = self._surfaces(keys[~is_sky])
        albedo = self._albedo[triangle]
        states = self.states
        start = position + normal * START_M
        direct = self._suns(start, normal) @ states.sun_irradiance
        lamp_states = np.flatnonzero(states.lamps)
        if len(lamp_states):
            direct[:, lamp_states] += self._lamplight(start, normal)[:, None]
        arriving = direct + self.around(start, normal)
        found = np.zeros((len(keys), states.count), np.float32)
        found[~is_sky] = albedo[:, None] * arriving
        if len(lamp_states):
            found[np.ix_(~is_sky, lamp_states)] += np.float32(np.pi) * self._emission[triangle][:, None]
        return found

    def _surfaces(self, keys: Int64) -> tuple[Float64, Float32, Int32]:
        """A point on the surface of each cell, its normal, and its triangle."""
        centre, size, direction = _cells(keys)
        axis = FACE_DIRECTIONS[direction]
        # From a cell above: a slanted surface leaves the cell before its middle.
        start = centre + self._rays.anchor + axis * size[:, None]
        hits = self._rays.closest(start, -axis)
        good = hits.hit & (hits.distance < 2 * size) & (np.einsum("ij,ij->i", hits.normal, axis) > 0.3)
        # Where the middle is missed, the cell's own middle has to do.
        position = np.where(good[:, None], start - axis * np.where(good, hits.distance, 0)[:, None], centre + self._rays.anchor)
        normal = np.where(good[:, None], hits.normal, axis).astype(np.float32)
        return position, normal, np.where(hits.hit, hits.triangle, 0).astype(np.int32)

    def _suns(self, start: Float64, normal: Float32) -> Float32:
        """(k, suns): cosine to each sun where it is seen, otherwise 0."""
        directions = self.states.sun_direction.astype(np.float32)
        cosine = np.maximum(normal @ directions.T, 0)
        # Sun by sun: rays that run side by side are a tenth faster.
        sun, cell = np.nonzero(np.ascontiguousarray((cosine > 0).T))
        blocked = self._rays.occluded_from(self._rays.local(start).take(cell, axis=0), directions.take(sun, axis=0))
        cosine[cell[blocked], sun[blocked]] = 0
        return cosine

    def _lamplight(self, start: Float64, normal: Float32) -> Float32:
        """(k,): all lamps, each shadowed by one ray to its middle."""
        total = np.zeros(len(start), np.float32)
        if not self._lamps or not len(start):
            return total
        low, high = start.min(axis=0), start.max(axis=0)
        places = np.zeros(len(start), PLACE)
        places["position"], places["normal"] = start - self._rays.anchor, normal
        for lamp in self._lamps:
            middle = np.array(lamp.position)
            if (middle + lamp.range_m < low).any() or (middle - lamp.range_m > high).any():
                continue
            within = np.flatnonzero(((start - middle) ** 2).sum(axis=1) < lamp.range_m**2)
            record = light_records([lamp], self._rays.anchor)[0]
            given = unshadowed(record, places[within]) * np.float32(record["intensity"] @ LUMINANCE_FROM_RGB)
            lit = within[given > 0]
            way = middle - start[lit]
            distance = np.linalg.norm(way, axis=1)
            seen = ~self._rays.occluded(start[lit], way / np.maximum(distance, 1e-6)[:, None], distance - START_M)
            total[lit] += given[given > 0] * seen
        return total

    def _gather(self, of_ray: Int64, is_sky: Bool, exitance: Float32) -> Float32:
        """(n, S, 6): sky and cells, weighed by each face."""
        states, weight = self.states.count, self._pattern.weight
        sky = (np.float32(np.pi) * self._sky[:, :, None] * weight[:, None, :]).reshape(len(weight), -1)
        cubes = np.empty((len(of_ray), states, 6), np.float32)
        for start in range(0, len(of_ray), POINTS_AT_ONCE):
            some = slice(start, start + POINTS_AT_ONCE)
            from_sky = (is_sky[some].astype(np.float32) @ sky).reshape(-1, states, 6)
            cubes[some] = from_sky + np.matmul(weight.T, exitance[of_ray[some]]).transpose(0, 2, 1)
        return cubes


def _cell_keys(at: Float32, hits: Hits, distance: Float32) -> Int64:
    """Keys (n,) of the cells that hits fall into; -1 where nothing was met. at : (n, 3) [m] from the anchor."""
    level = np.clip(np.floor(np.log2(np.maximum(distance, 1e-3) / np.float32(DOUBLE_BEYOND_M))) + 1, 0, MAX_LEVEL)
    size = np.float32(CELL_M) * np.exp2(level)
    cell = np.floor((at + hits.normal * np.float32(KEY_OFFSET_M)) / size[:, None]).astype(np.int64) + _HALF
    key = level.astype(np.int64)
    for axis in range(3):
        key = key << _BITS[axis] | cell[:, axis]
    return np.where(hits.hit, key << 3 | principal_direction(hits.normal), -1)


def _cells(keys: Int64) -> tuple[Float64, Float64, Int64]:
    """Middles (n, 3) [m] from the anchor, sizes (n,) [m] and principal directions (n,) of keys."""
    rest = keys >> 3
    cell = np.empty((len(keys), 3))
    for axis in (2, 1, 0):
        cell[:, axis] = (rest & ((1 << _BITS[axis]) - 1)) - _HALF[axis]
        rest = rest >> _BITS[axis]
    size = CELL_M * np.exp2(rest)
    return (cell + 0.5) * size[:, None], size, keys & 7


def _cosine_directions(count: int) -> Float32:
    """(count, 3) unit directions about +Z, spread in proportion to their cosine."""
    height = np.sqrt(1 - (np.arange(count) + 0.5) / count)
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(turn), level * np.sin(turn), height], axis=1).astype(np.float32)


def _turned(directions: Float32, normal: Float32) -> Float32:
    """(n, r, 3): directions (r, 3) about +Z turned to be about each normal (n, 3)."""
    # Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 2017.
    sign = np.where(normal[:, 2] >= 0, 1, -1).astype(np.float32)
    a = -1 / (sign + normal[:, 2])
    b = normal[:, 0] * normal[:, 1] * a
    tangent = np.stack([1 + sign * normal[:, 0] ** 2 * a, sign * b, -sign * normal[:, 0]], axis=1)
    other = np.stack([b, sign + normal[:, 1] ** 2 * a, -normal[:, 1]], axis=1)
    return np.asarray(directions @ np.stack([tangent, other, normal], axis=1), np.float32)
