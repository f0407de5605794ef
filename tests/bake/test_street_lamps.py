"""Lamps for a city's streets: in street air only, the same for the same arguments, and written so that they are read back as they were."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bake_jobs.geography import MapFrame
from bake_jobs.lamp_file import lamps_toml, load_lamps
from bake_jobs.street_lamps import STREET_LAMP_HEIGHT_M, lamps_from_points, lamps_on_grid, main, random_lamps
from gi_core.dataset import Dataset
from gi_core.errors import InputError, SourceError
from gi_core.grid import SectorIndex
from gi_core.lights import check_lamp
from gi_core.world import LAMP_KINDS, Lamp

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
HERE = SectorIndex(0, 0)


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return Dataset.open(GOLDEN)


def clear_of_walls(dataset: Dataset, lamps: list[Lamp]) -> bool:
    """Whether no lamp lies in the box about any of the city's triangles that is not level."""
    parts = [dataset.geometry(index) for index in dataset.world.sectors]
    corners = np.concatenate([part.vertices[part.triangles] for part in parts])
    upright = corners[np.ptp(corners[..., 1], axis=1) > 0.1]
    place = np.array([lamp.position for lamp in lamps])[:, None]
    return not ((place > upright.min(axis=1)) & (place < upright.max(axis=1))).all(axis=2).any()


def test_random_lamps_hang_in_the_sectors_street_and_are_of_all_kinds(dataset):
    lamps = random_lamps(dataset, HERE, 60, seed=1)
    assert [lamp.name for lamp in lamps] == [f"lamp {i}" for i in range(60)]
    assert {lamp.kind for lamp in lamps} == set(LAMP_KINDS)
    for lamp in lamps:
        check_lamp(lamp)
        assert lamp.schedule == "night"
        assert all(HERE.origin[[0, 2]] <= np.array(lamp.position)[[0, 2]])
        assert all(np.array(lamp.position)[[0, 2]] < HERE.origin[[0, 2]] + 64)
    assert clear_of_walls(dataset, lamps)
    assert lamps == random_lamps(dataset, HERE, 60, seed=1) != random_lamps(dataset, HERE, 60, seed=2)


def test_a_grid_has_its_spacing_and_leaves_houses_out(dataset):
    lamps = lamps_on_grid(dataset, HERE, 8.0)
    places = np.array([lamp.position for lamp in lamps])
    assert 8 < len(lamps) < 64  # the city has houses
    np.testing.assert_allclose((places[:, [0, 2]] - 4.0) % 8.0, 0, atol=1e-9)
    np.testing.assert_allclose(places[:, 1], STREET_LAMP_HEIGHT_M, atol=0.01)
    assert clear_of_walls(dataset, lamps)


def geojson(path: Path, lonlat) -> Path:
    features = [{"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": list(one)}} for one in lonlat]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def test_real_lamps_stand_where_the_map_says(dataset, tmp_path):
    place = dataset.world.location
    at = lamps_on_grid(dataset, HERE, 16.0)[0].position
    frame = MapFrame(place.latitude_degrees, place.longitude_degrees, place.north_degrees)
    # Newton's method on the map, since there is no inverse: a degree is some 1e5 m.
    lonlat = np.array([[place.longitude_degrees, place.latitude_degrees]])
    steps = [frame.world_from_lonlat(lonlat + np.eye(2)[i] * 1e-4)[0] - frame.world_from_lonlat(lonlat)[0] for i in range(2)]
    for _ in range(4):
        missing = np.array(at)[[0, 2]] - frame.world_from_lonlat(lonlat)[0]
        lonlat = lonlat + 1e-4 * np.linalg.solve(np.array(steps).T, missing)
    (lamp,) = lamps_from_points(dataset, geojson(tmp_path / "one.geojson", [*lonlat.tolist(), [0.0, 0.0]]))
    np.testing.assert_allclose(lamp.position, at, atol=0.01)
    away = geojson(tmp_path / "away.geojson", [[10.0, 50.0], [10.0004, 50.0004]])
    with pytest.raises(InputError, match=r"none of its 2 points lies in .*--centred"):
        lamps_from_points(dataset, away)
    assert all(lamp.position[1] == pytest.approx(STREET_LAMP_HEIGHT_M, abs=0.01) for lamp in lamps_from_points(dataset, away, centred=True))


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"features": [3]}', '{"features": []}', '{"features": [{"geometry": {"type": "Point", "coordinates": [900, 1]}}]}'],
)
def test_a_map_without_points_is_refused_in_one_line(dataset, tmp_path, text):
    (tmp_path / "map.geojson").write_text(text)
    with pytest.raises(InputError, match=r"map.geojson: expected .*Point features") as error:
        lamps_from_points(dataset, tmp_path / "map.geojson")
    assert "\n" not in str(error.value)


