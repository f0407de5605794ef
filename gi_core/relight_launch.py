"""How a relight's kernels are launched over a resident sector: all in one launch on a processor, one for each phase elsewhere."""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pyopencl as cl

from gi_core.device import BoundKernel

if TYPE_CHECKING:
    from gi_core.resident_sector import LightOnDevice, ResidentSector

SURFELS_PER_GROUP = 8  # of sun_on_surfels.cl: a byte of a plane's bits

Launch = Callable[[cl.CommandQueue, int, bool, "LightOnDevice"], None]
"""queue, passes, whether the light is another than at the last launch, the light."""


class About(NamedTuple):
    """What a launch's arguments depend on besides the sector itself: while it is equal, a launch can be used again.

    lights : how many are directional; glow : what bricks send out without them, (N, 4) float32 [lx], or None
    bounce_starts, cubes : of the passes
    """

    lights: int
    snow: float
    glow: cl.Buffer | None
    sun_sample: cl.Buffer | None
    sun_share: cl.Buffer | None
    bounces: cl.Buffer | None
    bounce_starts: cl.Buffer | None
    cubes: cl.Buffer


def relight_launch(resident: "ResidentSector", about: About) -> Launch:
    """Direct light where it is asked for, then passes. Raises KernelBuildError."""
    return _in_one(resident, about) if resident.device.is_processor else _by_phase(resident, about)


def _defines(resident: "ResidentSector", about: About) -> tuple[dict[str, int], dict[str, int], dict[str, int]]:
    """Of sun_on_surfels, of light_bricks, and of the two kernels of a pass."""
    lights = {"DIRECTIONAL_LIGHTS": about.lights}
    sun = lights | {"HAS_SUN_MAP": int(about.lights > 0 and about.sun_sample is not None)}
    bricks = lights | {"HAS_GLOW": int(about.glow is not None), "HAS_SNOW": int(about.lights > 0 and about.snow > 0)}
    return sun, bricks, {"BASIS_SIZE": resident.sector.basis_size}


def _in_one(resident: "ResidentSector", about: About) -> Launch:
    r, sector = resident, resident.sector
    sun, bricks, basis = _defines(resident, about)
    task = BoundKernel(
        r.device,
        r.device.kernel("relight_sector", **(sun | bricks | basis)),
        *(np.uint32(r.groups), r.surfel_normal, r.sun_visibility, np.uint32(r.plane_bytes), about.sun_sample, about.sun_share),
        *(np.uint32(sector.brick_count), r.direct, about.glow, r.brick_starts, r.surfel_albedo, np.float32(about.snow)),
        *(np.uint32(r.sky_patches), about.bounce_starts, about.bounces, r.brick_basis, r.exitance),
        *(np.uint32(sector.probe_count), r.factor_starts, r.sky_starts, r.factor_source, r.factor_code, r.factor_scale, about.cubes),
    )

    def launch(queue: cl.CommandQueue, passes: int, is_lit_anew: bool, light: "LightOnDevice") -> None:
        task.launch_task(queue, 2 * passes + is_lit_anew, light.lights, light.patches)

    return launch


def _by_phase(resident: "ResidentSector", about: About) -> Launch:
    r, sector, shared = resident, resident.sector, resident.device.shared_kernel
    sun, bricks, basis = _defines(resident, about)
    brick_count, probe_count, stride = np.uint32(sector.brick_count), np.uint32(sector.probe_count), np.uint32(r.groups * SURFELS_PER_GROUP)
    surfels = (np.uint32(r.groups), r.surfel_normal, r.sun_visibility, np.uint32(r.plane_bytes), about.sun_sample, about.sun_share)
    lit = (brick_count, r.direct, about.glow, r.brick_starts, r.surfel_albedo, about.sun_share, stride, np.float32(about.snow))
    bounced = (about.bounce_starts, about.bounces, r.direct, about.cubes, r.brick_basis, r.exitance)
    factors = (r.factor_starts, r.sky_starts, r.factor_source, r.factor_code, r.factor_scale)

    def launch(queue: cl.CommandQueue, passes: int, is_lit_anew: bool, light: "LightOnDevice") -> None:
        if is_lit_anew and sector.brick_count:
            if about.lights:
                shared("sun_on_surfels", **sun).launch_1d(r.groups, *surfels, light.lights, queue=queue)
            shared("light_bricks", **bricks).launch_1d(sector.brick_count, *lit, light.lights, queue=queue)
        bounce, gather = shared("bounce_bricks", **basis), shared("gather_probes", **basis)
        for _ in range(passes):
            items = sector.brick_count + r.sky_patches
            bounce.launch_1d(items, brick_count, np.uint32(r.sky_patches), *bounced, light.patches, queue=queue)
            gather.launch_1d(sector.probe_count, probe_count, *factors, r.exitance, about.cubes, queue=queue)

    return launch
