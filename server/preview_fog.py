"""Fog in a picture, marched through the light: shafts where the sun comes through, dusk in streets that see little sky.

``preview_air.through_fog`` is right in the open, where fog is lit alike everywhere. Here its light is put right for what stands around:

    added = integral over the way of k exp(-k s) (J(s) - J_open) ds          k: fog_density [m^-1], s: distance from the eye [m]

    J / J_open = (A + sum of V_i p_i E_i) / (A_open + sum of p_i E_i),       J_open: the sky's mean radiance
        A    the served volume's mean over directions / pi                   A_open: that of an open plain
        V_i  1 where a shadow ray reaches sun or moon, 0 elsewhere           p_i E_i: their irradiance times the aerosol's phase function

So in an open plain nothing is added, whatever the number of steps, nor outside the box of the loaded geometry: the way is the part of the
ray inside, up to the surface. Beyond the volumes, 64 at most, it fades to nothing: the distant texture knows streets, not air.

It is marched for one ray per block of pixels, at STEPS places that are spread by transmittance and shifted from block to block in a fixed
pattern; a pixel takes the mean of blocks around it that end at about its own distance.

Left out: what lamps give fog directly, and that fog dims the sun's rays on their last metres (``Lighting`` has them dimmed already).
"""

import numpy as np

from gi_core.arrays import Float32, Float64, Int64
from gi_core.client_light import ServedLight
from gi_core.lighting import Lighting
from gi_core.phase import aerosol_phase
from server.camera import Camera
from server.preview_air import mean_sky, open_ground_radiance
from server.raycast import RayCaster

Taps = list[tuple[Int64, Float64]]

# Edge of a block [pixels]: shafts are soft, and rays for each pixel would cost sixteen times as much.
BLOCK = 4
STEPS = 8
# A pixel takes the mean of this many blocks by this many: a whole period of PATTERN, whose shifts then cancel.
PERIOD = 4
# Shifts of neighbouring blocks' steps: a 4 x 4 ordered dither (Bayer 1973).
PATTERN = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
# Blocks that end this much nearer or farther [share] count little for a pixel.
DEPTH_TOLERANCE = 0.1
# Of what is farther than this, in units of 1 / k, fog lets 2 % through.
FARTHEST = 4.0


