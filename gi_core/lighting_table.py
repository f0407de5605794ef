"""Illuminance of level ground from noon to a moonless night beside what the literature gives: ``python -m gi_core.lighting_table``.

The table in MATH.md is what this prints; tests hold every row within its range.
"""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from gi_core.lighting import Lighting
from gi_core.lighting_model import make_lighting
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.sun import sun_position
from gi_core.world import Location

PLACE = Location(40.7484, -73.9857, 10.0, "UTC", source="given")
# Published curves are means over many airs, and the values at one state differ by far more between authors: a tenth either side.
SPREAD = 1.1

# New moon on 2024-06-06: it stands below the horizon with the sun. Local noon and midnight in UTC.
_NOON, _MIDNIGHT = datetime(2024, 6, 6, 17, tzinfo=UTC), datetime(2024, 6, 7, 5, tzinfo=UTC)
# The full moon nearest to the winter solstice stands highest: 76 degrees.
_FULL_MOON = datetime(2023, 12, 27, 5, tzinfo=UTC)


@dataclass(frozen=True)
class Measured:
    """Total illuminance of level ground under a clear sky in the literature, least and greatest published value [lx]."""

    low_lx: float
    high_lx: float
    source: str


@dataclass(frozen=True)
class Row:
    """A state of the sky, the model's illuminance of level ground [lx], and the literature's."""

    state: str
    model_lx: float
    literature: Measured

    @property
    def excess(self) -> float:
        """By what factor the model lies outside the literature and its spread: 1 inside, above 1 too bright, below 1 too dark."""
        low, high = self.literature.low_lx / SPREAD, self.literature.high_lx * SPREAD
        return max(self.model_lx / high, 1.0) * min(self.model_lx / low, 1.0)


_USNO = "Janiczek and DeYoung 1987 (USNO Circular 171)"
_IESNA = "IESNA Lighting Handbook, clear sky"
_AMS = "AMS Glossary of Meteorology, twilight"
LITERATURE = {
    "sun at 60 degrees": Measured(102e3, 104e3, f"{_IESNA}; {_USNO}"),
    "sun at 5 degrees": Measured(4490, 6370, f"{_USNO}; {_IESNA}"),
    "sun at 0 degrees": Measured(759, 800, f"{_USNO}; {_IESNA}"),
    "sunset, -0.83 degrees": Measured(410, 585, _AMS),
    "sun at -6 degrees": Measured(2, 4.3, f"{_AMS}; Kimball 1916"),
    "sun at -12 degrees": Measured(0.008, 0.01, f"{_AMS}, and with airglow"),
    "sun at -18 degrees": Measured(6e-4, 2e-3, f"{_AMS}, and with airglow"),
    "full moon, high": Measured(0.05, 0.3, "Kyba, Mohar and Posch 2017"),
    "new moon": Measured(6e-4, 2e-3, "Kyba, Mohar and Posch 2017; RCA Electro-Optics Handbook 1974"),
}


def illuminance(light: Lighting) -> float:
    """Total illuminance of open level ground [lx]."""
    beams = sum(lamp.irradiance * max(float(lamp.direction[1]), 0.0) for lamp in (light.sun, light.moon))
    return float(LUMINANCE_FROM_RGB @ (light.sky_cube[2] + beams))


def time_of_elevation(degrees: float) -> datetime:
    """When on the table's evening the centre of the sun stands at an elevation of -24..72 degrees; to the second.

    As in the literature's tables, elevations of 0 and more are apparent ones, with refraction, and others are true ones.
    """
    high, low = _NOON, _MIDNIGHT
    while low - high > timedelta(seconds=1):
        middle = high + (low - high) / 2
        sun = sun_position(PLACE, middle)
        now = sun.elevation_degrees if degrees >= 0 else sun.true_elevation_degrees
        high, low = (middle, low) if now > degrees else (high, middle)
    return low


def lighting_table() -> list[Row]:
    """All rows, from noon to a moonless night."""
    moments = {
        "sun at 60 degrees": time_of_elevation(60.0),
        "sun at 5 degrees": time_of_elevation(5.0),
        "sun at 0 degrees": time_of_elevation(0.0),
        "sunset, -0.83 degrees": time_of_elevation(-0.83),
        "sun at -6 degrees": time_of_elevation(-6.0),
        "sun at -12 degrees": time_of_elevation(-12.0),
        "sun at -18 degrees": time_of_elevation(-18.0),
        "full moon, high": _FULL_MOON,
        "new moon": _MIDNIGHT,
    }
    return [Row(state, illuminance(make_lighting(PLACE, moment)), LITERATURE[state]) for state, moment in moments.items()]


def main() -> None:
    """Print the table as Markdown."""
    print("| clear sky | model [lx] | literature [lx] | source |\n|---|---|---|---|")
    for row in lighting_table():
        found = row.literature
        print(f"| {row.state} | {row.model_lx:.3g} | {found.low_lx:.3g} - {found.high_lx:.3g} | {found.source} |")


if __name__ == "__main__":
    main()
