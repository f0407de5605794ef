"""Lamps without a device: photometry, colour temperature, schedules, refusals, and the pure plans of what is lit when."""

import copy
import json
import math
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from bake_jobs.scene_source import load_scene
from gi_core.dataset import WorldInfo
from gi_core.errors import CorruptFileError, InputError, SourceError
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_plan import MAX_CHANGED, SurfelBounds, changed_spheres, touching_lamps
from gi_core.lighting_model import make_lighting
from gi_core.lights import area_halves, check_lamp, color_from_temperature, is_on, lamps_digest, lamps_on, light_records
from gi_core.shadow_tiles import split_by_size
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.world import Lamp, Location

LAMP = Lamp("street", "point", (1.0, 6.0, 2.0), 8000.0)
GOLDEN = Path(__file__).parents[1] / "golden" / "v1" / "world.json"


@pytest.mark.parametrize("color", [(1, 1, 1), (1, 0.5, 0.2), (0, 0, 7)])
def test_lumens_are_the_luminous_flux_whatever_the_colour(color):
    point, spot, area = light_records(
        [replace(LAMP, color=color, kind=kind, cone_degrees=70.0, size=(2.0, 0.5)) for kind in ("point", "spot", "area")], np.zeros(3)
    )
    luminance = [float(LUMINANCE_FROM_RGB @ record["intensity"]) for record in (point, spot, area)]
    # Float32 records.
    assert luminance[0] * 4 * math.pi == pytest.approx(8000, rel=1e-6)
    assert luminance[2] * math.pi * 2.0 * 0.5 == pytest.approx(8000, rel=1e-6)
    angle = (np.arange(100_000) + 0.5) / 100_000 * math.radians(35)
    edge = np.clip((np.cos(angle) - spot["cos_outer"]) / (spot["cos_inner"] - spot["cos_outer"]), 0, 1)
    flux = (luminance[1] * edge**2 * (3 - 2 * edge) * 2 * math.pi * np.sin(angle)).mean() * math.radians(35)
    assert flux == pytest.approx(8000, rel=1e-5)
    assert point["intensity"] / point["intensity"].max() == pytest.approx(np.array(color) / max(color), rel=1e-6)


def test_a_black_bodys_colour_is_the_published_one():
    # CIE standard illuminant A is a black body of 2856 K at x = 0.44757, y = 0.40745; IEC 61966-2-1 takes linear sRGB back to XYZ.
    xyz_from_rgb = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = xyz_from_rgb @ color_from_temperature(2856.0)
    # The colour-matching functions are fitted lobes, 0.0013 off here; a just noticeable difference is 0.003.
    assert xyz[:2] / xyz.sum() == pytest.approx([0.44757, 0.40745], abs=0.003)
    for kelvin in (1000.0, 1500.0, 6504.0, 40_000.0):
        color = np.array(color_from_temperature(kelvin))
        assert (color >= 0).all()
        assert color @ LUMINANCE_FROM_RGB == pytest.approx(1)
    # The white of sRGB is D65, which lies a little off a black body of its temperature.
    assert np.ptp(color_from_temperature(6504.0)) < 0.08
    for wrong in (0.0, 999.0, 1e6, float("nan")):
        with pytest.raises(InputError, match="temperature_k"):
            color_from_temperature(wrong)


def test_an_areas_width_is_level_and_its_sides_are_square_to_each_other_and_to_the_normal():
    for direction in [(0, -1, 0), (0, 1, 0), (1, 0, 0), (0, 0, -2), (1, 2, 3), (1e-7, -1, 0), (1e-5, -1, 1e-5)]:
        lamp = replace(LAMP, kind="area", direction=direction, size=(3.0, 2.0))
        u, v = area_halves(lamp)
        normal = np.array(direction) / np.linalg.norm(direction)
        assert np.linalg.norm(u) == pytest.approx(1.5)
        assert np.linalg.norm(v) == pytest.approx(1.0)
        assert [u @ v, u @ normal, v @ normal] == pytest.approx([0, 0, 0], abs=1e-12)
        assert u[1] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("schedule", "clock", "sun_is_up", "on"),
    [
        ("always", "12:00", True, True),
        ("night", "12:00", True, False),
        ("night", "12:00", False, True),
        ("18:00-23:30", "17:59:59", False, False),
        ("18:00-23:30", "18:00", True, True),
        ("18:00-23:30", "23:29:59", False, True),
        ("18:00-23:30", "23:30", False, False),
        ("22:00-06:00", "23:00", False, True),
        ("22:00-06:00", "00:00", False, True),
        ("22:00-06:00", "06:00", False, False),
        ("22:00-06:00", "21:59", False, False),
        ("00:00-23:59", "23:59", False, False),
    ],
)
def test_schedules(schedule, clock, sun_is_up, on):
    assert is_on(schedule, datetime.fromisoformat(f"2024-06-21T{clock}"), sun_is_up) is on


