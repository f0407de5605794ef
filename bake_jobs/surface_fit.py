"""Voxels in walls, fitted to what the surfaces that read them need.

A client samples a volume a quarter voxel off a surface, so beside a wall about a third of what it mixes lies in something solid. The air
nearest to such a voxel may be across the wall, or too far out. So readers, places where surfaces are sampled, are spread over a sector and
their light is tried out (bake_jobs/trial_light.py). A voxel blends the probes that come closest to the mean of those that read it, each by
how much it does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bake_jobs.adaptive import DARK, DARK_LAMPLIGHT_LX, Trial
from bake_jobs.blend_candidates import LEAST_DISTANCE_M, held_at_border, kept_at_border, visible
from bake_jobs.config import BakeSettings
from bake_jobs.distinct import distinct
from bake_jobs.fit import fit_weights
from bake_jobs.inside import Solids
from bake_jobs.placement import Placement
from bake_jobs.rays import SURFACE_OFFSET_M, RayScene
from bake_jobs.trial_fit import relative_rows
from bake_jobs.trial_light import Cells, TrialScene
from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.arrays import Bool, Float32, Float64, Int64, UInt16
from gi_core.constants import ROOM_OUTDOORS, VOXEL_SIZE_M
from gi_core.geometry_file import Geometry
from gi_core.grid import voxel_centre
from gi_core.rooms import rooms_of
from gi_core.world import Room

# A reader for so much surface where voxels are coarse, and for so much of it where they are half as wide.
COARSE_AREA_M2, FINE_AREA_M2 = 6.0, 1.0
# A surface reads along its normal. Faces that it turns from count so much, or no light would hold them.
OTHER_FACES = 0.05
# Readers that take less than this from the wall do not count, nor do voxels that are read less in all.
LEAST_READ = 0.05
# Nearest probes of a reader that are tested for visibility.
CANDIDATES = 16
# What a place counts as off by that sees no probe, and at most.
UNSEEN = 1.5
# Roberts' sequence in two dimensions: spread evenly over triangles, whatever number of points falls into each.
_SPREAD = np.array([0.7548776662466927, 0.5698402909980532])
_CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclass(frozen=True, eq=False)
class Readers:
    """Places outdoors where surfaces are sampled, and the voxels of one lattice that they mix. n readers.

    place : (n, 3) float64 [m], in the air off the surface; normal : (n, 3) float64, unit, towards it
    voxel : (n, 8) int64, flat; reads : (n, 8) float64, the share of each, 0 where it is not one to be fitted
    """

    place: Float64
    normal: Float64
    voxel: Int64
    reads: Float64


@dataclass(frozen=True, eq=False)
class Fitted:
    """Blends of some voxels. voxel : (m,) int64, flat; probe : (m, K) uint16; weight : (m, K) float32, rows sum to 1."""

    voxel: Int64
    probe: UInt16
    weight: Float32


class SurfaceFit:
    """Fits voxels of one sector to light at its surfaces."""

    def __init__(
        self,
        ray_scene: RayScene,
        solids: Solids,
        geometry: Geometry,
        around: Sequence[Geometry],
        placement: Placement,
        settings: BakeSettings,
        rooms: tuple[Room, ...],
        trial: Trial,
        trial_scene: TrialScene,
    ) -> None:
        """``geometry``: the sector's surface; ``around``: its neighbours', parts of which read its voxels; ``trial_scene`` lights readers,
        in the fitted states at least, by a few rays: several share a voxel."""
        self._ray_scene, self._solids, self._rooms = ray_scene, solids, rooms
        self._geometry, self._around = geometry, around
        self._placement, self._settings, self._trial, self._trial_scene = placement, settings, trial, trial_scene
        self._top_m = trial.air.centre[trial.air.own & trial.air.in_band, 1].max(initial=-np.inf)

    def fit(self, lattice: Int64, wanted: Bool, voxel_size_m: float) -> Fitted:
        """Those of the wanted voxels (V,) of a lattice (ny, nz, nx, 3) that surfaces below the band's top read."""
        k = self._settings.voxel_probes
        nothing = Fitted(np.zeros(0, np.int64), np.zeros((0, k), np.uint16), np.zeros((0, k), np.float32))
        outdoors = np.flatnonzero(self._placement.room == ROOM_OUTDOORS)
        readers = self._readers(lattice, wanted, voxel_size_m)
        if not len(outdoors) or not len(readers.place):
            return nothing
        light = self.light(readers.place)
        states = self._trial.states
        # As placement does: closed places that no light comes into have no say.
        floor = np.where(states.lamps[states.fitted], DARK_LAMPLIGHT_LX, DARK).astype(np.float32)
        lit = (light[:, states.fitted].max(axis=2) >= floor).any(axis=1)
        reader, corner = np.nonzero(readers.reads * lit[:, None])
        share = readers.reads[reader, corner]
        voxel, number = np.unique(readers.voxel[reader, corner], return_inverse=True)
        of, count = number.reshape(-1), len(voxel)
        facing = (np.maximum(readers.normal @ FACE_DIRECTIONS.T, 0) ** 2 + OTHER_FACES)[reader] * share[:, None]
        read = np.bincount(of, share, count)
        turned = np.stack([np.bincount(of, facing[:, face], count) for face in range(6)], axis=1)
        target = np.zeros((count, light.shape[1], 6))
        np.add.at(target, of, facing[:, None] * light[reader])
        target /= np.maximum(turned, 1e-12)[:, None]
        centre = voxel_centre(lattice.reshape(-1, 3)[voxel], voxel_size_m)
        probe, closeness = self._candidates(readers.place, reader, share, of, centre, outdoors)
        good = np.flatnonzero((read > LEAST_READ) & (closeness.sum(axis=1) > 0))
        if not len(good):
            return nothing
        weight = self._weights(target[good].astype(np.float32), turned[good] / read[good, None], probe[good], closeness[good])
        best = np.argsort(-weight, axis=1, kind="stable")[:, :k]
        weight = np.take_along_axis(weight, best, axis=1)
        weight /= weight.sum(axis=1, keepdims=True)
        chosen = np.where(weight > 0, np.take_along_axis(probe[good], best, axis=1), 0)
        return Fitted(voxel[good], chosen.astype(np.uint16), weight)

    def _readers(self, lattice: Int64, wanted: Bool, voxel_size_m: float) -> Readers:
        """Readers on both sides of the surface, where there is air outdoors and they read a wanted voxel."""
        area_m2 = COARSE_AREA_M2 if voxel_size_m == VOXEL_SIZE_M else FINE_AREA_M2
        # Those beyond a border are the very ones of the sector there: both fit voxels beside it to the same.
        off = 0.25 * voxel_size_m
        low, high = voxel_centre(lattice[0, 0, 0] - 1, voxel_size_m), voxel_centre(lattice[-1, -1, -1] + 1, voxel_size_m)
        points, normals = [], []
        for geometry in (self._geometry, *self._around):
            point, normal = self.both_sides(area_m2, geometry)
            at = point + off * normal
            within = ((at > low) & (at < high)).all(axis=1)
            points.append(point[within])
            normals.append(normal[within])
        point, normal = np.concatenate(points), np.concatenate(normals)
        voxel, reads = _mixed(point + off * normal, lattice, voxel_size_m)
        reads = reads * wanted[voxel]
        some = np.flatnonzero(reads.sum(axis=1) > LEAST_READ)
        point, normal, voxel, reads = point[some], normal[some], voxel[some], reads[some]
        place, found = self.in_air(point, normal, off)
        return Readers(place[found], normal[found], voxel[found], reads[found])

    def both_sides(self, area_m2: float, geometry: Geometry | None = None) -> tuple[Float64, Float64]:
        """Points (n, 3) [m] on a surface, the sector's own if none is given, below the band's top, one for so much area and side, and unit
        normals (n, 3)."""
        point, normal = _spread(self._geometry if geometry is None else geometry, area_m2)
        low = point[:, 1] < self._top_m
        return np.concatenate([point[low], point[low]]), np.concatenate([normal[low], -normal[low]])

    def in_air(self, point: Float64, normal: Float64, off_m: float) -> tuple[Float64, Bool]:
        """Places (n, 3) [m] off a surface, where a client samples or halfway to what stands closer; which (n,) are in air outdoors."""
        free = self._ray_scene.closest(point + 2 * SURFACE_OFFSET_M * normal, normal).distance.astype(np.float64)
        place = point + np.minimum(off_m, free / 2)[:, None] * normal
        return place, ~self._solids.contain(place) & (rooms_of(place, self._rooms) == ROOM_OUTDOORS)

    def light(self, place: Float64) -> Float32:
        """(n, S, 6): what is tried out at places (n, 3) [m], in the readers' scene's states: those held out come last or not at all."""
        known, states = self._trial.light.cells, self._trial_scene.states
        return self._trial_scene.light(place, Cells(known.key, known.exitance[:, : states.count])).cube

    def unexplained(self, place: Float64, normal: Float64, light: Float32) -> Float64:
        """(n,), 0 to UNSEEN: how far the best blend of probes is from light (n, S, 6) at each place, relative, along its normal."""
        number, outdoors = np.arange(len(place)), np.flatnonzero(self._placement.room == ROOM_OUTDOORS)
        if not len(outdoors) or not len(place):
            return np.full(len(place), UNSEEN)
        probe, closeness = self._candidates(place, number, np.ones(len(place)), number, place, outdoors)
        sees = closeness.any(axis=1)
        facing = np.maximum(normal @ FACE_DIRECTIONS.T, 0) ** 2
        error = np.full(len(place), UNSEEN)
        fitted = self._trial.states.fitted
        weight = self._weights(light[sees], facing[sees] + OTHER_FACES, probe[sees], closeness[sees])
        blend = np.einsum("nc,ncsf->nsf", weight, self._trial.probe_cube[probe[sees]])
        served, exact = (np.einsum("nsf,nf->ns", a[:, fitted], facing[sees]) for a in (blend, light[sees]))
        relative = np.abs(served - exact) / np.maximum(exact, 0.02 * exact.mean(axis=0) + 1e-9)
        error[sees] = np.minimum(relative, UNSEEN).mean(axis=1)
        return error

    def _candidates(
        self, place: Float64, reader: Int64, share: Float64, of: Int64, centre: Float64, outdoors: Int64
    ) -> tuple[Int64, Float64]:
        """Probes (m, c) that the readers of voxels with centres (m, 3) [m] see, and how close (m, c) they are; 0 where there is none."""
        position, wanted, count = self._placement.position, self._settings.fit_candidates, len(centre)
        tried = min(CANDIDATES, len(outdoors))
        distance, near = cKDTree(position[outdoors]).query(place, k=tried)
        distance, near = distance.reshape(-1, tried), outdoors[near.reshape(-1, tried)]
        close = np.where(visible(self._ray_scene, place, position[near], distance), 1 / np.maximum(distance, LEAST_DISTANCE_M) ** 2, 0)
        pair, of_pair = distinct((of[:, None] * len(position) + near[reader]).reshape(-1))
        voxel, probe = np.divmod(pair, len(position))
        closeness = kept_at_border(centre[voxel], position[probe][:, None], self._settings.margin_m)[:, 0]
        closeness *= np.bincount(of_pair, (share[:, None] * close[reader]).reshape(-1), len(pair))
        held = held_at_border(centre[voxel], position[probe][:, None], self._settings.margin_m)[:, 0]
        some_held = np.bincount(voxel, (closeness > 0) & held, count) > 0
        closeness[some_held[voxel] & ~held] = 0
        order = np.lexsort((probe, -closeness, voxel))
        voxel, probe, closeness = voxel[order], probe[order], closeness[order]
        rank = np.arange(len(voxel)) - np.searchsorted(voxel, voxel)
        kept = rank < wanted
        found, prior = np.zeros((count, wanted), np.int64), np.zeros((count, wanted))
        found[voxel[kept], rank[kept]] = probe[kept]
        prior[voxel[kept], rank[kept]] = closeness[kept]
        return found, prior

    def _weights(self, target: Float32, turned: Float64, probe: Int64, closeness: Float64) -> Float32:
        """Weights (m, c) of candidates; target (m, S, 6), and how much (m, 6) each face of it counts."""
        fitted = self._trial.states.fitted
        rows, columns = relative_rows(target, self._trial.probe_cube[probe], fitted, np.sqrt(turned)[:, None])
        prior = (closeness / closeness.sum(axis=1, keepdims=True)).astype(np.float32)
        return fit_weights(columns, rows, prior, self._settings.fit_ridge, self._settings.voxel_probes)


