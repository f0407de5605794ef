"""Between two moments' light, and how far two moments' light lie apart: what a running clock needs every tick."""

from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Float64
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.relight_input import RelightInput
from gi_core.sky_patches import level_shares
from gi_core.spectrum import LUMINANCE_FROM_RGB

# A light that turns by an angle moves the edges of shadows, which changes more than its cosine says.
_TURN_WEIGHT = 4.0


def between_lightings(first: Lighting, second: Lighting, share: float, time: str) -> Lighting:
    """The light a share 0..1 of the way from one snapshot to the next, linear in all but the lights' directions, which stay unit."""

    def light(a: DirectionalLight, b: DirectionalLight) -> DirectionalLight:
        direction = (1 - share) * a.direction + share * b.direction
        length = float(np.linalg.norm(direction))
        irradiance = (1 - share) * a.irradiance + share * b.irradiance
        # Nothing shines from below: a light that rises or sets within the step has none until it is up.
        if direction[1] <= 0 or length < 1e-6:
            return DirectionalLight(b.direction if length < 1e-6 else direction / length, np.zeros(3))
        return DirectionalLight(direction / length, irradiance)

    def number(a: float, b: float) -> float:
        return (1 - share) * a + share * b

    return Lighting(
        time=time,
        weather=second.weather if share >= 0.5 else first.weather,
        sun=light(first.sun, second.sun),
        moon=light(first.moon, second.moon),
        sky_radiance=np.float32(1 - share) * first.sky_radiance + np.float32(share) * second.sky_radiance,
        sky_cube=(1 - share) * first.sky_cube + share * second.sky_cube,
        snow=number(first.snow, second.snow),
        fog_density=number(first.fog_density, second.fog_density),
        exposure=number(first.exposure, second.exposure),
    )


@dataclass(frozen=True, eq=False)
class LightVector:
    """A moment's light as a few numbers whose differences say how much it has changed.

    numbers : (n,) float64 [lx, but for snow]; scale : about what a level surface in the open gets [lx]
    """

    numbers: Float64
    scale: float

    @classmethod
    def of(cls, given: RelightInput) -> "LightVector":
        """The vector of what relighting is given."""
        patches = given.patch_exitance.astype(np.float64) @ LUMINANCE_FROM_RGB
        beams = np.zeros((2, 3))
        level = 0.0
        for i, light in enumerate(given.lights):
            strength = float(light["irradiance"][:3].astype(np.float64) @ LUMINANCE_FROM_RGB)
            beams[i] = light["direction"][:3].astype(np.float64) * strength
            level += strength * max(float(light["direction"][1]), 0.1)
        scale = float(level_shares(given.sky, len(patches)) @ patches) + level
        return cls(np.concatenate([patches / len(patches), _TURN_WEIGHT * beams.reshape(-1), [given.snow * scale]]), scale)


def relative_changes(before: Float64, scale_before: Float64, now: LightVector) -> Float64:
    """(s,): how much the light has changed since each of some vectors (s, n) of scales (s,), as a share of the greater of the two."""
    distance = np.abs(before - now.numbers).sum(axis=1)
    return np.asarray(distance / np.maximum(np.maximum(scale_before, now.scale), 1e-12))
