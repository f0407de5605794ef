"""The artists' panel (slide "Ease of use"): ten numbers and colours, each with a physical meaning and a neutral default.

Light transport is linear, so gains on the sources are gains on what they give, and none of them touches the loop of bounces: no
setting can make it diverge. The bounce gain acts on the sum of all bounces after it has converged.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from gi_core.arrays import Float32, UInt16
from gi_core.basis import basis_of_size, from_axes
from gi_core.constants import ROOM_OUTDOORS
from gi_core.errors import InputError
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.lights import MAX_LUMENS
from gi_core.world import Lamp

# Beyond this a picture is white whatever the scene; float32 holds noon times this with room to spare.
MAX_FACTOR = 100.0
MAX_AMBIENT_LX = 1e6
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Settings:
    """The panel. Every default is neutral: it changes no byte of the answer.

    bounce_factor : gain on light that has met two surfaces or more [1]; 0 shows the first bounce alone
    sky_factor : gain on the sky's light, bounced light of it included [1]
    sun_factor : gain on sun and moon, likewise [1]
    lights_factor : gain on lamps, likewise [1]
    sky_boost : uniform radiance added to the sky above the horizon, per channel [cd m^-2]; lifts places that see little of it
    ambient_factor : gain on the two ambient colours [1]
    ambient_up, ambient_down : irradiance added on faces that look up and down, sides take their mean [lx]; no surface casts or stops it
    exterior_ambient_scale, interior_ambient_scale : gain on the ambient colours outdoors, and in rooms [1]
    """

    bounce_factor: float = 1.0
    sky_factor: float = 1.0
    sun_factor: float = 1.0
    lights_factor: float = 1.0
    sky_boost: Color = (0.0, 0.0, 0.0)
    ambient_factor: float = 1.0
    ambient_up: Color = (0.0, 0.0, 0.0)
    ambient_down: Color = (0.0, 0.0, 0.0)
    exterior_ambient_scale: float = 1.0
    interior_ambient_scale: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            numbers, most = (value, MAX_AMBIENT_LX) if isinstance(value, tuple) else ((value,), MAX_FACTOR)
            if len(numbers) not in (1, 3) or not all(math.isfinite(n) and 0 <= n <= most for n in numbers):
                what = "three numbers" if isinstance(value, tuple) else "a number"
                raise InputError(f"settings: {field.name}: expected {what} from 0 to {most:g}, got {value}")

    def light(self, lighting: Lighting) -> Lighting:
        """A snapshot with the sources' gains and the sky boost applied."""
        if (self.sky_factor, self.sun_factor, *self.sky_boost) == (1.0, 1.0, 0.0, 0.0, 0.0):
            return lighting

        def dimmed(light: DirectionalLight) -> DirectionalLight:
            return replace(light, irradiance=light.irradiance * self.sun_factor)

        boost = np.array(self.sky_boost)
        sky = lighting.sky_radiance * np.float32(self.sky_factor)
        upper = len(sky) // 2
        sky[:upper] += boost.astype(np.float32)
        # A uniform sky of radiance L gives pi L from above, half of it on the sides, nothing from below.
        seen = np.pi * np.array([0.5, 0.5, 1.0, 0.0, 0.5, 0.5])[:, None]
        cube = lighting.sky_cube * self.sky_factor + seen * boost
        return replace(lighting, sun=dimmed(lighting.sun), moon=dimmed(lighting.moon), sky_radiance=sky, sky_cube=cube)

    def brightened(self, lamps: tuple[Lamp, ...]) -> tuple[Lamp, ...]:
        """Lamps with their gain applied, up to the most that a lamp may give; those that give nothing are left out."""
        if self.lights_factor == 1.0:
            return lamps
        gain = self.lights_factor
        return tuple(replace(lamp, lumens=min(lamp.lumens * gain, MAX_LUMENS)) for lamp in lamps if gain > 0)

    @property
    def has_ambient(self) -> bool:
        """Whether the ambient colours add anything."""
        return self.ambient_factor > 0 and any((*self.ambient_up, *self.ambient_down))

    @property
    def ambient_cubes(self) -> Float32:
        """(2, 6, 3) float32 [lx]: what the ambient colours add to probes outdoors, and in rooms."""
        up, down = (np.array(c) * self.ambient_factor for c in (self.ambient_up, self.ambient_down))
        side = (up + down) / 2
        ambient = np.stack([side, side, up, down, side, side]).astype(np.float32)
        return np.array([self.exterior_ambient_scale, self.interior_ambient_scale], np.float32)[:, None, None] * ambient

    def ambient(self, basis: str) -> Float32:
        """(2, B, 3) float32 [lx]: ``ambient_cubes`` in a basis; harmonics hold what lies between up, down and their mean exactly."""
        return self.ambient_cubes if basis == "cube" else np.asarray(from_axes(basis) @ self.ambient_cubes, np.float32)

    def cubes(self, first_bounce: Float32, converged: Float32, room: UInt16) -> Float32:
        """Probes' light (P, B, 3) [lx] from that with one bounce and with all, and each probe's room (P,)."""
        cubes = converged
        if self.bounce_factor != 1.0:
            cubes = first_bounce + np.float32(self.bounce_factor) * (converged - first_bounce)
        if self.has_ambient:
            cubes = cubes + self.ambient(basis_of_size(cubes.shape[1]))[(room != ROOM_OUTDOORS).astype(np.intp)]
        return cubes


NEUTRAL = Settings()
