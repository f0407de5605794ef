"""What each knob of the artists' panel does to a street's volume: ``python -m gi_core.settings_table DATASET X,Y,Z``.

The examples are also those that ``sectorlight strip --kind settings`` draws.
"""

import argparse
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from gi_core.arrays import Float64
from gi_core.constants import VOXEL_INDOORS
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.settings import NEUTRAL, Color, Settings
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.volume import Volume

DAY, NIGHT = "13:00", "23:00"
# About what a street's shade gets by day, bluish from above and reddish from below, so that a picture tells them apart.
_UP: Color = (2000.0, 4000.0, 8000.0)
_DOWN: Color = (8000.0, 4000.0, 2000.0)


@dataclass(frozen=True)
class Example:
    """A panel with one knob turned, at a local time. ``base`` is the panel before: neutral but for what the knob needs to act upon."""

    settings: Settings
    time: str = DAY
    base: Settings = NEUTRAL

    @property
    def needs_lamps(self) -> bool:
        """Whether it shows nothing where there is no lamp."""
        return self.time == NIGHT

    @property
    def label(self) -> str:
        """The knob and its value, and what it acts upon where that is not the light itself."""
        knob = ", ".join(f"{name} {_text(value)}" for name, value in _differing(self.settings, self.base).items())
        upon = ", ".join(_differing(self.base, NEUTRAL))
        return (knob or "neutral") + f" on {upon}" * bool(upon)


def _differing(settings: Settings, other: Settings) -> dict[str, float | Color]:
    pairs = ((f.name, getattr(settings, f.name), getattr(other, f.name)) for f in fields(Settings))
    return {name: value for name, value, before in pairs if value != before}


def _text(value: float | Color) -> str:
    return f"{value:g}" if isinstance(value, float) else " ".join(f"{v:g}" for v in value)


_AMBIENT = Settings(ambient_up=_UP)
EXAMPLES = (
    Example(NEUTRAL),
    Example(Settings(bounce_factor=2.0)),
    Example(Settings(sky_factor=2.0)),
    Example(Settings(sun_factor=2.0)),
    Example(Settings(sky_boost=(2000.0, 2000.0, 2000.0))),
    Example(_AMBIENT),
    Example(Settings(ambient_down=_DOWN)),
    Example(Settings(ambient_up=_UP, ambient_factor=2.0), base=_AMBIENT),
    Example(Settings(ambient_up=_UP, exterior_ambient_scale=0.0), base=_AMBIENT),
    Example(Settings(ambient_up=_UP, interior_ambient_scale=0.0), base=_AMBIENT),
    Example(NEUTRAL, NIGHT),
    Example(Settings(lights_factor=2.0), NIGHT),
)


@dataclass(frozen=True)
class Row:
    """Mean illuminance [lx] of the volume's six faces, in air outdoors and indoors; NaN where there is none."""

    example: Example
    outdoors_lx: float
    indoors_lx: float


def settings_table(engine: Engine, position: Float64) -> list[Row]:
    """A row for each example, of the volume around a world position (3,) [m], in clear weather. Raises OutsideWorldError."""
    rows = []
    for example in EXAMPLES:
        lighting = engine.lighting(example.time, "clear")
        outdoors = engine.volume(position, lighting, example.settings)
        has_rooms = (outdoors.mask == VOXEL_INDOORS).any()
        indoors = engine.interior(position, lighting, example.settings) if has_rooms else None
        rows.append(Row(example, _mean_lx(outdoors), np.nan if indoors is None else _mean_lx(indoors)))
    return rows


def _mean_lx(volume: Volume) -> float:
    return float((volume.values @ LUMINANCE_FROM_RGB).mean(axis=0)[volume.own].mean()) if volume.own.any() else np.nan


def main() -> None:
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("position", type=lambda text: np.array([float(v) for v in text.split(",")]))
    given = parser.parse_args()
    rows = settings_table(Engine(Dataset.open(given.dataset)), given.position)
    print("| local time | settings | outdoors [lx] | of neutral | indoors [lx] | of neutral |\n|---|---|---|---|---|---|")
    for row in rows:
        neutral = next(r for r in rows if r.example == Example(NEUTRAL, row.example.time))
        pairs = ((row.outdoors_lx, neutral.outdoors_lx), (row.indoors_lx, neutral.indoors_lx))
        cells = " | ".join(f"{value:.3g} | {value / reference:.2f}" for value, reference in pairs)
        print(f"| {row.example.time} | {row.example.label} | {cells} |")


if __name__ == "__main__":
    main()
