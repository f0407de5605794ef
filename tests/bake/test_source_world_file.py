"""world.toml: what it joins, and that every wrong key is named."""

from dataclasses import replace
from datetime import date

import numpy as np
import pytest
import trimesh

from bake_jobs.scene import ProbeHint
from bake_jobs.scene_source import load_scene
from gi_core.errors import SourceError
from gi_core.world import Decal, Lamp, Location, Room

WORLD = """
name = "two boxes"
north_degrees = 29.0

[location]
latitude = 48.137
longitude = 11.575
elevation_m = 519.0
date = 2024-12-21

[[source]]
path = "box.ply"

[[source]]
path = "box.ply"
offset = [10.0, 0, -5]
albedo = [0.1, 0.2, 0.3]

[[room]]
name = "hall"
minimum = [0, 0, 0]
maximum = [1, 2, 3]

[[lamp]]
name = "corner"
kind = "spot"
position = [1, 2, 3]
lumens = 800
color = [1, 0.5, 0.2]
range_m = 12.5

[[decal]]
name = "taxi"
position = [3, 0.25, 4]
size = [1.8, 1.25, 4.6]
yaw_degrees = 30

[[hint]]
kind = "forbid"
minimum = [0, 0, 0]
maximum = [1, 1, 1]
"""


@pytest.fixture
def folder(tmp_path):
    trimesh.creation.box((2, 2, 2)).export(tmp_path / "box.ply")
    return tmp_path


def load(folder, text):
    (folder / "world.toml").write_text(text)
    return load_scene(folder / "world.toml")


def test_everything_that_the_file_says_arrives(folder):
    scene = load(folder, WORLD)
    assert scene.name == "two boxes"
    assert scene.location == Location(48.137, 11.575, 519.0, "Europe/Berlin", 29.0, date(2024, 12, 21), "given")
    assert [replace(room, openings=()) for room in scene.rooms] == [Room("hall", (0, 0, 0), (1, 2, 3))]
    assert scene.lamps == (Lamp("corner", "spot", (1, 2, 3), 800, (1, 0.5, 0.2), 12.5),)
    assert scene.decals == (Decal("taxi", (3, 0.25, 4), (1.8, 1.25, 4.6), 30),)
    assert scene.hints == (ProbeHint("forbid", (0, 0, 0), (1, 1, 1)),)
    assert len(scene.triangles) == 24
    assert scene.bounds.tolist() == [[-1, -1, -6], [11, 1, 1]]
    second = scene.vertices[scene.triangles[:, 0], 0] > 5
    assert second.sum() == 12
    assert scene.albedo[second] == pytest.approx(np.tile([0.1, 0.2, 0.3], (12, 1)))
    assert (scene.albedo[~second] != scene.albedo[second]).all()


def test_a_bare_list_of_sources_is_enough(folder):
    scene = load(folder, '[[source]]\npath = "box.ply"\n')
    assert scene.location == Location()
    assert scene.name == "world"
    assert load(folder, 'north_degrees = 10\n[[source]]\npath = "box.ply"\n').location == Location(north_degrees=10.0)


def replaced(old, new):
    assert WORLD.count(old) >= 1
    return WORLD.replace(old, new, 1)


