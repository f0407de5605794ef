"""The lights under which placement and voxel weights are tried out: suns from all sides, two skies, and the lamps where there are any.

Interpolation is linear in the light, so what fits a handful of unlike states fits their mixtures. Two suns between the others are held
out: no probe is placed and no weight fitted for them, and they tell what the bake expects of suns that it did not try.
"""

from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Float32, Float64

FITTED_SUNS, HELD_OUT_SUNS = 5, 2
LOWEST_SUN = 0.05  # sine of the elevation: about 3 degrees
# Illuminance in units of 100 klx, after clear skies of all sun heights: a beam that air dims, and a sky that a low sun lights less.
BEAM, AIR = 1.3, 0.22
SKY_AT_HORIZON, SKY_AT_ZENITH = 0.04, 0.11
# How much brighter the sky is towards the sun than away from it, over how wide a patch (a power of the half-angle's cosine).
GLOW, GLOW_POWER = 3.0, 6


@dataclass(frozen=True, eq=False)
class TrialStates:
    """S states of luminance; the last ``held_out`` of them are for judging only. A lamps' state follows the skies where it is wanted.

    sun_direction : (n, 3) float64, unit, world frame; sun_irradiance : (n, S) float32, of a surface that faces it
    sky_of : (S,) int64, index of the sun that the sky glows around, -1 uniform, -2 CIE overcast, -3 black
    sky_level : (S,) float32, irradiance of level ground from the whole sky
    lamps : (S,) bool, states lit by lamps and emission
    """

    sun_direction: Float64
    sun_irradiance: Float32
    sky_of: tuple[int, ...]
    sky_level: Float32
    lamps: tuple[bool, ...]
    held_out: int

    @property
    def count(self) -> int:
        return len(self.sky_of)

    @property
    def fitted(self) -> slice:
        return slice(0, self.count - self.held_out)

    @property
    def judged(self) -> slice:
        """The held-out states; the fitted ones where none is held out."""
        return slice(self.count - self.held_out if self.held_out else 0, self.count)

    def without_held_out(self) -> "TrialStates":
        """The fitted states alone, and their suns."""
        suns = slice(0, len(self.sun_direction) - self.held_out)
        of_suns, states = self.sun_irradiance[suns, self.fitted], self.fitted
        return TrialStates(self.sun_direction[suns], of_suns, self.sky_of[states], self.sky_level[states], self.lamps[states], 0)

    def sky_radiance(self, directions: Float32) -> Float32:
        """(n, S): what the sky sends along unit directions (n, 3) in each state; 0 from below the horizon."""
        up = np.maximum(directions[:, 1], 0)
        above = (directions[:, 1] > 0).astype(np.float64)
        columns = []
        for which, level in zip(self.sky_of, self.sky_level, strict=True):
            if which == -3:
                columns.append(np.zeros(len(directions)))
            elif which == -2:
                columns.append(level / np.pi * above * (1 + 2 * up) * 3 / 7)
            elif which == -1:
                columns.append(level / np.pi * above)
            else:
                towards = (1 + directions @ self.sun_direction[which]) / 2
                columns.append(level / np.pi * above * (0.7 + GLOW * towards**GLOW_POWER))
        return np.stack(columns, axis=1).astype(np.float32)


def trial_states(sun_directions: Float64, with_lamps: bool) -> TrialStates:
    """States for a place whose sun stands along some of ``sun_directions`` (D, 3), unit, world frame."""
    suns = _spread(sun_directions[sun_directions[:, 1] > LOWEST_SUN], FITTED_SUNS + HELD_OUT_SUNS)
    held = max(0, min(HELD_OUT_SUNS, len(suns) - FITTED_SUNS))
    fitted = len(suns) - held
    of_state = [*range(fitted), -1, -2, *([-3] if with_lamps else []), *range(fitted, len(suns))]
    height = suns[:, 1]
    beam = BEAM * np.exp(-AIR / height)
    sky = SKY_AT_HORIZON + SKY_AT_ZENITH * height
    irradiance = np.zeros((len(suns), len(of_state)), np.float32)
    for state, sun in enumerate(of_state):
        if sun >= 0:
            irradiance[sun, state] = beam[sun]
    level = np.array([sky[sun] if sun >= 0 else 0.2 if sun != -3 else 0.0 for sun in of_state], np.float32)
    return TrialStates(suns, irradiance, tuple(of_state), level, tuple(sun == -3 for sun in of_state), held)


def _spread(directions: Float64, count: int) -> Float64:
    """The highest of the directions, then each time that farthest from those chosen: every prefix is spread over all of them."""
    if len(directions) == 0:
        return np.empty((0, 3))
    chosen = [int(np.argmax(directions[:, 1]))]
    while len(chosen) < min(count, len(directions)):
        closest = (directions @ directions[chosen].T).max(axis=1)
        # To nine digits: mirror images must not be told apart by rounding.
        chosen.append(int(np.argmin(np.round(closest, 9))))
    return directions[chosen]