def _spread(geometry: Geometry, area_m2: float) -> tuple[Float64, Float64]:
    """Points (n, 3) [m] on triangles, one for so much area, and unit normals (n, 3)."""
    corners = geometry.vertices[geometry.triangles]
    first, along, across = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled = np.cross(along, across)
    length = np.linalg.norm(doubled, axis=1)
    end = np.cumsum(length / 2)
    count = int(end[-1] / area_m2) if len(end) else 0
    of = np.searchsorted(end, (np.arange(count) + 0.5) * area_m2)
    u, v = (np.arange(count)[:, None] * _SPREAD % 1.0).T[:, :, None]
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    return first[of] + u * along[of] + v * across[of], doubled[of] / length[of, None]


def _mixed(at: Float64, lattice: Int64, voxel_size_m: float) -> tuple[Int64, Float64]:
    """Voxels (n, 8), flat, that trilinear sampling at points (n, 3) [m] mixes, and their shares (n, 8); 0 beyond the lattice."""
    ny, nz, nx = lattice.shape[:3]
    place = at / voxel_size_m - 0.5
    low = np.floor(place)
    part = (place - low)[:, None]
    share = np.where(_CORNERS, part, 1 - part).prod(axis=2)
    local = low[:, None].astype(np.int64) + _CORNERS - lattice[0, 0, 0]
    size = np.array([nx, ny, nz])
    share[((local < 0) | (local >= size)).any(axis=2)] = 0
    x, y, z = np.moveaxis(np.clip(local, 0, size - 1), 2, 0)
    return (y * nz + z) * nx + x, share