WRONG = {
    "no toml": ("= 3", "expected TOML"),
    "unknown key at the top": ("shadow = 3\n" + WORLD, "unknown key shadow"),
    "unknown key in a source": (replaced('path = "box.ply"', 'path = "box.ply"\nscale = 2'), r"\[\[source\]\] 1: unknown key scale"),
    "unknown key in the location": (replaced("elevation_m", "height"), r"\[location\]: unknown key height"),
    "unknown table": (WORLD + "[[door]]\nname = 'x'\n", "unknown key door"),
    "no path": (replaced('path = "box.ply"', ""), r"\[\[source\]\] 1: expected the key path"),
    "no such source": (replaced("box.ply", "none.ply"), "no such file"),
    "a world in a world": (replaced("box.ply", "world.toml"), "another world file"),
    "an offset of two": (replaced("[10.0, 0, -5]", "[10.0, 0]"), "offset: expected three numbers"),
    "a NaN offset": (replaced("[10.0, 0, -5]", "[nan, 0, 0]"), "offset: expected three numbers"),
    "an albedo above one": (replaced("[0.1, 0.2, 0.3]", "[1.1, 0, 0]"), "albedo: expected three numbers from 0 to 1"),
    "a latitude beyond the pole": (replaced("48.137", "91"), "latitude: expected a number from -90 to 90, found 91"),
    "half a place": (replaced("latitude = 48.137", ""), "expected the key latitude"),
    "a time zone of the moon": (replaced("elevation_m = 519.0", 'timezone = "Moon/Tycho"'), "IANA"),
    "a date in quotes": (replaced("2024-12-21", '"2024-12-21"'), "date: expected a TOML date"),
    "a moment for a date": (replaced("2024-12-21", "2024-12-21T10:00:00"), "date: expected a TOML date"),
    "a room inside out": (replaced("maximum = [1, 2, 3]", "maximum = [1, -2, 3]"), r"\[\[room\]\] 1: expected minimum below maximum"),
    "a room in millimetres": (
        replaced("maximum = [1, 2, 3]", "maximum = [1200, 2, 3]"),
        r"\[\[room\]\] 1: expected a room of at most 1000 m",
    ),
    "a nameless room": (replaced('name = "hall"', ""), "expected the key name"),
    "a laser": (replaced('"spot"', '"laser"'), "kind: expected point or spot or area, found 'laser'"),
    "a dark lamp": (replaced("lumens = 800", "lumens = -1"), "lumens"),
    "a lamp that is true": (replaced("lumens = 800", "lumens = true"), "lumens"),
    "a flat decal": (replaced("1.25, 4.6", "0, 4.6"), r"\[\[decal\]\] 1: size: expected three numbers from 0.01 to 1000"),
    "a decal nowhere": (replaced("[3, 0.25, 4]", "[3, inf, 4]"), "position: expected three numbers"),
    "a decal of a colour": (replaced("yaw_degrees = 30", "colour = 3"), r"\[\[decal\]\] 1: unknown key colour"),
    "a search in words": (WORLD + '[rooms]\nfind = "yes"\n', r"\[rooms\]: find: expected true or false, found 'yes'"),
    "a search for closed rooms alone": (WORLD + "[rooms]\nclosed = true\n", r"\[rooms\]: closed: expected find = true with it"),
    "a search for more": (WORLD + "[rooms]\nfind = true\nsize = 3\n", r"\[rooms\]: unknown key size; expected find, closed"),
    "a wish": (replaced('"forbid"', '"please"'), "kind: expected add or walls or forbid or densify"),
    "a wish for too much": (
        replaced('"forbid"', '"add"\nspacing_m = 0.25').replace("maximum = [1, 1, 1]", "maximum = [800, 90, 800]"),
        r"asks for 23,592,960 probes in one sector, which holds \d+; make spacing_m larger, or the box smaller",
    ),
    "north of 400 digits": (replaced("29.0", "1" * 400), "north_degrees"),
    "north in words": (replaced("29.0", '"up"'), "north_degrees"),
    "no source": ("name = 'x'\n", "at least one"),
    "a source that is a table": ("[source]\npath = 'box.ply'\n", r"expected tables \[\[source\]\]"),
}


def test_more_decals_than_a_dataset_holds_are_refused(folder, monkeypatch):
    monkeypatch.setattr("bake_jobs.world_file.MAX_DECALS", 0)
    with pytest.raises(SourceError, match="expected at most 0 decals, found 1"):
        load(folder, WORLD)


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_with_the_key_that_is_wrong(folder, case):
    text, said = WRONG[case]
    with pytest.raises(SourceError, match=said) as error:
        load(folder, text)
    assert str(folder) in str(error.value)
    assert "\n" not in str(error.value)
