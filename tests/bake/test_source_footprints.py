"""GeoJSON footprints: true metres, closed solids, a ground that nothing floats above."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

from bake_jobs.footprints import FOUNDATION_M, load_footprints
from bake_jobs.geography import MapFrame
from bake_jobs.rays import RayScene
from bake_jobs.scene import scene_digest
from bake_jobs.scene_source import load_scene
from bake_jobs.solids import MAX_RINGS
from bake_jobs.terrain import GROUND_ALBEDO, OUTLIER_M, smooth_heights
from gi_core.errors import SourceError

SHARED_DATA = Path(__file__).parents[2].parent / "shared" / "data"
needs_shared_data = pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared test cities are not beside this checkout")
# Metres of a degree near 50 N (WGS84): meridian and parallel arc.
LAT_M, LON_M = 111_229.0, 71_696.0


def square(east, north, size, **properties):
    """A feature: a square of ``size`` metres whose middle lies (east, north) metres from 50 N 8 E."""
    half = size / 2
    corners = [(-half, -half), (half, -half), (half, half), (-half, half), (-half, -half)]
    ring = [[8 + (east + dx) / LON_M, 50 + (north + dy) / LAT_M] for dx, dy in corners]
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Polygon", "coordinates": [ring]}}


def write(path, *features):
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features)}))
    return path


def split(scene):
    """Which triangles are ground."""
    return np.isclose(scene.albedo, np.float32(GROUND_ALBEDO)).all(axis=1)


def volume(scene, chosen):
    a, b, c = (scene.vertices[scene.triangles[chosen, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_a_building_has_its_size_place_and_height(tmp_path):
    features = [square(-100, 0, 20, base=5.0, height=30.0), square(100, 40, 20, base=5.0, height=12.0)]
    scene = load_scene(write(tmp_path / "two.geojson", *features))
    tall = scene.vertices[np.isclose(scene.vertices[:, 1], 35)]
    low = scene.vertices[np.isclose(scene.vertices[:, 1], 17)]
    # 0.05 m: the arcs above are rounded, and the middle of the world to 0.0001 degrees (11 m, a common shift).
    assert np.ptp(tall[:, 0]) == pytest.approx(20, abs=0.05)
    assert np.ptp(tall[:, 2]) == pytest.approx(20, abs=0.05)
    east, _, south = low.mean(axis=0) - tall.mean(axis=0)
    assert east == pytest.approx(200, abs=0.1)
    assert south == pytest.approx(-40, abs=0.1), "north is -Z"
    assert scene.location.source == "given"
    assert scene.location.timezone == "Europe/Berlin"
    assert (scene.location.latitude_degrees, scene.location.longitude_degrees) == pytest.approx((50.0002, 8.0), abs=1e-4)


def test_solids_are_closed_and_ground_is_flat_where_all_bases_agree(tmp_path):
    features = [square(0, 0, 20, base=5.0, height=30.0), square(50, 0, 10, base=5.0, height=10.0)]
    scene = load_scene(write(tmp_path / "flat.geojson", *features))
    ground = split(scene)
    assert volume(scene, ~ground) == pytest.approx(400 * (30 + FOUNDATION_M) + 100 * (10 + FOUNDATION_M), rel=2e-3)  # rounded arcs
    assert np.unique(scene.vertices[scene.triangles[ground]][:, :, 1]).tolist() == [5.0]
    low, high = scene.bounds
    walls = scene.vertices[scene.triangles[~ground]].reshape(-1, 3)
    assert ((walls - low)[:, [0, 2]] >= 64).all(), "the ground extends a sector beyond the buildings"
    assert ((high - walls)[:, [0, 2]] >= 64).all()


def test_courtyards_multipolygons_and_repair(tmp_path):
    court = square(0, 0, 40, height=10)
    court["geometry"]["coordinates"].append(square(0, 0, 20)["geometry"]["coordinates"][0])
    bow = square(200, 0, 20, height=10)
    ring = bow["geometry"]["coordinates"][0]
    ring[1], ring[2] = ring[2], ring[1]  # a bow tie: two triangles of a quarter of the square each
    pair = square(400, 0, 10, height=10)
    pair["geometry"] = {
        "type": "MultiPolygon",
        "coordinates": [pair["geometry"]["coordinates"], square(420, 0, 10)["geometry"]["coordinates"]],
    }
    scene = load_scene(write(tmp_path / "odd.geojson", court, bow, pair))
    area = (1600 - 400) + 2 * 100 + 2 * 100
    assert volume(scene, ~split(scene)) == pytest.approx(area * (10 + FOUNDATION_M), rel=2e-3)


def test_rings_that_are_one_point_are_left_out(tmp_path):
    """A footprint of that kind goes, a courtyard of that kind is filled; the others stay what they are."""
    dot, court = square(90, 0, 0, height=10), square(0, 0, 40, height=10)
    court["geometry"]["coordinates"].append(square(0, 0, 5e-4)["geometry"]["coordinates"][0])
    whole = write(tmp_path / "whole.geojson", square(0, 0, 40, height=10), square(200, 0, 20, height=10))
    odd = write(tmp_path / "odd.geojson", court, dot, square(200, 0, 20, height=10))
    frame = MapFrame(50.0, 8.0)
    expected, found = (load_footprints(path, frame).mesh for path in (whole, odd))
    assert np.array_equal(found.vertices, expected.vertices)
    assert np.array_equal(found.triangles, expected.triangles)
    with pytest.raises(SourceError, match="footprints with an area, found none among 1"):
        load_scene(write(tmp_path / "dot.geojson", dot))


def test_openstreetmap_heights(tmp_path):
    features = [
        square(0, 0, 10, height="12 m"),
        square(100, 0, 10, **{"building:levels": "5"}),
        square(200, 0, 10, height=30, min_height=20),
        square(300, 0, 10, height=0),
        square(400, 0, 10, height=None),
    ]
    scene = load_scene(write(tmp_path / "osm.geojson", *features))
    ground = split(scene)
    solid = scene.vertices[scene.triangles[~ground]].reshape(-1, 3)
    middle = [solid[np.abs(solid[:, 0] - solid[:, 0].min() - 5 - at) < 7] for at in (0, 100, 200, 300, 400)]
    assert middle[0][:, 1].max() == 12
    assert middle[1][:, 1].max() == pytest.approx(16)
    assert (middle[2][:, 1].min(), middle[2][:, 1].max()) == (20, 30)
    assert len(middle[3]) == 0, "height 0 is no building"
    assert middle[4][:, 1].max() == pytest.approx(9.6)


def test_guessed_heights_are_counted(tmp_path):
    known = square(0, 0, 10, height="12 m"), square(100, 0, 10, **{"building:levels": "5"})
    guessed = square(200, 0, 10), square(300, 0, 10, height="tall"), square(400, 0, 10, height=float("nan"))
    path = write(tmp_path / "some.geojson", *known, *guessed)
    world = tmp_path / "world.toml"
    world.write_text('[[source]]\npath = "some.geojson"\n')
    expected = f"{path}: 3 of 5 footprints have no height in metres and no building:levels; 9.6 m is taken"
    assert load_scene(path).notes == load_scene(world).notes == (expected,)
    assert load_scene(write(tmp_path / "known.geojson", *known)).notes == ()


def test_sloping_ground_meets_every_wall(tmp_path):
    rng = np.random.default_rng(2)
    features = []
    for east in range(0, 600, 50):
        for north in range(0, 600, 50):
            features.append(square(east, north, 25, base=5 + east / 40 + rng.normal() / 4, height=15.0))
    features[70]["properties"]["base"] = 69.0
    scene = load_scene(write(tmp_path / "slope.geojson", *features))
    ground = split(scene)
    heights = scene.vertices[scene.triangles[ground]][:, :, 1]
    assert 4 < heights.min() < 7
    assert 17 < heights.max() < 20, "the base of 69 m bent nothing"
    corners = scene.vertices[scene.triangles[~ground]]
    at = corners.reshape(-1, 3)
    from_above = np.column_stack([at[:, 0], np.full(len(at), 500.0), at[:, 2]])
    rays = RayScene(scene.vertices, scene.triangles[ground])
    surface = (500.0 - rays.closest(from_above, np.tile([0.0, -1.0, 0.0], (len(at), 1))).distance).reshape(-1, 3)
    height = corners[:, :, 1]
    is_wall = np.ptp(height, axis=1) > 0
    is_foot = (height == height.min(axis=1, keepdims=True)) & is_wall[:, None]
    assert is_foot.sum() > 4 * len(features)
    assert (height[is_foot] < surface[is_foot]).all()


def test_smooth_heights_are_exact_for_a_plane_of_equal_bases_and_robust():
    position = np.random.default_rng(0).uniform(0, 500, (200, 2))
    assert smooth_heights(position, position, np.full(200, 3.3)).tolist() == [3.3] * 200
    base = np.full(200, 3.3)
    base[::20] += 10 * OUTLIER_M
    assert np.allclose(smooth_heights(position, position, base), 3.3)
    far = np.array([[1e5, 1e5]])
    assert np.isfinite(smooth_heights(far, position, base)).all()


def test_north_turns_the_world_and_not_the_shape(tmp_path):
    path = write(tmp_path / "n.geojson", square(0, 0, 10, height=5), square(0, 200, 10, height=8))
    (tmp_path / "world.toml").write_text('north_degrees = 90.0\n[[source]]\npath = "n.geojson"\n')
    scene = load_scene(tmp_path / "world.toml")
    tall = scene.vertices[np.isclose(scene.vertices[:, 1], 8)].mean(axis=0)
    low = scene.vertices[np.isclose(scene.vertices[:, 1], 5)].mean(axis=0)
    # -Z points east (azimuth 90), so north is -X.
    assert (tall - low)[[0, 2]] == pytest.approx([-200, 0], abs=0.1)
    assert scene.location.north_degrees == 90
    assert load_scene(path).location.north_degrees == 0


def test_the_projection_keeps_distances_from_the_origin():
    # NGA's geodesic from Paris (48.8566 N 2.3522 E) one arc minute north: 1853.4 m on WGS84 at this latitude.
    frame = MapFrame(48.8566, 2.3522)
    x, z = frame.world_from_lonlat(np.array([[2.3522, 48.8566 + 1 / 60]]))[0]
    assert x == pytest.approx(0, abs=1e-6)
    assert z == pytest.approx(-1853.4, abs=0.2)


def named_crs(name):
    return {"type": "name", "properties": {"name": name}}


def write_in(path, features, crs, place=lambda lonlat: lonlat):
    """Features with their positions put elsewhere, and a crs member that says where."""
    moved = json.loads(json.dumps(features))
    for feature in moved:
        feature["geometry"]["coordinates"] = [place(np.array(ring)).tolist() for ring in feature["geometry"]["coordinates"]]
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": moved}))
    return path


TWO = [square(-100, 0, 20, base=5.0, height=30.0), square(100, 40, 20, base=5.0, height=12.0)]
MERCATOR_RADIUS_M = 6_378_137.0


def web_mercator(lonlat):
    """EPSG:3857's easting and northing (Snyder, Map Projections: A Working Manual, 1987, eq. 7-1 and 7-2)."""
    east, north = np.radians(lonlat).T
    return MERCATOR_RADIUS_M * np.stack([east, np.log(np.tan(np.pi / 4 + north / 2))], axis=1)