def test_street_lamps_are_on_at_night_and_their_digest_says_which():
    night, shop = replace(LAMP, schedule="night"), replace(LAMP, name="shop", schedule="08:00-20:00", lumens=50.0)
    dead = replace(LAMP, name="dead", lumens=0.0)
    at = {time: lamps_on([night, shop, dead], make_lighting(Location(), time, "clear")) for time in ("12:00", "19:00", "23:00")}
    assert at == {"12:00": (shop,), "19:00": (shop,), "23:00": (night,)}
    assert lamps_on([night], make_lighting(Location(), "2024-12-21T19:00", "clear")) == (night,)
    assert lamps_digest([night]) != lamps_digest([shop])
    assert lamps_digest([night]) == lamps_digest([replace(night, name="same light", schedule="always")])
    for field, value in (("position", (1.0, 6.0, 2.5)), ("lumens", 1.0), ("range_m", 5.0), ("size", (1.0, 2.0)), ("kind", "spot")):
        assert lamps_digest([night]) != lamps_digest([replace(night, **{field: value})])


WRONG = {
    "kind": "laser",
    "position": (0.0, math.nan, 0.0),
    "lumens": -1.0,
    "color": (1.0, -1.0, 1.0),
    "range_m": 0.0,
    "direction": (0.0, 0.0, 0.0),
    "cone_degrees": 181.0,
    "size": (0.0, 1.0),
    "schedule": "18:00-18:00",
}


@pytest.mark.parametrize("field", WRONG)
def test_a_lamp_out_of_its_ranges_is_refused_by_field(field):
    check_lamp(LAMP)
    with pytest.raises(InputError, match=f"lamp 'street': {field}: expected"):
        check_lamp(replace(LAMP, **{field: WRONG[field]}))


@pytest.mark.parametrize(
    "schedule", ["", "never", "25:00-26:00", "8:00-9:00", "18:00", "18:00-23:60", "18:00 - 23:30", "\u0661\u0668:00-23:30"]
)
def test_a_schedule_that_is_none_is_refused(schedule):
    with pytest.raises(InputError, match="schedule: expected"):
        check_lamp(replace(LAMP, schedule=schedule))
    with pytest.raises(InputError, match="schedule"):
        is_on(schedule, datetime(2024, 6, 21), True)


@pytest.mark.parametrize("field", [name for name in WRONG if name != "position"])
def test_a_dataset_with_such_a_lamp_is_refused_by_field(field):
    record = copy.deepcopy(json.loads(GOLDEN.read_bytes()))
    wrong = WRONG[field]
    record["lamps"][1][field] = list(wrong) if isinstance(wrong, tuple) else wrong
    with pytest.raises(CorruptFileError, match=rf"city: lamps: .*{field}: expected .*bake it again"):
        WorldInfo.from_json(record, "city")


SPOT = """
[[source]]
path = "flat.ply"
[[lamp]]
name = "stage"
kind = "spot"
position = [1, 2, 3]
lumens = 800
"""


@pytest.fixture
def folder(tmp_path):
    vertices = "0 0 0\n0 0 9\n9 0 9\n"
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "flat.ply").write_text(f"{header}element face 1\nproperty list uchar int vertex_indices\nend_header\n{vertices}3 0 1 2\n")
    return tmp_path


def lamp_of(folder, more):
    (folder / "world.toml").write_text(SPOT + more)
    return load_scene(folder / "world.toml").lamps[0]


def test_a_world_file_gives_a_lamp_all_that_it_has(folder):
    lamp = lamp_of(folder, 'temperature_k = 3000\ndirection = [1, -1, 0]\ncone_degrees = 40\nsize = [2, 1]\nschedule = "night"')
    assert lamp == Lamp("stage", "spot", (1, 2, 3), 800, color_from_temperature(3000), 30, (1, -1, 0), 40, (2, 1), "night")
    assert lamp_of(folder, "") == Lamp("stage", "spot", (1, 2, 3), 800)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("temperature_k = 3000\ncolor = [1, 1, 1]", "expected color or temperature_k, found both"),
        ("temperature_k = 10", "temperature_k: expected a number from 1000 to 40000, found 10"),
        ("size = [1]", r"size: expected two numbers from 0.01 to 10000, found \[1\]"),
        ("size = [1, 0]", "size: expected two numbers"),
        ("size = 3", "size: expected two numbers"),
        ("direction = [0, 0, 0]", "direction: expected three numbers, not all 0"),
        ("cone_degrees = 0", "cone_degrees: expected a number from 1 to 180, found 0"),
        ('schedule = "sometimes"', 'schedule: expected "always", "night"'),
        ("schedule = true", "schedule: expected text"),
        ("beam = 3", "unknown key beam"),
    ],
)
def test_a_world_file_with_a_wrong_lamp_is_refused_by_key(folder, more, said):
    with pytest.raises(SourceError, match=rf"world\.toml: \[\[lamp\]\] 1: .*{said}") as error:
        lamp_of(folder, more)
    assert "\n" not in str(error.value)


