"""CityJSON: frames, polygons with holes, levels of detail, surfaces' colours, ground where the file has none."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest

from bake_jobs.cityjson import OBJECT_ALBEDO, SURFACE_ALBEDO
from bake_jobs.scene_source import load_scene
from bake_jobs.solids import MAX_RINGS
from bake_jobs.terrain import GROUND_ALBEDO
from gi_core.errors import SourceError

SHARED_DATA = Path(__file__).parents[2].parent / "shared" / "data"
CUBE_FACES = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]  # bottom, top, four walls


def document():
    """A 10 m cube of stored integers in centimetres: x east, y north, z up; one Solid with semantics."""
    corners = [(x, y, z) for z in (0, 1000) for x, y in ((0, 0), (1000, 0), (1000, 1000), (0, 1000))]
    solid = {
        "type": "Solid",
        "lod": "1",
        "boundaries": [[[face] for face in CUBE_FACES]],
        "semantics": {
            "surfaces": [{"type": "GroundSurface"}, {"type": "RoofSurface"}, {"type": "WallSurface"}],
            "values": [[0, 1, 2, 2, 2, 2]],
        },
    }
    return {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.01, 0.01, 0.01], "translate": [1000.0, 2000.0, 7.0]},
        "CityObjects": {"house": {"type": "Building", "geometry": [solid]}},
        "vertices": [list(corner) for corner in corners],
    }


def load(tmp_path, content, name="a.city.json"):
    path = tmp_path / name
    path.write_text(json.dumps(content) if not isinstance(content, str) else content)
    return load_scene(path)


def built(scene):
    return ~np.isclose(scene.albedo, np.float32(GROUND_ALBEDO)).all(axis=1)


def volume(scene, chosen):
    a, b, c = (scene.vertices[scene.triangles[chosen, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_a_solid_is_decoded_turned_upright_and_faces_outward(tmp_path):
    scene = load(tmp_path, document())
    house = built(scene)
    assert volume(scene, house) == pytest.approx(1000)
    corners = scene.vertices[scene.triangles[house]].reshape(-1, 3)
    assert corners.min(axis=0).tolist() == [-5, 7, -5]
    assert corners.max(axis=0).tolist() == [5, 17, 5]


def test_north_is_minus_z(tmp_path):
    content = document()
    content["vertices"][6][2] = 1200  # the top's north-east corner, two metres higher
    scene = load(tmp_path, content)
    assert scene.vertices[scene.vertices[:, 1].argmax()].tolist() == [5, 19, -5]


def test_surfaces_have_the_colour_of_what_they_are(tmp_path):
    scene = load(tmp_path, document())
    corners = scene.vertices[scene.triangles]
    level = np.ptp(corners[:, :, 1], axis=1) == 0
    roof = level & (corners[:, :, 1] == 17).all(axis=1)
    wall = ~level
    assert np.unique(scene.albedo[roof], axis=0) == pytest.approx(np.array([SURFACE_ALBEDO["RoofSurface"]]))
    assert np.unique(scene.albedo[wall], axis=0) == pytest.approx(np.array([SURFACE_ALBEDO["WallSurface"]]))
    content = document()
    del content["CityObjects"]["house"]["geometry"][0]["semantics"]
    content["CityObjects"]["house"]["type"] = "WaterBody"
    scene = load(tmp_path, content)
    assert scene.albedo[built(scene)] == pytest.approx(np.tile(OBJECT_ALBEDO["WaterBody"], (12, 1)))


def test_ground_is_added_only_where_nothing_lies(tmp_path):
    scene = load(tmp_path, document())
    ground = ~built(scene)
    heights = scene.vertices[scene.triangles[ground]][:, :, 1]
    assert ground.any()
    assert (heights < 7).all(), "under the building's foot"
    assert (heights > 6).all()
    covered = document()
    covered["vertices"] += [[x, y, 0] for x, y in ((-50_000, -50_000), (50_000, -50_000), (50_000, 50_000), (-50_000, 50_000))]
    covered["CityObjects"]["land"] = {
        "type": "LandUse",
        "geometry": [{"type": "MultiSurface", "lod": "1", "boundaries": [[[8, 9, 10, 11]]]}],
    }
    scene = load(tmp_path, covered)
    under = ~built(scene)
    middle = scene.vertices[scene.triangles[under]].mean(axis=1)
    assert (np.abs(middle[:, [0, 2]] - [0, 0]).max(axis=1) > 400).all(), "only beyond the land's edge"


def test_a_wall_with_a_window_keeps_its_hole_and_its_direction(tmp_path):
    content = document()
    content["vertices"] += [[300, 0, 300], [700, 0, 300], [700, 0, 700], [300, 0, 700]]
    wall = {"type": "MultiSurface", "lod": "2", "boundaries": [[[0, 1, 5, 4], [8, 11, 10, 9]]]}  # the south wall
    content["CityObjects"] = {"wall": {"type": "Building", "geometry": [wall]}}
    scene = load(tmp_path, content)
    a, b, c = (scene.vertices[scene.triangles[built(scene), i]] for i in range(3))
    doubled = np.cross(b - a, c - a)
    assert doubled.sum(axis=0) / 2 == pytest.approx([0, 0, 100 - 16]), "faces south, +Z"
    assert (doubled[:, 2] > 0).all()


def test_a_surface_of_more_holes_than_can_be_triangulated_in_time_is_refused_by_name(tmp_path):
    content = document()
    name, item = next(iter(content["CityObjects"].items()))
    ring = [0, 1, 2]
    item["geometry"] = [{"type": "MultiSurface", "lod": "2", "boundaries": [[ring] * (MAX_RINGS + 1)]}]
    with pytest.raises(SourceError, match=rf"'{name}': expected a polygon of at most {MAX_RINGS} rings, found {MAX_RINGS + 1}"):
        load(tmp_path, content)


def test_the_highest_level_of_detail_is_read(tmp_path):
    content = document()
    finer = copy.deepcopy(content["CityObjects"]["house"]["geometry"][0])
    finer["lod"] = "2.2"
    finer["boundaries"][0] = finer["boundaries"][0][:2]
    content["CityObjects"]["house"]["geometry"].append(finer)
    assert built(load(tmp_path, content)).sum() == 4


@pytest.mark.parametrize("system", ["https://www.opengis.net/def/crs/EPSG/0/7415", "urn:ogc:def:crs,crs:EPSG::28992,crs:EPSG::5709"])
def test_a_coordinate_system_gives_a_place_and_true_metres(tmp_path, system):
    content = document()
    content["metadata"] = {"referenceSystem": system}
    content["transform"]["translate"] = [155_000.0, 463_000.0, 0.0]  # the origin of the Dutch grid: Amersfoort's church tower
    scene = load(tmp_path, content, "a.cityjson")
    assert scene.location.latitude_degrees == pytest.approx(52.1552, abs=2e-4)
    assert scene.location.longitude_degrees == pytest.approx(5.3872, abs=2e-4)
    assert scene.location.timezone == "Europe/Amsterdam"
    assert np.ptp(scene.vertices[scene.triangles[built(scene)]].reshape(-1, 3), axis=0) == pytest.approx([10, 10, 10], abs=0.01)


def broken():
    def with_change(change):
        content = document()
        change(content)
        return content

    return {
        "not json": ("{", "JSON"),
        "another kind": ({"type": "FeatureCollection"}, "CityJSON"),
        "version 3": (with_change(lambda d: d.update(version="3.0")), "version"),
        "no objects": (with_change(lambda d: d.update(CityObjects={})), "found none"),
        "a bad transform": (with_change(lambda d: d.update(transform={"scale": "x"})), "transform"),
        "no vertices": (with_change(lambda d: d.update(vertices=[])), "vertices"),
        "a vertex of 400 digits": (with_change(lambda d: d["vertices"][0].__setitem__(0, 10**400)), "vertices"),
        "an index of 400 digits": (
            with_change(lambda d: d["CityObjects"]["house"]["geometry"][0]["boundaries"][0][0].__setitem__(0, [0, 1, 10**400])),
            "house",
        ),
        "a lod of 400 digits": (with_change(lambda d: d["CityObjects"]["house"]["geometry"][0].update(lod=10**400)), "house"),
        "ragged vertices": (with_change(lambda d: d.update(vertices=[[1, 2], [3]])), "vertices"),
        "geometry of text": (with_change(lambda d: d["CityObjects"]["house"]["geometry"][0].update(boundaries=5)), "house"),
        "only bad indices": (with_change(lambda d: d.update(vertices=d["vertices"][:1])), "found none"),
        "unknown system": (with_change(lambda d: d.update(metadata={"referenceSystem": "https://x/EPSG/0/999999"})), "PROJ"),
        "a system of nobody's": (with_change(lambda d: d.update(metadata={"referenceSystem": "ours"})), "referenceSystem: .*'ours'"),
    }


@pytest.mark.parametrize("case", broken())
def test_what_is_no_city_is_refused_in_one_line(tmp_path, case):
    content, said = broken()[case]
    with pytest.raises(SourceError, match=said) as error:
        load(tmp_path, content)
    assert "\n" not in str(error.value)


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared test cities are not beside this checkout")
def test_a_real_city_stands_on_the_ground():
    scene = load_scene(SHARED_DATA / "delft.city.json")
    assert scene.location.latitude_degrees == pytest.approx(52.01, abs=0.01)
    assert scene.location.longitude_degrees == pytest.approx(4.365, abs=0.01)
    assert len(scene.triangles) > 36_000
    assert scene.bounds[1, 1] == pytest.approx(16.846, abs=0.01)