@pytest.mark.parametrize("name", ["EPSG:3857", "urn:ogc:def:crs:EPSG::3857", "http://www.opengis.net/def/crs/EPSG/0/3857"])
def test_positions_are_in_the_system_that_the_file_names(tmp_path, name):
    expected = load_footprints(write(tmp_path / "plain.geojson", *TWO))
    found = load_footprints(write_in(tmp_path / "mercator.geojson", TWO, named_crs(name), web_mercator))
    assert found.location == expected.location
    assert np.array_equal(found.mesh.triangles, expected.mesh.triangles)
    assert np.allclose(found.mesh.vertices, expected.mesh.vertices, atol=1e-4)  # [m]; worst seen 2e-6


@pytest.mark.parametrize("crs", [None, named_crs("urn:ogc:def:crs:OGC:1.3:CRS84"), named_crs("urn:ogc:def:crs:EPSG::4326")])
def test_a_file_that_says_it_is_in_longitude_and_latitude_is_read_as_one_that_does_not(tmp_path, crs):
    expected = load_footprints(write(tmp_path / "plain.geojson", *TWO))
    found = load_footprints(write_in(tmp_path / "named.geojson", TWO, crs))
    assert np.array_equal(found.mesh.vertices, expected.mesh.vertices)


@pytest.mark.parametrize(
    ("crs", "said"),
    [
        (named_crs("EPSG:999999"), "PROJ knows, as EPSG:4326, found 'EPSG:999999'"),
        (named_crs("the city's own"), 'PROJ knows, as EPSG:4326, found "the city\'s own"'),
        (named_crs("EPSG:4978"), "Geocentric"),
        (named_crs("\ud800"), "PROJ knows"),
        (named_crs("EPSG:5709"), "Vertical"),
        (named_crs(4326), "expected .*name.*take it out"),
        ({"type": "link", "properties": {"href": "http://example.com/crs/42", "type": "proj4"}}, "expected .*name.*found .*link"),
        ("EPSG:4326", "expected .*name.*take it out"),
    ],
)
def test_a_system_that_is_not_known_is_refused_in_one_line(tmp_path, crs, said):
    path = write_in(tmp_path / "odd.geojson", TWO, crs)
    with pytest.raises(SourceError, match=rf"odd\.geojson: crs: .*{said}") as error:
        load_footprints(path)
    assert "\n" not in str(error.value)


