"""What a sector's light errs by, all in all: voxels near surfaces, from the sector's own solved probes, beside the path tracer there.

Interpolation is not all. Rays, clusters, sky patches, sun directions and feedback make probes err by themselves, and trial light is
not the real one. So a bake that is asked for a target error measures a few voxels, under suns that nothing was placed or fitted for.
"""

import numpy as np

from bake_jobs.compare_points import look_around
from bake_jobs.path_tracer import PathTracer, cube_projector
from bake_jobs.trial_fit import JUDGED_FAINT
from gi_core import relight_twin
from gi_core.arrays import Int64
from gi_core.basis import basis_of_size, conversion
from gi_core.grid import voxel_centre
from gi_core.lighting_model import make_lighting
from gi_core.relight_input import relight_input
from gi_core.sector import Sector
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.sun_table import SunTable
from gi_core.world import Location

# Clear, a spring's morning and a summer's afternoon; neither sun stands where one is baked.
MOMENTS = ("2026-03-20T10:00", "2026-06-21T15:00")
VOXELS, SAMPLES = 128, 512
# Of so many more it is asked whether they lie in open air: the dark inside badly modelled houses is nobody's.
LOOKED_AT = 4 * VOXELS
# Bounces left out by then are a hundredth of what is looked for.
SOLVED_TO = 1e-4
# The median of a normal error's size, in standard errors.
MEDIAN_OF_NORMAL = 0.6745


class ServedError:
    """Measures sectors of one scene."""

    def __init__(self, tracer: PathTracer, location: Location, table: SunTable, sky: str, patches: int) -> None:
        """table, sky, patches : of the bake, as ``relight_input`` takes them"""
        self._tracer = tracer
        self._lightings = [make_lighting(location, moment) for moment in MOMENTS]
        self._given = [relight_input(lighting, table, sky, patches) for lighting in self._lightings]

    def of(self, sector: Sector, lattice: Int64) -> float | None:
        """Median relative error over the faces of at most VOXELS of the sector's voxels among (n, 3), world lattice, the path tracer's
        own noise taken off; of those in open air where there are any. None where there is nothing to measure."""
        at = lattice - sector.voxel_first
        at = _some(at[((at >= 0) & (at < np.array(sector.voxel_class.shape)[[2, 0, 1]])).all(axis=1)], LOOKED_AT)
        open_air = look_around(self._tracer.rays, voxel_centre(at + sector.voxel_first)).open_air
        at = _some(at[open_air] if open_air.any() else at, VOXELS)
        if len(at) == 0 or sector.probe_count == 0:
            return None
        x, y, z = at.T
        centre, basis = voxel_centre(at + sector.voxel_first), basis_of_size(sector.basis_size)
        found = []
        for number, (lighting, given) in enumerate(zip(self._lightings, self._given, strict=True)):
            traced = self._tracer.projected_irradiance(centre, lighting, (), cube_projector(basis), samples=SAMPLES, seed=number)
            probes = relight_twin.solve(sector, given, SOLVED_TO)[sector.voxel_probe[y, z, x]]
            served = np.einsum("fb,nk,nkbc->nfc", conversion(basis, "cube"), sector.voxel_weight[y, z, x], probes)
            light, off, noise = (v @ LUMINANCE_FROM_RGB for v in (traced.mean, served - traced.mean, traced.standard_error))
            found.append(np.abs([off, noise]) / np.maximum(light, max(JUDGED_FAINT * light.mean(), np.finfo(np.float32).tiny)))
        error, noise = np.median(np.stack(found, axis=1).reshape(2, -1), axis=1)
        return float(np.sqrt(max(error**2 - (MEDIAN_OF_NORMAL * noise) ** 2, 0.0)))


def _some(of: Int64, count: int) -> Int64:
    """At most ``count`` of the rows, evenly."""
    return of[np.unique(np.linspace(0, len(of) - 1, min(count, len(of))).astype(np.int64))]
