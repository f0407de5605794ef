"""Players as users write them: read strictly, written and read back, never half a file."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.errors import InputError
from server.player_paths import points_from_json
from server.players import Player, player_from_json, read_players

LINE = {"type": "LineString", "coordinates": [[10, 20, 1.6], [30.5, -4, 2]]}
WHOLE = {
    "id": "runner",
    "speed": 5,
    "path": [[0, 1.6, 0], [40.5, 1.6, 0]],
    "loop": True,
    "pause_s": [0, 4],
    "turn_s": 0.5,
    "seed": 7,
    "walk_m": 300,
    "near": [1, 2, 3],
}


def test_a_player_has_what_its_record_says_and_defaults_for_the_rest() -> None:
    player = player_from_json(WHOLE, "here")
    assert player == Player("runner", 5.0, ((0.0, 1.6, 0.0), (40.5, 1.6, 0.0)), True, (0.0, 4.0), 0.5, 7, 300.0, (1.0, 2.0, 3.0))
    assert player_from_json({}, "here", new_id="p-1") == Player("p-1")
    assert player_from_json(json.loads(json.dumps(player.to_json())), "here") == player


def test_geojson_says_x_then_z_then_height() -> None:
    expected = ((10.0, 1.6, 20.0), (30.5, 2.0, -4.0))
    feature = {"type": "Feature", "properties": {}, "geometry": LINE}
    for value in (LINE, feature, {"type": "FeatureCollection", "features": [feature]}):
        assert points_from_json(value, "here") == expected
    flat = {"type": "LineString", "coordinates": [[10, 20], [30, 40]]}
    assert points_from_json(flat, "here", lambda x, z: x + z) == ((10.0, 30.0, 20.0), (30.0, 70.0, 40.0))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"id": ""}, "id: expected"),
        ({"id": "a b"}, "id: expected"),
        ({"id": "x" * 65}, "id: expected"),
        ({"id": "\u0661"}, "id: expected"),
        ({"id": None}, "id: expected"),
        ({"colour": "red"}, "colour"),
        ({"speed": -0.1}, "speed: expected a number of 0..200, found -0.1"),
        ({"speed": 200.5}, "speed"),
        ({"speed": float("nan")}, "speed"),
        ({"speed": True}, "speed"),
        ({"speed": "5"}, "speed"),
        ({"speed": None}, "speed"),
        ({"loop": 1}, "loop: expected true or false, found 1"),
        ({"pause_s": 3}, "pause_s: expected 2 numbers"),
        ({"pause_s": [4, 3]}, "shortest first"),
        ({"pause_s": [-1, 3]}, "pause_s"),
        ({"pause_s": [0, 1e9]}, "pause_s"),
        ({"turn_s": -1}, "turn_s"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"seed": 1 << 64}, "seed"),
        ({"walk_m": 0}, "walk_m"),
        ({"walk_m": 1e9}, "walk_m"),
        ({"near": [1, 2]}, "near: expected 3 numbers"),
        ({"path": []}, "path: expected 1 to 10000 points, found 0"),
        ({"path": [[0, 0, 0]] * 10_001}, "found 10001"),
        ({"path": None}, "path: expected"),
        ({"path": 5}, "path: expected"),
        ({"path": "walk.geojson"}, "path: expected"),
        ({"path": [[1, 2]]}, "point 0: expected 3 numbers"),
        ({"path": [[1, 2, 3], [1, 2, 1e8]]}, "point 1: expected a number"),
        ({"path": [[1, 2, float("inf")]]}, "found inf"),
        ({"path": {"type": "Point", "coordinates": [1, 2]}}, "expected a GeoJSON LineString, found 'Point'"),
        ({"path": {"type": "FeatureCollection", "features": []}}, "features: expected one"),
        ({"path": {"type": "Feature", "geometry": None}}, "LineString"),
        ({"path": {"type": "LineString"}}, "coordinates"),
        ({"path": {"type": "LineString", "coordinates": [[1, 2]]}}, "expected a height"),
        ({"path": {"type": "LineString", "coordinates": [[1]]}}, "position 0: expected"),
    ],
)
def test_a_wrong_player_is_refused_with_where_what_and_found(change: dict[str, Any], complaint: str) -> None:
    with pytest.raises(InputError) as refused:
        player_from_json({**WHOLE, **change}, "here")
    assert complaint in str(refused.value)
    assert str(refused.value).startswith("here")
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 300


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from([*WHOLE, "type", "coordinates", "features"]), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(st.dictionaries(st.sampled_from(list(WHOLE)), json_values) | json_values)
@settings(deadline=None)
def test_no_json_does_anything_but_be_a_player_or_be_refused(record: Any) -> None:
    try:
        player = player_from_json(record, "here", new_id="new")
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert player_from_json(json.loads(json.dumps(player.to_json(), allow_nan=False)), "here") == player


def test_a_players_file_survives_being_written_and_read(tmp_path: Path) -> None:
    players = (player_from_json(WHOLE, "here"), Player("b"), Player("c", 30.0, near=(1.0, 2.0, 3.0)))
    file = tmp_path / "players.json"
    file.write_text(json.dumps([player.to_json() for player in players], allow_nan=False))
    assert read_players(file) == players
    file.write_text("[]")
    assert read_players(file) == ()


def test_a_toml_file_names_paths_beside_it(tmp_path: Path) -> None:
    (tmp_path / "line.geojson").write_text(json.dumps(LINE))
    (tmp_path / "players.toml").write_text('[[player]]\nid = "a"\npath = "line.geojson"\nspeed = 5\n[[player]]\nid = "b"\n')
    a, b = read_players(tmp_path / "players.toml")
    assert a == Player("a", 5.0, ((10.0, 1.6, 20.0), (30.5, 2.0, -4.0)))
    assert b == Player("b")
    (tmp_path / "none.toml").write_text("")
    assert read_players(tmp_path / "none.toml") == ()


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("p.json", "", "JSON or TOML"),
        ("p.json", "{}", "expected a list"),
        ("p.json", "[" * 100_000, "JSON or TOML"),
        ("p.json", "1" * 5000, "JSON or TOML"),
        ("p.json", '[{"id": "a"}, {"id": "a"}]', "'a' twice"),
        ("p.json", '[{"id": "a"}, {"speed": 1}]', "player 1: id"),
        ("p.json", json.dumps([{"id": f"p{i}"} for i in range(1001)]), "at most 1000"),
        ("p.json", '[{"id": "a", "path": "gone.geojson"}]', "gone.geojson: cannot be read"),
        ("p.json", '[{"id": "a", "path": "zero\\u0000"}]', "cannot be read"),
        ("p.json", '[{"id": "a", "path": "p.json"}]', "expected a GeoJSON LineString"),
        ("p.json", '[{"id": "a", "path": ""}]', "cannot be read"),
        ("p.json", b"\xff\xfe", "UTF-8"),
        ("p.toml", "[player]\nid = 'a'", "expected a list"),
        ("p.toml", "[[players]]\nid = 'a'", "player"),
        ("p.toml", "[[player]", "JSON or TOML"),
        ("p.toml", "[[player]]\nid = 'a'\nspeed = 2024-01-01", "speed"),
    ],
)
def test_a_wrong_file_is_refused_with_its_name(tmp_path: Path, name: str, text: str | bytes, complaint: str) -> None:
    file = tmp_path / name
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(InputError) as refused:
        read_players(file)
    assert complaint in str(refused.value)
    assert str(tmp_path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_or_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_players(tmp_path / "gone.json")
    monkeypatch.setattr("server.players.MAX_FILE_BYTES", 10)
    (tmp_path / "large.json").write_text("[" + " " * 20 + "]")
    with pytest.raises(InputError, match="at most 10 bytes"):
        read_players(tmp_path / "large.json")