def test_positions_outside_a_system_s_area_are_refused(tmp_path):
    path = write_in(tmp_path / "far.geojson", TWO, named_crs("EPSG:25832"), lambda lonlat: lonlat + 1e12)
    with pytest.raises(SourceError, match="inside the area of EPSG:25832"):
        load_footprints(path)


REFUSED = {
    "not json": ("{", "no valid JSON"),
    "a list": ("[]", "FeatureCollection"),
    "a topology": ('{"type": "Topology"}', "found Topology"),
    "no footprints": ('{"type": "FeatureCollection", "features": []}', "found none"),
    "a feature that is a number": ('{"type": "FeatureCollection", "features": [3]}', "feature 0"),
    "projected metres": (json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [[[5e5, 4e6], [5e5, 4.1e6], [6e5, 4e6]]]}}
    ]}), "longitude and latitude"),
    "a place of 400 digits": (json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [[[10**400, 1], [0, 1], [1, 0]]]}}
    ]}), "feature 0: expected rings"),
    "words for numbers": (json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [[["a", "b"], ["c", "d"], ["e", "f"]]]}}
    ]}), "feature 0: expected rings"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_map_is_refused_in_one_line(tmp_path, case):
    text, said = REFUSED[case]
    path = tmp_path / "bad.geojson"
    path.write_text(text)
    with pytest.raises(SourceError, match=said) as error:
        load_scene(path)
    assert "\n" not in str(error.value)


