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

# Where the sun comes within 14 degrees of the zenith on the table's day.
PLACE = Location(20.0, 0.0, 0.0, "UTC", source="given")
# The Explanatory Supplement's curve is itself good to 0.02 in the decimal logarithm, as its tables say; no other source says how good.
SPREAD = 1.05

# On 2024-04-05 the sun stands at its mean distance, as in the literature, and the moon, three days from new, goes down before it.
_NOON, _MIDNIGHT = datetime(2024, 4, 5, 12, tzinfo=UTC), datetime(2024, 4, 6, 0, tzinfo=UTC)
# A full moon at its mean distance, 66 degrees high.
_FULL_MOON = datetime(2023, 4, 6, 0, tzinfo=UTC)


@dataclass(frozen=True)
class Measured:
    """Total illuminance of level ground under a clear sky in the literature, least and greatest published value [lx]."""

    low_lx: float
    high_lx: float
    source: str

    @property
    def bounds_lx(self) -> tuple[float, float]:
        """What the model is held to [lx]: the published range and its spread either side."""
        return self.low_lx / SPREAD, self.high_lx * SPREAD


@dataclass(frozen=True)
class Row:
    """A state of the sky, the model's illuminance of level ground [lx], and the literature's."""

    state: str
    model_lx: float
    literature: Measured

    @property
    def excess(self) -> float:
        """By what factor the model lies outside the literature and its spread: 1 inside, above 1 too bright, below 1 too dark."""
        low, high = self.literature.bounds_lx
        return max(self.model_lx / high, 1.0) * min(self.model_lx / low, 1.0)


_SUPPLEMENT = "Explanatory Supplement"
_USNO = "USNO Circular 171"
_IES = "IES 1984"
_AMS = "AMS Glossary"
# MATH.md says what each source is, and how it was checked.
LITERATURE = {
    "sun at 60 degrees": Measured(101.9e3, 103.1e3, f"{_IES}; {_SUPPLEMENT}"),
    "sun at 5 degrees": Measured(4250, 6370, f"{_USNO}; {_IES}"),
    "sun at 0 degrees": Measured(759, 984, f"{_SUPPLEMENT}; {_USNO}"),
    "sunset, -0.83 degrees": Measured(410, 670, f"{_AMS}; Kishida 1989"),
    "sun at -6 degrees": Measured(2, 3.5, _AMS),
    "sun at -12 degrees": Measured(0.0049, 0.0101, f"{_USNO}; {_SUPPLEMENT}, each with its own night"),
    "sun at -18 degrees": Measured(5.1e-4, 2.64e-3, f"{_USNO}; {_SUPPLEMENT}, each with its own night"),
    "full moon at 66 degrees": Measured(0.2, 0.32, "Spitschan et al. 2016; Kyba et al. 2017, their most: a high moon"),
    "new moon": Measured(5e-4, 2e-3, f"{_USNO}; {_SUPPLEMENT}"),
}


def illuminance(light: Lighting) -> float:
    """Total illuminance of open level ground [lx]."""
    beams = sum(lamp.irradiance * max(float(lamp.direction[1]), 0.0) for lamp in (light.sun, light.moon))
    return float(LUMINANCE_FROM_RGB @ (light.sky_cube[2] + beams))


def time_of_elevation(degrees: float) -> datetime:
    """When on the table's evening the sun's centre stands at a true elevation of -60..76 degrees, without refraction; to the second."""
    high, low = _NOON, _MIDNIGHT
    while low - high > timedelta(seconds=1):
        middle = high + (low - high) / 2
        high, low = (middle, low) if sun_position(PLACE, middle).true_elevation_degrees > degrees else (high, middle)
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
        "full moon at 66 degrees": _FULL_MOON,
        "new moon": _MIDNIGHT,
    }
    return [Row(state, illuminance(make_lighting(PLACE, moment)), LITERATURE[state]) for state, moment in moments.items()]


def main() -> None:
    """Print the table as Markdown."""
    print("| clear sky | model [lx] | held to [lx] | literature [lx] | source |\n|---|---|---|---|---|")
    for row in lighting_table():
        published = row.literature
        held, found = (f"{_text(low)} - {_text(high)}" for low, high in (published.bounds_lx, (published.low_lx, published.high_lx)))
        print(f"| {row.state} | {_text(row.model_lx)} | {held} | {found} | {published.source} |")


def _text(lux: float) -> str:
    return f"{lux:,.0f}" if lux >= 100 else f"{lux:.3g}"


if __name__ == "__main__":
    main()