def test_the_command_writes_the_same_file_twice_and_it_is_read_back(tmp_path, capsys):
    for name in ("a", "b"):
        main([str(GOLDEN), "--sector=-1,0", "--count", "25", "--seed", "3", "-o", str(tmp_path / f"{name}.toml")])
    assert (tmp_path / "a.toml").read_bytes() == (tmp_path / "b.toml").read_bytes()
    assert "25 lamps" in capsys.readouterr().out
    assert list(load_lamps(tmp_path / "a.toml")) == random_lamps(Dataset.open(GOLDEN), SectorIndex(-1, 0), 25, 3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--sector", "9,9"], "--sector: expected X,Z of a sector"),
        (["--sector", "here"], "found here"),
        ([], "--sector: expected X,Z"),
        (["--sector", "0,0", "--count", "0"], "--count: expected 1..100000, found 0"),
        (["--sector", "0,0", "--spacing", "nan"], "--spacing: expected 1..64 m"),
        (["--points", "nowhere.geojson"], "nowhere.geojson: cannot be read"),
    ],
)
def test_bad_arguments_are_one_line_and_status_2(tmp_path, capsys, options, said):
    with pytest.raises(SystemExit) as exit_:
        main([str(GOLDEN), *options, "-o", str(tmp_path / "out.toml")])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / "out.toml").exists()


NUMBER = st.floats(-1e9, 1e9)


@given(
    st.builds(
        Lamp,
        st.text(st.characters(exclude_categories=["Cs"])),
        st.sampled_from(LAMP_KINDS),
        st.tuples(NUMBER, NUMBER, NUMBER),
        st.floats(0, 1e12),
        st.tuples(*[st.floats(0, 1e6)] * 3),
        st.floats(0.01, 1e5),
        st.tuples(st.floats(0.1, 1), NUMBER, NUMBER),
        st.floats(1, 180),
        st.tuples(*[st.floats(0.01, 1e4)] * 2),
        st.sampled_from(["always", "night", "18:00-06:00"]),
    )
)
def test_any_lamp_is_read_back_as_it_was(tmp_path_factory, lamp):
    path = tmp_path_factory.getbasetemp() / "lamps.toml"
    path.write_text(lamps_toml([lamp, lamp]), encoding="utf-8")
    assert load_lamps(path) == (lamp, lamp)


def test_a_file_of_lamps_may_be_a_whole_world_but_not_hold_what_is_unknown(tmp_path):
    path = tmp_path / "world.toml"
    lamp = lamps_toml([Lamp("one", "point", (0.0, 1.0, 2.0), 5.0)])
    path.write_text(f'name = "all"\n[[source]]\npath = "nowhere.glb"\n{lamp}')
    assert load_lamps(path) == (Lamp("one", "point", (0.0, 1.0, 2.0), 5.0),)
    for text, said in ((f"lmap = 3\n{lamp}", "unknown key lmap"), ("", "at least one"), ("lamp = 3", "tables"), ("lamp", "TOML")):
        path.write_text(text)
        with pytest.raises(SourceError, match=said):
            load_lamps(path)
    with pytest.raises(SourceError, match="cannot be read"):
        load_lamps(tmp_path)
