"""What lies behind a picture: false colours of surfaces, and probes as little spheres (``view=``). One table names them."""

import colorsys
from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np

from gi_core import ambient_cube
from gi_core.arrays import Float32, Float64, Int64, UInt8
from gi_core.client_light import SAMPLE_OFFSET_M, Look, ServedLight, plan_volumes
from gi_core.constants import ROOM_OUTDOORS, SECTOR_SIZE_M, VOXEL_INDOORS, VOXEL_NO_SECTOR, VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.engine import Engine, LitProbes
from gi_core.errors import OutsideWorldError
from gi_core.grid import SectorIndex
from gi_core.lighting import Lighting
from gi_core.snow import snow_attribute
from server import preview_surfels, tonemap
from server.camera import Camera
from server.labels import with_key
from server.live_state import Residency
from server.preview import STRAIGHT_UP, city_radiance
from server.preview_scene import PreviewScene
from server.preview_seen import NO_SURFACE, Seen

ViewName = Literal[
    "probes",
    "rooms",
    "albedo",
    "normal",
    "snow",
    "sun",
    "surfel_albedo",
    "surfel_normal",
    "surfel_snow",
    "surfel_sun",
    "voxels",
    "sectors",
    "residency",
]

PROBE_RADIUS_M, PROBE_REACH_M = 0.25, 60.0
# Of the spheres that show probes' light.
PROBE_ALBEDO = 0.8
OUTDOORS_COLOUR = (235, 235, 235)
VOXEL_COLOURS = {
    VOXEL_SOLID: ((200, 60, 50), "solid"),
    VOXEL_OUTDOORS: ((90, 160, 90), "outdoors"),
    VOXEL_INDOORS: ((70, 110, 200), "indoors"),
    VOXEL_NO_SECTOR: ((150, 150, 150), "no sector"),
}
SECTOR_COLOURS = np.array([[[110, 150, 200], [225, 205, 130]], [[200, 130, 110], [140, 185, 130]]], np.uint8)  # z even or odd, x
# Lines between sectors.
SEAM_M, SEAM_COLOUR = 0.5, (30, 30, 30)
RESIDENCY_COLOURS: dict[Residency, tuple[int, int, int]] = {
    "read by a player": (225, 205, 130),
    "resident": (120, 180, 120),
    "failed": (200, 60, 50),
    "not resident": (110, 110, 120),
}
SUN_COLOURS = {"lit": (255, 225, 130), "shadow": (70, 90, 150), "turned away": (45, 45, 60)}


def draw(
    view: ViewName,
    engine: Engine,
    scene: PreviewScene,
    camera: Camera,
    lighting: Lighting,
    residency: Mapping[SectorIndex, Residency] | None = None,
) -> UInt8:
    """(height, width, 3) uint8 sRGB. ``residency``: of sectors in the live world. Raises CorruptFileError."""
    if scene.rays is None:
        return np.full((camera.height, camera.width, 3), NO_SURFACE, np.uint8)
    surface = scene.rays.first_surface(camera.eye, camera.rays())
    return VIEWS[view](Seen(engine, scene, camera, lighting, surface, residency or {}))


def albedo(seen: Seen) -> UInt8:
    """Albedo, without snow."""
    return seen.picture(tonemap.srgb_bytes(seen.scene.albedo[seen.surface.triangle[seen.surface.hit]]))


def normal(seen: Seen) -> UInt8:
    """Normals: x, y, z of -1..1 as red, green, blue."""
    return seen.picture(np.asarray(seen.normal * 127.5 + 128).clip(0, 255).astype(np.uint8))


def snow(seen: Seen) -> UInt8:
    """How much of the snow that falls would stay, black to white, whatever the weather."""
    stays = snow_attribute(seen.normal, lambda flat: seen.reached(STRAIGHT_UP, flat))
    return seen.picture(np.repeat(np.asarray(stays * 255 + 0.5).astype(np.uint8)[:, None], 3, axis=1))


def sun(seen: Seen) -> UInt8:
    """What the sun reaches, or the moon while there is no sun."""
    lights = seen.lighting.directional_lights
    colours = np.full((int(seen.surface.hit.sum()), 3), SUN_COLOURS["turned away"], np.uint8)
    if lights:
        facing = seen.normal @ lights[0].direction.astype(np.float32) > 0
        colours[facing] = SUN_COLOURS["shadow"]
        colours[seen.reached(lights[0].direction)] = SUN_COLOURS["lit"]
    return with_key(seen.picture(seen.shaded(colours)), SUN_COLOURS)


def sectors(seen: Seen) -> UInt8:
    """A checkerboard of sectors, with lines between them."""
    x, z = np.floor(seen.position[:, [0, 2]] / SECTOR_SIZE_M).astype(np.int64).T
    return seen.picture(seen.shaded(_with_lines(seen, SECTOR_COLOURS[z % 2, x % 2])))


def residency(seen: Seen) -> UInt8:
    """Which sectors the live world holds: those that players' volumes read, others, those that cannot be loaded, and none."""
    place = np.floor(seen.position[:, [0, 2]] / SECTOR_SIZE_M).astype(np.int64)
    each, which = np.unique(place, axis=0, return_inverse=True)
    of_each = [RESIDENCY_COLOURS[seen.residency.get(SectorIndex(x, z), "not resident")] for x, z in each.tolist()]
    colours = np.array(of_each, np.uint8).reshape(-1, 3)[which.reshape(-1)]
    return with_key(
        seen.picture(seen.shaded(_with_lines(seen, colours))), {str(word): colour for word, colour in RESIDENCY_COLOURS.items()}
    )


