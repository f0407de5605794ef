"""Snow on the ground: it builds up while snow falls, melts by warmth and rain, and covers the ground the more the deeper it is.

The state is one number, the water that the snow holds [mm]. Between two moments of constant weather it grows or shrinks at a constant
rate and stops at 0 and at a deepest pack, so ``step`` is exact: two steps of an hour give what one of two hours gives.
"""

import math
from dataclasses import dataclass

from gi_core.errors import InputError

# Degree-day melt: 3 to 5 mm a day for every kelvin of warm air over open ground, its sunshine included. Hock, J. Hydrology 282, 2003.
MELT_MM_PER_K_DAY = 4.0
# Rain at temperature T brings the heat to melt c T / L of its own mass: 4.19 kJ/(kg K) / 334 kJ/kg.
RAIN_MELT_PER_K = 0.0125
# Precipitation falls as snow below the first and as rain above the second: Auer, Weatherwise 27, 1974; half and half near 1 C.
ALL_SNOW_BELOW_C, ALL_RAIN_ABOVE_C = -1.0, 3.0
# 4 mm of water, some 4 cm of new snow, hide the ground but for a share of 1/e.
HIDING_MM = 4.0
DEEPEST_MM = 300.0
# Beyond these there is no weather, and products of rates would leave the numbers that a computer has.
WETTEST_MM_H, HOTTEST_C = 1e4, 1e3
# Of new snow on level ground: 100 kg/m3, so 1 cm of it is 1 mm of water. Settled snow is denser, and hides no less.
WATER_MM_PER_SNOW_CM = 1.0


@dataclass(frozen=True)
class SnowRates:
    """What builds and melts snow, in one spell of constant weather; both at least 0 [mm of water an hour]."""

    build_mm_h: float
    melt_mm_h: float


def snow_rates(precipitation_mm_h: float, temperature_c: float) -> SnowRates:
    """Rates under precipitation (rain and snow together, as water) at an air temperature; continuous in both.

    Raises InputError for what is no number, for negative precipitation, and for what no weather reaches.
    """
    if not (0 <= precipitation_mm_h <= WETTEST_MM_H and -HOTTEST_C <= temperature_c <= HOTTEST_C):
        raise InputError(
            f"snow: expected precipitation of 0..{WETTEST_MM_H:g} mm/h and a temperature of {-HOTTEST_C:g}..{HOTTEST_C:g} C, "
            f"got {precipitation_mm_h}, {temperature_c}"
        )
    share = min(max((ALL_RAIN_ABOVE_C - temperature_c) / (ALL_RAIN_ABOVE_C - ALL_SNOW_BELOW_C), 0.0), 1.0)
    warmth = max(temperature_c, 0.0)
    rain = (1 - share) * precipitation_mm_h
    return SnowRates(share * precipitation_mm_h, warmth * (MELT_MM_PER_K_DAY / 24 + RAIN_MELT_PER_K * rain))


def step(water_mm: float, rates: SnowRates, hours: float) -> float:
    """The pack [mm of water] after hours (0 or more) of constant rates."""
    return min(max(water_mm + (rates.build_mm_h - rates.melt_mm_h) * hours, 0.0), DEEPEST_MM)


def cover(water_mm: float) -> float:
    """Share 0..1 of the ground's snow attribute that a pack of 0 or more mm of water covers."""
    return -math.expm1(-water_mm / HIDING_MM)
