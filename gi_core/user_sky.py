"""A sky of one's own in place of the model's: a whole equirectangular picture, brought to the map that a lighting holds."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from gi_core.arrays import Float32, Float64
from gi_core.constants import SKY_SHAPE
from gi_core.errors import InputError
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.lighting_model import exposure_value
from gi_core.sky import ROWS, cube_of_sky, horizontal_illuminance
from gi_core.sky_image import read_image
from gi_core.spectrum import LUMINANCE_FROM_RGB

MOST_LUX = 1e7  # a hundred suns
LEAST_LUX = 1e-9  # a millionth of a moonless night; far less is 0 in float32, and darkness has no exposure


@dataclass(frozen=True, eq=False)
class UserSky:
    """A sky ready to light with; made by ``user_sky`` or ``sky_of_image``.

    radiance : (64, 128, 3) float32 [cd m^-2 per channel], as in Lighting; zero below the horizon, where the ground is geometry
    illuminance_lx : of open level ground
    below_horizon : share 0..1 of the picture's light (luminance times solid angle) that lay below the horizon and was left out
    holds_sun : whether the picture holds the sun itself; the model's sun and moon then give nothing
    """

    radiance: Float32
    illuminance_lx: float
    below_horizon: float
    holds_sun: bool = False


def user_sky(
    path: Path | str, north_degrees: float = 0.0, centre_azimuth_degrees: float = 0.0, illuminance_lx: float | None = None
) -> UserSky:
    """The sky in an .exr or .hdr file; see ``sky_of_image``. Raises InputError."""
    return sky_of_image(read_image(path), north_degrees, centre_azimuth_degrees, illuminance_lx, Path(path).name)


def sky_of_image(
    image: Float32, north_degrees: float, centre_azimuth_degrees: float, illuminance_lx: float | None = None, where: str = "sky"
) -> UserSky:
    """A picture of the whole sphere, averaged over each texel's solid angle: no light above the horizon is lost or made.

    Parameters
    ----------
    image : (n, 2 n, 3), linear sRGB, cd/m2 per channel or any unit in proportion; top row at the zenith, to the right is clockwise
    north_degrees : compass azimuth of the world's -Z axis (Location.north_degrees)
    centre_azimuth_degrees : compass azimuth that the middle of the picture looks to
    illuminance_lx : what open level ground shall get; None takes the picture's numbers as cd/m2

    Negative values count as 0. Raises InputError for other shapes, values that are no numbers, and a sky without light.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.shape[0] < 2 or image.shape[1] != 2 * image.shape[0]:
        raise InputError(f"{where}: expected a picture of (n, 2 n, 3), got {image.shape}")
    if not (math.isfinite(north_degrees) and math.isfinite(centre_azimuth_degrees)):
        raise InputError(f"{where}: expected azimuths as numbers of degrees, got {north_degrees} and {centre_azimuth_degrees}")
    if not np.isfinite(image).all():
        raise InputError(f"{where}: expected numbers, found {int((~np.isfinite(image)).any(axis=2).sum())} pixels with infinity or NaN")
    rows, columns = image.shape[:2]
    by_row = np.maximum(image, 0).reshape(rows, -1)
    level = (_row_means(rows) @ by_row).reshape(SKY_SHAPE[0], columns, 3)
    # The world's column 0 looks along +X, 90 degrees clockwise of -Z; the picture's left edge 180 degrees before its middle.
    turn = (90.0 + north_degrees - centre_azimuth_degrees + 180.0) / 360
    whole = np.einsum("jw,iwc->ijc", _column_means(columns, turn), level)
    sky = whole[:ROWS].copy()
    found = float(LUMINANCE_FROM_RGB @ horizontal_illuminance(sky))
    if not found > 0:
        raise InputError(f"{where}: expected some light above the horizon, found none")
    if illuminance_lx is not None and not LEAST_LUX <= illuminance_lx <= MOST_LUX:
        raise InputError(f"{where}: expected an illuminance of {LEAST_LUX:g}..{MOST_LUX:g} lx, got {illuminance_lx}")
    scale = 1.0 if illuminance_lx is None else illuminance_lx / found
    if illuminance_lx is None and not LEAST_LUX <= found <= MOST_LUX:
        raise InputError(f"{where}: its {found:.3g} lx on level ground are beyond {LEAST_LUX:g}..{MOST_LUX:g}; give one to scale it to")
    solid_angle = -np.diff(np.cos(np.pi * np.arange(SKY_SHAPE[0] + 1) / SKY_SHAPE[0]))
    light = solid_angle * (whole.sum(axis=1) @ LUMINANCE_FROM_RGB)
    radiance = np.zeros((*SKY_SHAPE, 3), np.float32)
    radiance[:ROWS] = sky * scale
    radiance.flags.writeable = False
    return UserSky(radiance, found * scale, float(light[ROWS:].sum() / light.sum()))


@lru_cache(maxsize=256)
def lighting_with_sky(lighting: Lighting, sky: UserSky) -> Lighting:
    """The same moment under another sky; time, weather, snow and fog stay.

    The last few hundred results are kept, by which objects they are of: ``make_lighting`` gives the same for the same moment.
    """
    served = sky.radiance[:ROWS].astype(np.float64)
    cube = cube_of_sky(served)
    cube.flags.writeable = False
    sun, moon = (DirectionalLight(light.direction, np.zeros(3)) if sky.holds_sun else light for light in (lighting.sun, lighting.moon))
    beams = sum((light.irradiance * max(float(light.direction[1]), 0.0) for light in (sun, moon)), np.zeros(3))
    exposure = exposure_value(horizontal_illuminance(served) + beams)
    return replace(lighting, sun=sun, moon=moon, sky_radiance=sky.radiance, sky_cube=cube, exposure=exposure)


def _row_means(rows: int) -> Float64:
    """(64, rows): share of each of the map's rows that each of a picture's rows covers, by solid angle; each sums to 1."""
    ours = -np.cos(np.pi * np.arange(SKY_SHAPE[0] + 1) / SKY_SHAPE[0])
    theirs = -np.cos(np.pi * np.arange(rows + 1) / rows)
    overlap = np.minimum(ours[1:, None], theirs[1:]) - np.maximum(ours[:-1, None], theirs[:-1])
    return np.asarray(np.maximum(overlap, 0.0) / np.diff(ours)[:, None], np.float64)


def _column_means(columns: int, turn: float) -> Float64:
    """(128, columns): the same for columns, with the map's first column starting a turn (0..1) into the picture; each sums to 1."""
    ours = np.arange(SKY_SHAPE[1]) / SKY_SHAPE[1] + turn % 1.0
    theirs = np.arange(columns) / columns
    weights = np.zeros((SKY_SHAPE[1], columns))
    for around in (0.0, 1.0, 2.0):
        low = np.maximum(ours[:, None], theirs + around)
        high = np.minimum(ours[:, None] + 1 / SKY_SHAPE[1], theirs + around + 1 / columns)
        weights += np.maximum(high - low, 0.0)
    return weights * SKY_SHAPE[1]