def add_fog_light(radiance: Float32, camera: Camera, rays: RayCaster, served: ServedLight, lighting: Lighting, distance: Float64) -> None:
    """Add to radiance (height * width, 3) [cd m^-2], in place, what the light around does to fog.

    distance : (height * width,) [m] to each pixel's surface, inf for the sky
    """
    if lighting.fog_density == 0:
        return
    shape = (camera.height, camera.width)
    middles = [np.minimum(np.arange(0, size, BLOCK) + BLOCK // 2, size - 1) for size in shape]
    directions = camera.rays()
    starts, ends = way(rays, camera.eye, directions, np.minimum(distance, FARTHEST / lighting.fog_density))
    chosen = (middles[0][:, None] * camera.width + middles[1]).ravel()
    shift = (PATTERN[np.ix_(np.arange(len(middles[0])) % 4, np.arange(len(middles[1])) % 4)].ravel() + 0.5) / PATTERN.size
    found = marched(camera.eye, directions[chosen], starts[chosen], ends[chosen], shift, rays, served, lighting)
    blocks = (len(middles[0]), len(middles[1]))
    spread = spread_blocks(found.reshape(*blocks, 3), ends[chosen].reshape(blocks), ends.reshape(shape))
    np.maximum(radiance + spread.reshape(-1, 3), 0, out=radiance)


def way(rays: RayCaster, eye: Float64, directions: Float32, distance: Float64) -> tuple[Float64, Float64]:
    """From where to where rays (n, 3) from an eye (3,) [m] are in the box of all triangles, at most ``distance`` (n,) [m] far.

    Two of (n,) [m]; the same where a ray misses the box.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = [(bound - eye) / directions.astype(np.float64) for bound in (rays.low, rays.high)]
    # Along a ray within a side's own plane 0 / 0 is no bound.
    enter, leave = np.nanmax(np.minimum(*sides), axis=1), np.nanmin(np.maximum(*sides), axis=1)
    start = np.clip(enter, 0, distance)
    return start, np.maximum(start, np.minimum(leave, distance))


def marched(
    eye: Float64,
    directions: Float32,
    starts: Float64,
    ends: Float64,
    shift: Float64,
    rays: RayCaster,
    served: ServedLight,
    lighting: Lighting,
) -> Float32:
    """What is added along rays (n, 3) between ``starts`` and ``ends`` (n,) [m], their steps shifted by 0..1 (n,) of a step: (n, 3)
    [cd m^-2]."""
    density = lighting.fog_density
    first = np.exp(-density * starts)
    lost = -first * np.expm1(-density * (ends - starts))
    share = (np.arange(STEPS) + shift[:, None]) / STEPS
    places = starts[:, None] - np.log1p(-share * (lost / first)[:, None]) / density
    points = (eye + places[..., None] * directions[:, None]).reshape(-1, 3)
    mean, known = served.mean_irradiance(points)
    light = mean.reshape(len(starts), STEPS, 3) / np.pi
    in_the_open = open_mean_radiance(lighting)[None].repeat(len(starts), axis=0)
    for source in lighting.directional_lights:
        arrives = rays.lit(points, source.direction.astype(np.float32)[None].repeat(len(points), axis=0), source.direction)
        scattered = aerosol_phase(directions @ source.direction)[:, None] * source.irradiance
        light += arrives.reshape(len(starts), STEPS, 1) * scattered[:, None]
        in_the_open += scattered
    change = (light / np.maximum(in_the_open, 1e-30)[:, None] - 1) * known.reshape(len(starts), STEPS, 1)
    return np.asarray(lost[:, None] * mean_sky(lighting) * change.mean(axis=1), np.float32)


def open_mean_radiance(lighting: Lighting) -> Float64:
    """(3,) [cd m^-2]: the mean over all directions in an open plain, as a volume's six faces have it: their mean / pi."""
    # A uniform ground of radiance L gives pi L on the face that looks down, half of it on the four sides.
    return np.asarray(lighting.sky_cube.mean(axis=0) / np.pi + open_ground_radiance(lighting) / 2, np.float64)


def spread_blocks(found: Float32, depth: Float64, pixel_depth: Float64) -> Float32:
    """Blocks (r, c, 3) whose rays end at ``depth`` (r, c) [m] -> pixels (height, width, 3) that end at theirs (height, width) [m].

    First each block takes the mean of a period of the pattern around it, then each pixel one of the four blocks around it; both count by
    how alike the depths are.
    """
    # Half of either end, so that every shift of the pattern counts alike.
    taps = [(step, 0.5 if abs(step) == PERIOD // 2 else 1.0) for step in range(-PERIOD // 2, PERIOD // 2 + 1)]
    down, across = ([(np.arange(size) + step, np.full(size, weight)) for step, weight in taps] for size in depth.shape)
    smooth = _mean_of_alike(found, depth, depth, down, across)
    return _mean_of_alike(smooth, depth, pixel_depth, _bilinear(pixel_depth.shape[0]), _bilinear(pixel_depth.shape[1]))


def _bilinear(size: int) -> Taps:
    """Along one axis, the two blocks around each pixel and their weights."""
    at = (np.arange(size) - BLOCK // 2) / BLOCK
    first = np.floor(at).astype(np.int64)
    return [(first, 1 - (at - first)), (first + 1, at - first)]


def _mean_of_alike(found: Float32, depth: Float64, depth_here: Float64, down: Taps, across: Taps) -> Float32:
    """Weighted means of blocks (r, c, 3): (height, width, 3). A tap: for each row, or column, a block's and what it counts."""
    total, weights = np.zeros((*depth_here.shape, 3), np.float32), np.zeros(depth_here.shape, np.float32)
    log_here, log_depth = (np.log(np.maximum(d, 1e-3)).astype(np.float32) for d in (depth_here, depth))
    for row, row_weight in down:
        for column, column_weight in across:
            block = np.ix_(np.clip(row, 0, len(depth) - 1), np.clip(column, 0, depth.shape[1] - 1))
            # The last term: where no block is alike, all are.
            alike = np.exp(np.abs(log_depth[block] - log_here) * np.float32(-1 / DEPTH_TOLERANCE)) + np.float32(1e-4)
            weight = np.multiply.outer(row_weight, column_weight).astype(np.float32) * alike
            total += weight[..., None] * found[block]
            weights += weight
    return np.asarray(total / weights[..., None], np.float32)
