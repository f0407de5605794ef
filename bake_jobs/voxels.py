"""Which probes a voxel of the irradiance volume blends: baked interpolation, so that no leak test is left for run time.

A voxel in free air blends the closest probes that it sees. One that sees none of them, and one in a solid, blends what the nearest air
does that sees some: light does not end at a pillar, and trilinear sampling at a wall never turns dark. Indoors such a voxel takes the
closest probe of its room instead, since the nearest air may be another's.

Weights go by distance, or where light was tried out they are fitted to it (``voxel_weights="fitted"``), and those of voxels in walls to
what surfaces that read them need (``wall_weights="fitted"``).

Towards a border a voxel gives up probes that the sector beyond does not hold: at the border line both sectors choose among the same.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from bake_jobs.adaptive import Trial
from bake_jobs.blend_candidates import FADE_M, LEAST_DISTANCE_M, held_at_border, kept_at_border, to_border, visible
from bake_jobs.config import FILL_MARGIN, BakeSettings
from bake_jobs.inside import Solids
from bake_jobs.placement import Placement
from bake_jobs.rays import RayScene
from bake_jobs.surface_fit import SurfaceFit
from bake_jobs.trial_fit import TrialFit
from bake_jobs.voxel_classes import solid_voxels
from gi_core.arrays import Bool, Float32, Float64, Int32, Int64, UInt8, UInt16
from gi_core.constants import ROOM_OUTDOORS, VOXEL_INDOORS, VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.grid import SectorIndex, voxel_centre, voxel_columns
from gi_core.rooms import rooms_of
from gi_core.world import Room

# Air is stored this far above a sector's highest surface, and at least this far above its lowest: half a volume, for a player who
# stands in the street.
AIR_ABOVE_TOP_M = 4.0
AIR_ABOVE_GROUND_M = 28.0
# What fades out at a border has to be replaced by probes that may be farther away than the usual candidates.
CANDIDATES_AT_BORDER = 24


@dataclass(frozen=True, eq=False)
class Voxels:
    """Arrays as gi_core.sector describes them; ``blind``: how many free voxels see none of their closest probes; ``estimated_error``: of
    fitted weights (TrialFit)."""

    first: Int32
    kind: UInt8
    room: UInt16
    probe: UInt16
    weight: Float32
    blind: int
    estimated_error: float | None = None


def bake_voxels(
    ray_scene: RayScene,
    solids: Solids,
    surfaces: Float64,
    index: SectorIndex,
    placement: Placement,
    settings: BakeSettings,
    rooms: tuple[Room, ...],
    trial: Trial | None = None,
    surface_fit: SurfaceFit | None = None,
) -> Voxels:
    """Voxels of a sector. ``surfaces`` (2,) [m] are the lowest and highest surface in it; weights are fitted to ``trial`` where it has
    light, and go by distance elsewhere. Voxels without light of their own are fitted by ``surface_fit`` where surfaces read them."""
    top = max(float(surfaces[1]) + AIR_ABOVE_TOP_M, float(surfaces[0]) + AIR_ABOVE_GROUND_M)
    lattice, shape = sector_lattice(index, float(surfaces[0]), top, VOXEL_SIZE_M)
    centre = voxel_centre(lattice.reshape(-1, 3))
    room = rooms_of(centre, rooms)
    kind = np.where(room == ROOM_OUTDOORS, VOXEL_OUTDOORS, VOXEL_INDOORS).astype(np.uint8)
    # An authored room is air, whatever way its walls were modelled.
    kind[(room == ROOM_OUTDOORS) & solid_voxels(ray_scene, solids, centre.reshape(*shape, 3)).reshape(-1)] = VOXEL_SOLID
    fit = None if trial is None else TrialFit(trial, lattice.reshape(-1, 3), settings)
    probe, weight, blind = blend(ray_scene, centre, kind, room, placement, settings, fit)
    lit = (kind != VOXEL_SOLID) & ~(blind & (room == ROOM_OUTDOORS))
    source, _ = nearest_lit(lit, shape)
    probe, weight = probe[source], weight[source]
    if surface_fit is not None:
        read = surface_fit.fit(lattice, ~lit, VOXEL_SIZE_M)
        probe[read.voxel], weight[read.voxel] = read.probe, read.weight

    # The fill margin was only there to be read from.
    inner = (slice(None), slice(FILL_MARGIN, -FILL_MARGIN), slice(FILL_MARGIN, -FILL_MARGIN))
    k = settings.voxel_probes
    return Voxels(
        first=lattice[0, FILL_MARGIN, FILL_MARGIN].astype(np.int32),
        kind=np.ascontiguousarray(kind.reshape(shape)[inner]),
        room=np.ascontiguousarray(room.reshape(shape)[inner]),
        probe=np.ascontiguousarray(probe.reshape(*shape, k)[inner]),
        weight=np.ascontiguousarray(weight.reshape(*shape, k)[inner]),
        blind=int(blind.sum()),
        estimated_error=None if fit is None else fit.estimated_error,
    )


def sector_lattice(index: SectorIndex, low_m: float, high_m: float, voxel_size_m: float) -> tuple[Int64, tuple[int, int, int]]:
    """Lattice indices (ny, nz, nx, 3) of a sector's voxels, and of FILL_MARGIN around them, from below ``low_m`` to above ``high_m``."""
    x0, x1 = voxel_columns(index.x, voxel_size_m)
    z0, z1 = voxel_columns(index.z, voxel_size_m)
    y0 = int(np.floor(low_m / voxel_size_m)) - 1
    y1 = int(np.ceil(high_m / voxel_size_m)) + 1
    ranges = (np.arange(y0, y1), np.arange(z0 - FILL_MARGIN, z1 + FILL_MARGIN), np.arange(x0 - FILL_MARGIN, x1 + FILL_MARGIN))
    y, z, x = np.meshgrid(*ranges, indexing="ij")
    return np.stack([x, y, z], axis=-1), (len(ranges[0]), len(ranges[1]), len(ranges[2]))


