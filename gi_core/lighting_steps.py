"""How fast the light of a whole day changes, and that it nowhere jumps: ``python -m gi_core.lighting_steps``.

The day is cut into stretches until each is either a second long or smooth: the light in its middle is the mean of that at its ends. A
jump of more than twice the tolerance is no such mean, so it is cut down to the second in which it happens, and shows there.
"""

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from gi_core.arrays import Float64
from gi_core.lighting import Lighting
from gi_core.lighting_model import make_lighting
from gi_core.lighting_table import illuminance
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.sun import moon_position, sun_position
from gi_core.weather import Weather
from gi_core.world import Location

# A tenth of what the eye tells apart (Weber's fraction of light, 2 %).
TOLERANCE = 0.002
_STRETCH_S = 120
_LIT_FACES = [0, 1, 2, 4, 5]  # none from below
QUANTITIES = ("illuminance", "sky cube", "sun", "moon", "sun's direction")

# The equator, where they rise fastest, on the day of a full moon: both lights cross the horizon near each other.
FASTEST_PLACE = Location(0.0, 0.0, 0.0, "UTC", source="given")
FASTEST_DAY = datetime(2024, 3, 25, tzinfo=UTC)


@dataclass(frozen=True)
class Step:
    """The greatest change of a quantity in a second of a day.

    per_second : share of itself for illuminance and the sky cube's fastest face; change of a beam's irradiance as a share of the
        ground's illuminance for sun and moon; degrees for the direction
    moment, sun_elevation, moon_elevation : when, and where they stood [degrees]
    """

    quantity: str
    per_second: float
    moment: datetime
    sun_elevation: float
    moon_elevation: float


def largest_steps(place: Location, start: datetime, hours: float, weather: Weather | str = "clear") -> list[Step]:
    """The greatest step of each quantity from an aware moment on, to the second, unless TOLERANCE hides it."""
    known: dict[int, Float64] = {}

    def at(second: int) -> Float64:
        if second not in known:
            known[second] = _measured(make_lighting(place, start + timedelta(seconds=second), weather))
        return known[second]

    fastest, when = np.zeros(len(QUANTITIES)), [0] * len(QUANTITIES)
    end = round(hours * 3600)
    stretches = [(second, min(second + _STRETCH_S, end)) for second in range(0, end, _STRETCH_S)]
    while stretches:
        low, high = stretches.pop()
        middle = (low + high) // 2
        change = _changes(at(low), at(high)) / (high - low)
        if middle > low:
            uneven = np.abs(_changes(at(low), at(middle)) / (middle - low) - _changes(at(middle), at(high)) / (high - middle))
            if uneven[:4].max() * (high - low) / 4 > TOLERANCE:
                stretches += [(low, middle), (middle, high)]
                continue
        for number in np.flatnonzero(change > fastest).tolist():
            fastest[number], when[number] = change[number], low
    moments = [start + timedelta(seconds=second) for second in when]
    return [
        Step(name, float(size), moment, sun_position(place, moment).elevation_degrees, moon_position(place, moment).elevation_degrees)
        for name, size, moment in zip(QUANTITIES, fastest, moments, strict=True)
    ]


def _measured(light: Lighting) -> Float64:
    """(12,): logarithms of the illuminance and of five faces; sun, moon; the sun's direction; the illuminance."""
    ground = illuminance(light)
    faces = np.log(light.sky_cube[_LIT_FACES] @ LUMINANCE_FROM_RGB)
    beams = [float(LUMINANCE_FROM_RGB @ lamp.irradiance) for lamp in (light.sun, light.moon)]
    return np.array([math.log(ground), *faces, *beams, *light.sun.direction, ground])


def _changes(before: Float64, after: Float64) -> Float64:
    """(5,): from one moment to another, as in QUANTITIES."""
    difference = np.abs(after - before)
    ground = min(before[-1], after[-1])
    turn = math.degrees(2 * math.asin(min(float(np.linalg.norm(difference[8:11])) / 2, 1.0)))
    return np.array([difference[0], difference[1:6].max(), difference[6] / ground, difference[7] / ground, turn])


def main() -> None:
    """Print the fastest day's steps as Markdown."""
    print("| largest change in a second | | time | sun's, moon's elevation |\n|---|---|---|---|")
    for step in largest_steps(FASTEST_PLACE, FASTEST_DAY, 24.0):
        size = f"{step.per_second:.4f} degrees" if step.quantity.endswith("direction") else f"{100 * step.per_second:.2g} %"
        print(f"| {step.quantity} | {size} | {step.moment:%H:%M:%S} | {step.sun_elevation:.1f}, {step.moon_elevation:.1f} |")


if __name__ == "__main__":
    main()