def test_a_height_in_a_wrong_type_or_unit_names_its_feature(tmp_path):
    with pytest.raises(SourceError, match="feature 1: expected height to be a number"):
        load_scene(write(tmp_path / "a.geojson", square(0, 0, 10, height=5), square(50, 0, 10, height=[5])))
    with pytest.raises(SourceError, match="feature 0: expected a height of at most"):
        load_scene(write(tmp_path / "a.geojson", square(0, 0, 10, height=12_000)))


def test_a_height_of_400_digits_counts_as_none_and_any_name_has_a_colour(tmp_path):
    plain = load_scene(write(tmp_path / "a.geojson", square(0, 0, 10, building="\ud800")))
    huge = load_scene(write(tmp_path / "b.geojson", square(0, 0, 10, building="\ud800", height=10**400)))
    assert np.array_equal(plain.vertices, huge.vertices)


def test_a_polygon_of_more_holes_than_can_be_triangulated_in_time_is_refused_by_name(tmp_path):
    wide, hole = square(0, 0, 100, height=10), square(0, 0, 1)["geometry"]["coordinates"]
    wide["geometry"]["coordinates"] += hole * MAX_RINGS
    file = write(tmp_path / "sieve.geojson", square(300, 0, 20, height=10), wide)
    with pytest.raises(SourceError, match=rf"feature 1: expected a polygon of at most {MAX_RINGS} rings, found {MAX_RINGS + 1}"):
        load_footprints(file)


def test_two_continents_are_refused_before_their_ground_is_allocated(tmp_path):
    far = square(0, 0, 10, height=5)
    far["geometry"]["coordinates"] = [[[100 + x / LON_M, 10 + y / LAT_M] for x, y in ((0, 0), (10, 0), (10, 10))]]
    with pytest.raises(SourceError, match="one city"):
        load_scene(write(tmp_path / "far.geojson", square(0, 0, 10, height=5), far))


@needs_shared_data
def test_a_real_neighbourhood_stands_on_its_ground():
    scene = load_scene(SHARED_DATA / "eastvillage.geojson")
    assert scene_digest(scene) == scene_digest(load_scene(SHARED_DATA / "eastvillage.geojson"))
    rays = RayScene(scene.vertices, scene.triangles)
    x, z = (side.ravel() for side in np.meshgrid(np.arange(-250, 250, 5.0), np.arange(-250, 250, 5.0)))
    down = rays.closest(np.stack([x, np.full_like(x, 200), z], axis=1), np.tile([0.0, -1.0, 0.0], (len(x), 1)))
    assert down.hit.all()
    assert not down.from_back.any(), "everything seen from above is a roof or the ground, the right way up"
    on_ground = split(scene)[down.triangle]
    assert 0.3 < on_ground.mean() < 0.8, "streets and yards are half of a city"
    # From 0.5 m above the street, level rays meet fronts of walls or leave the scene: no gap leads under a building.
    street = np.stack([x, 200 - down.distance + 0.5, z], axis=1)[on_ground]
    angle = np.random.default_rng(0).uniform(0, 2 * np.pi, len(street))
    level = rays.closest(street, np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1))
    assert level.hit.mean() > 0.8
    assert level.from_back[level.hit].mean() < 0.002  # real rings that touch themselves


@needs_shared_data
@pytest.mark.slow
def test_midtown_loads_in_seconds():
    start = time.perf_counter()
    scene = load_scene(SHARED_DATA / "midtown.geojson")
    assert time.perf_counter() - start < 30
    assert len(scene.triangles) > 400_000
    assert scene.bounds[1, 1] == pytest.approx(455, abs=2)
