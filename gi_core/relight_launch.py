"""How a relight's kernels are launched over a resident sector: all in one launch on a processor, one for each phase elsewhere."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyopencl as cl

if TYPE_CHECKING:
    from gi_core.resident_sector import LightOnDevice, ResidentSector

SURFELS_PER_GROUP = 8  # of sun_on_surfels.cl: a byte of a plane's bits


class RelightTask(NamedTuple):
    """What a launch is to do.

    passes : how many; is_lit_anew : whether direct light is another than at the last launch; light : sky patches, sun and moon
    snow : 0..1, of this sector; glow : what bricks send out without sun and moon, (N, 4) float32 [lx], or None
    bounce_starts, cubes : of the passes
    """

    passes: int
    is_lit_anew: bool
    light: "LightOnDevice"
    snow: float
    glow: cl.Buffer | None
    bounce_starts: cl.Buffer | None
    cubes: cl.Buffer


def launch_relight(resident: "ResidentSector", task: RelightTask, queue: cl.CommandQueue) -> None:
    """Enqueue direct light where it is asked for, then passes. Raises KernelBuildError."""
    launch = _launch_in_one if resident.device.is_processor else _launch_by_phase
    launch(resident, task, queue)


def _defines(resident: "ResidentSector", task: RelightTask) -> tuple[dict[str, int], dict[str, int], dict[str, int]]:
    """Of sun_on_surfels, of light_bricks, and of the two kernels of a pass."""
    count = len(task.light.given.lights)
    lights = {"DIRECTIONAL_LIGHTS": count}
    sun = lights | {"HAS_SUN_MAP": int(count > 0 and resident.sun_sample is not None)}
    bricks = lights | {"HAS_GLOW": int(task.glow is not None), "HAS_SNOW": int(count > 0 and task.snow > 0)}
    return sun, bricks, {"BASIS_SIZE": resident.sector.basis_size}


def _surfels(r: "ResidentSector") -> tuple[Any, ...]:
    """What kernels read of a sector's surfels to find the sun on them."""
    return np.uint32(r.groups), r.surfel_normal, r.sun_visibility, np.uint32(r.plane_bytes), r.sun_sample, r.sun_share


def _factors(r: "ResidentSector") -> tuple[cl.Buffer, ...]:
    """What kernels gather probes by."""
    return r.factor_starts, r.sky_starts, r.factor_source, r.factor_code, r.factor_scale


def _launch_in_one(resident: "ResidentSector", task: RelightTask, queue: cl.CommandQueue) -> None:
    r, sector, light = resident, resident.sector, task.light
    sun, bricks, basis = _defines(resident, task)
    r.device.shared_kernel("relight_sector", **(sun | bricks | basis)).launch(
        (1,),
        (1,),
        *_surfels(r),
        *(np.uint32(sector.brick_count), r.direct, task.glow, r.brick_starts, r.surfel_albedo, np.float32(task.snow)),
        *(np.uint32(r.sky_patches), task.bounce_starts, r.bounces, r.brick_basis, r.exitance),
        *(np.uint32(sector.probe_count), *_factors(r), task.cubes),
        *(light.lights, light.patches),
        queue=queue,
        offset=(2 * task.passes + task.is_lit_anew,),
    )


def _launch_by_phase(resident: "ResidentSector", task: RelightTask, queue: cl.CommandQueue) -> None:
    r, sector, light, shared = resident, resident.sector, task.light, resident.device.shared_kernel
    sun, bricks, basis = _defines(resident, task)
    brick_count, probe_count, stride = np.uint32(sector.brick_count), np.uint32(sector.probe_count), np.uint32(r.groups * SURFELS_PER_GROUP)
    if task.is_lit_anew and sector.brick_count:
        if len(light.given.lights):
            shared("sun_on_surfels", **sun).launch_1d(r.groups, *_surfels(r), light.lights, queue=queue)
        lit = (brick_count, r.direct, task.glow, r.brick_starts, r.surfel_albedo, r.sun_share, stride, np.float32(task.snow))
        shared("light_bricks", **bricks).launch_1d(sector.brick_count, *lit, light.lights, queue=queue)
    bounce, gather = shared("bounce_bricks", **basis), shared("gather_probes", **basis)
    bounced = (task.bounce_starts, r.bounces, r.direct, task.cubes, r.brick_basis, r.exitance)
    for _ in range(task.passes):
        items = sector.brick_count + r.sky_patches
        bounce.launch_1d(items, brick_count, np.uint32(r.sky_patches), *bounced, light.patches, queue=queue)
        gather.launch_1d(sector.probe_count, probe_count, *_factors(r), r.exitance, task.cubes, queue=queue)