def test_lamps_touch_a_sector_by_its_surfels_and_not_by_its_borders(make_sector):
    sector = make_sector(3, surfels=200)
    surfels = sector.surfel_position.astype(np.float64)
    rng = np.random.default_rng(3)
    lamps = [replace(LAMP, position=tuple(rng.uniform(-400, 400, 3)), range_m=float(rng.uniform(1, 150))) for _ in range(300)]
    expected = [lamp for lamp in lamps if (np.linalg.norm(surfels - lamp.position, axis=1) < lamp.range_m).any()]
    touching = touching_lamps(lamps, SurfelBounds(sector))
    assert [t.lamp for t in touching] == expected
    assert 10 < len(expected) < 290
    for t in touching:
        lit = surfels[np.linalg.norm(surfels - t.lamp.position, axis=1) < t.lamp.range_m]
        corners = np.vstack([lit, t.lamp.position])
        assert ((corners >= t.low) & (corners <= t.high)).all()


@pytest.mark.parametrize("sizes", [[], [0], [1] * 200, [300] * 3, [30] * 10, [0, 9**9, 0]])
def test_every_tile_is_in_one_group_in_order_and_no_group_is_too_big(sizes):
    tiles = [(SectorIndex(i, -i), size) for i, size in enumerate(sizes)]
    groups = split_by_size(tiles, 100)
    assert [index for group in groups for index in group] == [index for index, _ in tiles]
    for group in groups:
        assert len(group) == 1 or sum(dict(tiles)[index] for index in group) <= 100
    assert len(groups) <= max(1, 2 * sum(sizes) // 100 + 1)


def contributions(lamps, point):
    """What a sum of lamps in their order depends on at a point."""
    return [replace(lamp, name="") for lamp in lamps if math.dist(lamp.position, point) < lamp.range_m]


@pytest.mark.parametrize("seed", range(20))
def test_outside_of_the_changed_spheres_the_same_lamps_are_summed_in_the_same_order(seed):
    rng = np.random.default_rng(seed)
    origin = np.array([640.0, 0, -64.0])
    before = [replace(LAMP, position=tuple((origin + rng.uniform(0, 64, 3)).tolist()), range_m=float(rng.uniform(2, 12))) for _ in range(9)]
    after = list(before)
    for _ in range(3):
        what, i = rng.integers(4), int(rng.integers(len(after)))
        if what == 0:
            after[i] = replace(after[i], position=tuple((origin + rng.uniform(0, 64, 3)).tolist()))
        elif what == 1:
            after[i] = replace(after[i], lumens=1.0)
        elif what == 2:
            del after[i]
        else:
            after.insert(i, replace(LAMP, position=tuple((origin + rng.uniform(0, 64, 3)).tolist())))
    spheres = changed_spheres(before, after, origin)
    kept = 0
    for point in origin + rng.uniform(0, 64, (200, 3)):
        if (np.linalg.norm(spheres[:, :3] - (point - origin), axis=1) > spheres[:, 3]).all():
            kept += 1
            assert contributions(before, point) == contributions(after, point)
    assert kept or seed  # some seeds reorder so much that no place is out of reach


def test_nothing_said_to_be_unchanged_means_anywhere():
    assert changed_spheres([LAMP], [LAMP], np.zeros(3)) is None
    assert changed_spheres([LAMP], [replace(LAMP, lumens=1.0)], np.zeros(3)).tolist() == [[1, 6, 2, 30], [1, 6, 2, 30]]
    many = [replace(LAMP, lumens=float(i)) for i in range(MAX_CHANGED + 1)]
    assert changed_spheres([], many, np.zeros(3)) is None
    assert len(changed_spheres([LAMP], [LAMP, LAMP], np.zeros(3))) == 1


def test_shadow_geometry_reads_the_sectors_of_a_box_once_and_forgets_the_oldest():
    read = []

    def geometry(index):
        read.append(index)
        corner = index.origin + np.array([1.0, 0, 1])
        flat = np.zeros((1, 3), np.float32)
        return Geometry(corner + np.array([[0.0, 0, 0], [5, 0, 0], [0, 4, 5]]), np.array([[0, 1, 2]], np.int32), flat, flat)

    sectors = [SectorIndex(x, z) for x in (-1, 0, 1) for z in (0, 1)]
    shadows = ShadowGeometry(geometry, sectors)
    low, high = np.array([-60.0, 0, 0]), np.array([60.0, 9, 60])
    assert shadows.triangles_in(low, high)[:, 0].tolist() == [[-63, 0, 1], [1, 0, 1]]
    assert shadows.triangles_in(low, high).shape == (2, 3, 3)
    assert read == [SectorIndex(-1, 0), SectorIndex(0, 0)]
    assert len(shadows.triangles_in(np.full(3, -1e7), np.full(3, 1e7))) == 6
    assert sorted(read) == sectors
    assert len(shadows.triangles_in(np.array([1e6, 0, 1e6]), np.array([1e6, 0, 1e6]))) == 0
    assert len(shadows.triangles_in(low + np.array([0.0, 5, 0]), high)) == 0  # above all triangles
    one_at_a_time = ShadowGeometry(geometry, sectors, kept_bytes=1)
    assert one_at_a_time.triangles_in(low, high).tolist() == shadows.triangles_in(low, high).tolist()