def _with_lines(seen: Seen, colours: UInt8) -> UInt8:
    """Colours (k, 3) of pixels that show a surface, with lines between sectors."""
    place = seen.position[:, [0, 2]] / SECTOR_SIZE_M
    colours[(np.abs(place - np.round(place)) * SECTOR_SIZE_M < SEAM_M / 2).any(axis=1)] = SEAM_COLOUR
    return colours


def voxels(seen: Seen) -> UInt8:
    """The class of the voxel that a client reads first: the one a quarter voxel in front of the surface. Solid ones hold filled light."""
    served = ServedLight.of(seen.engine, seen.lighting, Look(distant="off"), seen.camera.eye)
    points = seen.position + SAMPLE_OFFSET_M * seen.normal
    classes = np.full(len(points), VOXEL_NO_SECTOR, np.uint8)
    if len(points):
        centres, which = plan_volumes(points)
        for number, centre in enumerate(centres):
            some, volume = np.flatnonzero(which == number), served.volume_at(centre, ROOM_OUTDOORS)
            at = np.round((points[some] - volume.origin) / VOXEL_SIZE_M).astype(np.int64)
            x, y, z = np.clip(at, 0, np.array(volume.mask.shape)[[2, 0, 1]] - 1).T
            classes[some] = volume.mask[y, z, x]
    palette = np.zeros((256, 3), np.uint8)
    for voxel_class, (colour, _) in VOXEL_COLOURS.items():
        palette[voxel_class] = colour
    return with_key(seen.picture(seen.shaded(palette[classes])), {word: colour for colour, word in VOXEL_COLOURS.values()})


def probes(seen: Seen) -> UInt8:
    """The lit picture, and probes within PROBE_REACH_M as spheres that show their light on all sides."""
    radiance = city_radiance(seen.engine, seen.scene, seen.camera, seen.lighting)
    ev100 = tonemap.metered(radiance, seen.lighting.exposure)
    found = near_probes(seen)
    if found is not None:
        for pixels, number, normals in sphere_pixels(seen, found.position):
            light = ambient_cube.evaluate(np.broadcast_to(found.cubes[number], (len(pixels), 6, 3)), normals)
            radiance.reshape(-1, 3)[pixels] = light * np.float32(PROBE_ALBEDO / np.pi)
    return tonemap.developed(radiance, ev100)


def rooms(seen: Seen) -> UInt8:
    """Probes within PROBE_REACH_M in their room's colour, light grey outdoors, among grey surfaces."""
    grey = np.full((int(seen.surface.hit.sum()), 3), 110, np.uint8)
    picture = seen.picture(seen.shaded(grey))
    found = near_probes(seen)
    if found is not None:
        for pixels, number, _ in sphere_pixels(seen, found.position):
            picture.reshape(-1, 3)[pixels] = room_colour(int(found.room[number]))
    return picture


def room_colour(room: int) -> tuple[int, int, int]:
    """sRGB of a room's number: hues a golden turn apart, so that neighbours differ."""
    if room == ROOM_OUTDOORS:
        return OUTDOORS_COLOUR
    red, green, blue = (round(255 * v) for v in colorsys.hsv_to_rgb(room * 0.61803398875 % 1.0, 0.75, 0.95))
    return red, green, blue


def near_probes(seen: Seen) -> LitProbes | None:
    """Probes within PROBE_REACH_M of the eye; None where the dataset has no sector."""
    low, high = seen.engine.dataset.world.bounds
    try:
        return seen.engine.probes(np.clip(seen.camera.eye, low, high), PROBE_REACH_M, seen.lighting)
    except OutsideWorldError:
        return None


def sphere_pixels(seen: Seen, centres: Float64) -> list[tuple[Int64, int, Float32]]:
    """Where spheres of PROBE_RADIUS_M at centres (n, 3) [m] are seen, far ones first: (pixel numbers, sphere, normals (m, 3))."""
    camera, found = seen.camera, []
    placed = camera.project(centres)
    directions = camera.rays()
    for number in np.argsort(-placed[:, 2], kind="stable"):
        column, row, depth = placed[number]
        if depth <= PROBE_RADIUS_M:
            break
        # A sphere off the picture's middle appears as an ellipse; its axis grows by 1 / cos at most, and pixels outside are dropped below.
        reach = 2 * PROBE_RADIUS_M / (depth * camera.pixel_size) + 1
        rows = np.arange(max(int(row - reach), 0), min(int(row + reach) + 2, camera.height))
        columns = np.arange(max(int(column - reach), 0), min(int(column + reach) + 2, camera.width))
        pixels = (rows[:, None] * camera.width + columns).ravel()
        towards = directions[pixels].astype(np.float64)
        to_centre = centres[number] - camera.eye
        along = towards @ to_centre
        inside = PROBE_RADIUS_M**2 - (to_centre @ to_centre - along**2)
        met = along - np.sqrt(np.maximum(inside, 0))
        visible = (inside > 0) & (met < seen.surface.distance[pixels])
        normals = (met[visible, None] * towards[visible] - to_centre) / PROBE_RADIUS_M
        found.append((pixels[visible], int(number), normals.astype(np.float32)))
    return found


VIEWS: dict[ViewName, Callable[[Seen], UInt8]] = {
    "probes": probes,
    "rooms": rooms,
    "albedo": albedo,
    "normal": normal,
    "snow": snow,
    "sun": sun,
    "surfel_albedo": preview_surfels.albedo,
    "surfel_normal": preview_surfels.normal,
    "surfel_snow": preview_surfels.snow,
    "surfel_sun": preview_surfels.sun,
    "voxels": voxels,
    "sectors": sectors,
    "residency": residency,
}