def blend(
    ray_scene: RayScene,
    centre: Float64,
    kind: UInt8,
    room: UInt16,
    placement: Placement,
    settings: BakeSettings,
    fit: TrialFit | None,
) -> tuple[UInt16, Float32, Bool]:
    """Probes (V, K) and weights (V, K) of all voxels, zero where a voxel is solid; which voxels (V,) see none and take the closest."""
    k = settings.voxel_probes
    probe = np.zeros((len(centre), k), np.uint16)
    weight = np.zeros((len(centre), k), np.float32)
    blind = np.zeros(len(centre), bool)
    for number in np.unique(room):
        members = np.flatnonzero((room == number) & (kind != VOXEL_SOLID))
        available = np.flatnonzero(placement.room == number)
        if len(available) == 0:
            # A room without a probe of its own borrows from all: better than black.
            available = np.arange(len(placement.position))
        if len(members) == 0 or len(available) == 0:
            continue
        tree = cKDTree(placement.position[available])
        at_border = to_border(centre[members]).min(axis=1) < FADE_M
        for fades, most in ((False, settings.voxel_candidates), (True, CANDIDATES_AT_BORDER)):
            some = members[at_border == fades]
            candidates = min(max(most, settings.voxel_candidates), len(available))
            distance, near = tree.query(centre[some], k=candidates)
            distance, near = distance.reshape(len(some), candidates), available[near.reshape(len(some), candidates)]
            sees = visible(ray_scene, centre[some], placement.position[near], distance)
            blind_member = ~sees.any(axis=1)
            sees[blind_member, 0] = True
            blind[some] = blind_member
            kept = kept_at_border(centre[some], placement.position[near], settings.margin_m) if fades else 1.0
            closeness = np.where(sees, kept / np.maximum(distance, LEAST_DISTANCE_M) ** 2, 0)
            rows = np.arange(len(some))[:, None]
            share = np.zeros_like(closeness)
            closest = np.argsort(-closeness, axis=1, kind="stable")[:, :k]
            share[rows, closest] = closeness[rows, closest]
            if fit is not None and (fades or settings.margin_m > FADE_M):
                # A fit heeds little how close probes are: what one sector alone holds is kept from it, where it sees anything else.
                held = held_at_border(centre[some], placement.position[near], settings.margin_m)
                closeness[((closeness > 0) & held).any(axis=1, keepdims=True) & ~held] = 0
            if fit is not None:
                share = fit.shares(some, near, closeness, share)
            best = np.argsort(-share, axis=1, kind="stable")[:, :k]
            probe[some, : best.shape[1]] = near[rows, best]
            weight[some, : best.shape[1]] = share[rows, best] / share.sum(axis=1, keepdims=True)
    probe[weight == 0] = 0
    return probe, weight, blind


def nearest_lit(lit: Bool, shape: tuple[int, int, int]) -> tuple[Int64, Float64]:
    """For each voxel (flat order), the flat index of the nearest that is lit, its own where none is; and how far that is [voxels]."""
    if not lit.any():
        return np.arange(lit.size), np.zeros(lit.size)
    distance, nearest = distance_transform_edt(~lit.reshape(shape), return_indices=True)
    return np.ravel_multi_index(tuple(nearest), shape).reshape(-1), distance.reshape(-1)
