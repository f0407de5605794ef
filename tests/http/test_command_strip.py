"""One street in many lights on one sheet, and the table of what the knobs do."""

import io
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.settings import NEUTRAL, Settings
from gi_core.settings_table import EXAMPLES, NIGHT, settings_table
from gi_core.weather import weather_presets
from server import labels, strip

STREET = np.array([48.0, 4.0, 3.0])


def test_a_day_has_its_hours_a_weather_sheet_its_presets_and_settings_every_knob():
    hours = strip.plan_frames("day", "09:00", "rain", True)
    assert [frame.time for frame in hours] == [f"{hour:02d}:00" for hour in range(24)]
    assert {frame.weather for frame in hours} == {"rain"}
    weathers = strip.plan_frames("weather", "09:00", "rain", True)
    assert [frame.weather for frame in weathers] == weather_presets()
    assert {frame.time for frame in weathers} == {"09:00"}
    panels = strip.plan_frames("settings", "09:00", "clear", True)
    assert panels[0].settings == NEUTRAL
    turned = {f.name for f in fields(Settings) for p in panels if getattr(p.settings, f.name) != getattr(NEUTRAL, f.name)}
    assert turned == {f.name for f in fields(Settings)}
    assert NIGHT not in {frame.time for frame in strip.plan_frames("settings", "09:00", "clear", False)}


def test_labels_name_the_knob_before_what_it_acts_upon():
    labels = [example.label for example in EXAMPLES]
    assert "neutral" in labels
    assert "ambient_factor 2 on ambient_up" in labels
    assert "sky_boost 2000 2000 2000" in labels


def test_pixels_are_means_of_samples():
    fine = np.arange(5 * 6 * 3, dtype=np.float32).reshape(5, 6, 3)
    found = strip.reduced(fine, 2)
    assert found.shape == (2, 3, 3)
    np.testing.assert_array_equal(found[1, 2], fine[2:4, 4:6].mean(axis=(0, 1)))


def test_a_label_lies_below_its_picture():
    picture = np.full((9, 60, 3), 7, np.uint8)
    found = labels.labelled(picture, "13:00")
    assert found.shape == (9 + labels.LABEL_PIXELS, 60, 3)
    np.testing.assert_array_equal(found[:9], picture)
    assert found[9:].max() > 150


def test_a_strip_is_a_sheet_and_the_same_again(sectorlight, city: Path, tmp_path: Path):
    view = ("--eye", "10,3,3", "--look", "80,8,5", "--width", "32", "--kind", "weather")
    sheets = []
    for name in ("a.png", "b.png"):
        done = sectorlight("strip", str(city), *view, "-o", str(tmp_path / name))
        assert (done.returncode, done.stdout) == (0, "")
        sheets.append((tmp_path / name).read_bytes())
    assert sheets[0] == sheets[1]
    picture = np.asarray(Image.open(io.BytesIO(sheets[0])))
    cell = 32 * 9 // 16 + labels.LABEL_PIXELS
    assert picture.shape == (2 * cell, 4 * 32, 3)
    clear, snow = picture[:18, :32].astype(float), picture[cell : cell + 18, 64:96].astype(float)
    assert np.abs(clear - snow).mean() > 5  # seven different weathers, not one seven times


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"--eye": "1,2"}, "--eye"),
        ({"--look": "10,3,3"}, "--look"),
        ({"--kind": "year"}, "--kind"),
        ({"--time": "25:00"}, "25:00"),
        ({"--weather": "hail", "--kind": "day"}, "hail"),
        ({"-o": "/nowhere/at/all.png"}, "--output"),
    ],
)
def test_what_is_wrong_with_a_strip_is_said_in_a_line(sectorlight, city: Path, tmp_path: Path, changed: dict[str, str], word: str):
    given = {"--eye": "10,3,3", "--look": "80,8,5", "--kind": "weather", "-o": str(tmp_path / "x.png"), **changed}
    done = sectorlight("strip", str(city), *(part for option in given.items() for part in option))
    assert done.returncode == 2
    assert done.stderr.startswith("sectorlight: ")
    assert word in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_table_s_sources_add_up(city: Path):
    """Light is linear: what doubling sky, sun and lamps each adds is all there is."""
    rows = {row.example: row for row in settings_table(Engine(Dataset.open(city)), STREET)}
    by_label = {(example.time, example.label): row for example, row in rows.items()}
    neutral = by_label["13:00", "neutral"].outdoors_lx
    added = sum(by_label["13:00", f"{source}_factor 2"].outdoors_lx - neutral for source in ("sky", "sun"))
    assert neutral * 0.99 < added <= neutral * 1.0001  # indoor lamps, always on, give the rest: a few lux through doors
    night = by_label[NIGHT, "lights_factor 2"].outdoors_lx / by_label[NIGHT, "neutral"].outdoors_lx
    assert 1.9 < night < 2.0  # the rest is the night sky's
    upon = by_label["13:00", "exterior_ambient_scale 0 on ambient_up"]
    assert upon.outdoors_lx == pytest.approx(neutral, rel=1e-3)  # voxels at doors blend a room's probes
    assert upon.indoors_lx > 1.5 * by_label["13:00", "neutral"].indoors_lx
