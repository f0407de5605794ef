"""world.json is not trusted: whatever is in it, a dataset opens right or is refused by name, with one clear line."""

import base64
import contextlib
import copy
import json
import shutil
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bake_jobs.runner import bake
from gi_core.constants import ROOM_CELL_M
from gi_core.dataset import MAX_WORLD_BYTES, Dataset, WorldInfo, write_world
from gi_core.errors import CorruptFileError, FormatError, FormatVersionError, InputError, SectorlightError
from gi_core.grid import SectorIndex
from gi_core.rooms import pack_cells, rooms_of
from gi_core.world import Decal, Opening
from server.cli import main

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
RECORD: dict[str, Any] = json.loads((GOLDEN / "world.json").read_bytes())


def at(*path: Any, **change: Any) -> dict[str, Any]:
    """The golden record with the member at ``path`` set to ``to``, or removed."""
    record = copy.deepcopy(RECORD)
    parent = record
    for step in path[:-1]:
        parent = parent[step]
    if change:
        parent[path[-1]] = change["to"]
    else:
        del parent[path[-1]]
    return record


def read(record: Any) -> WorldInfo:
    """A record, by way of its text: what JSON can't carry must not reach the test."""
    return WorldInfo.from_json(json.loads(json.dumps(record)), "city/world.json")


def test_what_is_written_is_what_is_read(tmp_path):
    world = read(RECORD)
    assert json.loads(json.dumps(world.to_json())) == RECORD
    write_world(tmp_path, world)
    assert (tmp_path / "world.json").read_bytes() == (GOLDEN / "world.json").read_bytes()
    assert world.sectors[SectorIndex(-1, 0)].probes == RECORD["sectors"]["-1,0"]["probes"]
    assert world.counts["probes"] == sum(facts["probes"] for facts in RECORD["sectors"].values())


@pytest.mark.parametrize("version", [0, 7, 999])
def test_another_version_is_named_and_says_what_to_do(version):
    with pytest.raises(FormatVersionError, match=rf"city/world\.json: dataset version {version}, .* versions 1 to 6; bake it again"):
        read(at("version", to=version))


def test_version_2_says_what_its_sky_patches_are():
    record = at("version", to=2) | {"sky": "patches", "sky_patches": 48, "basis": "sh2"}
    world = read(record)
    assert (world.basis, world.sky, world.sky_patches) == ("sh2", "patches", 48)
    assert json.loads(json.dumps(world.to_json())) == record
    for wrong in ({"sky": "cloudy"}, {"sky_patches": 3}, {"sky_patches": 1025}, {"sky": "faces"}, {"basis": "sh3"}):
        with pytest.raises(CorruptFileError, match="|".join(("sky", "basis"))):
            read(record | wrong)
    with pytest.raises(CorruptFileError, match="missing \\['sky'\\]"):
        read({name: value for name, value in record.items() if name != "sky"})
    # The first version had no other sky than the talk's, and a bake of that kind is still written as such.
    assert (read(RECORD).sky, read(RECORD | {"version": 2, "sky": "faces"}).version) == ("faces", 1)
    with pytest.raises(CorruptFileError, match="unknown"):
        read(RECORD | {"sky": "faces"})


DECAL = {"name": "taxi", "position": [10.0, 0.25, 12.0], "size": [1.8, 1.25, 4.6], "yaw_degrees": 30.0}


def test_version_4_has_decals_and_no_other_has():
    record = RECORD | {"version": 4, "sky": "faces", "decals": [DECAL]}
    world = read(record)
    assert world.decals == (Decal("taxi", (10.0, 0.25, 12.0), (1.8, 1.25, 4.6), 30.0),)
    assert json.loads(json.dumps(world.to_json())) == record
    # A world without any is written as what it was before there were decals.
    assert (read(RECORD).decals, read(record | {"decals": []}).version) == ((), 1)
    with pytest.raises(CorruptFileError, match="unknown"):
        read(RECORD | {"decals": [DECAL]})
    with pytest.raises(CorruptFileError, match="missing \\['decals'\\]"):
        read({name: value for name, value in record.items() if name != "decals"})


@pytest.mark.parametrize(
    ("member", "wrong"),
    [
        ("name", 3),
        ("position", [0, 0]),
        ("position", [0, 0, float("nan")]),
        ("size", [1, 1, 0]),
        ("size", [1, -1, 1]),
        ("size", [1, 1, 1e6]),
        ("yaw_degrees", 361),
        ("yaw_degrees", True),
        ("colour", 1),
    ],
)
def test_a_decal_that_is_no_box_is_refused_by_name(member, wrong):
    with pytest.raises(CorruptFileError, match=rf"decals.*{member}"):
        read(RECORD | {"version": 4, "sky": "faces", "decals": [DECAL | {member: wrong}]})


RECORD_5 = json.loads((GOLDEN.parent / "v5" / "world.json").read_bytes())


def test_version_5_has_openings_and_cells_of_rooms_and_no_other_has(tmp_path):
    world = read(RECORD_5)
    assert json.loads(json.dumps(world.to_json())) == RECORD_5
    hall, found = world.rooms
    assert (hall.is_found, hall.openings) == (False, (Opening((43.0, 0.0, 40.0), (44.0, 2.0, 40.0)),))
    assert found.cells == pack_cells(np.argwhere(l_of_cells())[:, [2, 0, 1]] + [-128, 0, 64])
    # Inside its box the room is an L.
    corner = np.array([[-49.0, 1, 26], [-49, 1, 31], [-41, 1, 26], [-41, 1, 31]])
    assert rooms_of(corner, world.rooms).tolist() == [2, 2, 2, 0]
    # A world of authored boxes without an opening is written as what it was before there were any.
    plain = [room | {"openings": [], "cells": None} for room in RECORD_5["rooms"][:1]]
    assert read(RECORD_5 | {"rooms": plain, "decals": []}).version == 1
    with pytest.raises(CorruptFileError, match="unknown"):
        read(RECORD | {"rooms": RECORD_5["rooms"]})


def l_of_cells():
    air = np.ones((8, 16, 24), bool)
    air[:, 8:, 12:] = False
    return air


@pytest.mark.parametrize(
    ("place", "wrong"),
    [
        (("openings",), None),
        (("openings",), [{"minimum": [0, 0, 0]}]),
        (("openings", 0, "minimum"), [0, 0, "0"]),
        (("cells", "first"), [0, 0]),
        (("cells", "first"), [0, 0, 0.5]),
        (("cells", "shape"), [0, 8, 16]),
        (("cells", "shape"), [25, 8, 16]),
        (("cells", "shape"), [1 << 26, 1 << 26, 1 << 26]),
        (("cells", "bits"), "?"),
        (("cells", "bits"), "AAAA"),
        (("cells", "bits"), base64.b64encode(zlib.compress(bytes(1 << 20))).decode()),
        (("cells", "bits"), base64.b64encode(zlib.compress(bytes(24 * 8 * 16 // 8))[:-4]).decode()),
        (("cells", "colour"), 1),
    ],
)
def test_a_found_room_that_is_none_is_refused_by_name(place, wrong):
    record = copy.deepcopy(RECORD_5)
    within = record["rooms"][1]
    for name in place[:-1]:
        within = within[name]
    within[place[-1]] = wrong
    with pytest.raises(CorruptFileError, match=rf"rooms.*{place[0]}.*; bake it again"):
        read(record)


RECORD_6 = json.loads((GOLDEN.parent / "v6_sector2" / "world.json").read_bytes())


def test_version_6_has_doors_between_rooms_and_cells_of_any_width_and_no_other_has():
    world = read(RECORD_6)
    assert json.loads(json.dumps(world.to_json())) == RECORD_6
    hall, vault = world.rooms
    door = Opening((50.0, 0.0, 43.0), (50.25, 2.0, 44.0), 2)
    assert hall.openings == (Opening((43.0, 0.0, 40.0), (44.0, 2.0, 40.0)), door)
    assert (vault.name, vault.is_found, vault.openings) == ("vault", False, (replace(door, to=1),))
    assert vault.cells.size_m == ROOM_CELL_M / 4
    at = np.array([[50.5, 1, 41], [50.5, 1, 43], [56, 1, 41], [56, 1, 43]])
    assert rooms_of(at, world.rooms).tolist() == [2, 2, 2, 0]
    # Without either it is of version 5, whose cells are of one width.
    before = copy.deepcopy(RECORD_6)
    before["rooms"] = [before["rooms"][0] | {"openings": before["rooms"][0]["openings"][:1]}]
    assert read(before).version == 5
    with pytest.raises(CorruptFileError, match="unknown"):
        read(RECORD_5 | {"rooms": RECORD_6["rooms"]})


@pytest.mark.parametrize(
    ("place", "wrong"),
    [
        ((0, "openings", 1, "to"), 3),
        ((0, "openings", 1, "to"), 1),
        ((0, "openings", 1, "to"), -1),
        ((0, "openings", 1, "to"), 1.5),
        ((1, "cells", "size_m"), 0),
        ((1, "cells", "size_m"), "0.4"),
    ],
)
def test_a_door_to_nowhere_and_cells_of_no_width_are_refused_by_name(place, wrong):
    record = copy.deepcopy(RECORD_6)
    within = record["rooms"]
    for name in place[:-1]:
        within = within[name]
    within[place[-1]] = wrong
    with pytest.raises(CorruptFileError, match=rf"rooms.*{place[1]}.*{place[-1]}: expected.*; bake it again"):
        read(record)


def test_more_decals_than_the_limit_are_refused(monkeypatch):
    monkeypatch.setattr("gi_core.dataset.MAX_DECALS", 1)
    with pytest.raises(CorruptFileError, match="decals: expected a list of at most 1"):
        read(RECORD | {"version": 4, "sky": "faces", "decals": [DECAL] * 2})


def test_info_exits_with_2_and_one_line_for_another_version(tmp_path, monkeypatch, capsys):
    (tmp_path / "world.json").write_text(json.dumps(at("version", to=8)))
    monkeypatch.setattr(sys, "argv", ["sectorlight", "info", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        main()
    out, err = capsys.readouterr()
    assert (ended.value.code, out) == (2, "")
    assert err.count("\n") == 1
    assert "version 8" in err
    assert "bake it again" in err


MEMBERS = [
    *((name,) for name in RECORD if name not in ("format", "version")),
    *(("location", name) for name in RECORD["location"]),
    *(("sectors", "0,0", name) for name in RECORD["sectors"]["0,0"]),
    *(("rooms", 0, name) for name in RECORD["rooms"][0]),
    *(("lamps", 0, name) for name in RECORD["lamps"][0]),
    *(("sun_table", name) for name in RECORD["sun_table"]),
]


@pytest.mark.parametrize("path", MEMBERS, ids=lambda path: ".".join(map(str, path)))
def test_a_member_that_is_missing_or_of_another_type_is_refused_by_name(path):
    with pytest.raises(CorruptFileError, match=str(path[-1])):
        read(at(*path))
    # No member may be a list of lists of booleans, or true.
    for wrong in ([[True]], True):
        with pytest.raises(CorruptFileError):
            read(at(*path, to=wrong))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("bounds",), [[0, 0, 0], [float("nan"), 1, 1]]),
        (("bounds",), [[0, 0, 0], [float("inf"), 1, 1]]),
        (("bounds",), [[0, 0, 0]]),
        (("bounds",), [[0, 0, 0]] * 3),
        (("bounds",), [[0, 0], [1, 1]]),
        (("bounds",), [[2, 0, 0], [1, 1, 1]]),
        (("bounds",), [[0, 0, 0], [10**400, 1, 1]]),
        (("basis",), "sh9"),
        (("sky_patches",), 1_000_000_000),
        (("sky_patches",), -1),
        (("sky_patches",), float("inf")),
        (("seed",), -1),
        (("seed",), 1.5),
        (("name",), "\ud800"),
        (("name",), "x" * 5000),
        (("unheard_of",), 1),
        (("settings",), {"knob": float("nan")}),
        (("settings",), {"knob": 10**400}),
        (("settings",), {"voxel_probes": "many"}),
        (("settings",), {"feedback_probes": 0}),
        (("settings",), {"knob": json.loads("[" * 900 + "]" * 900)}),
        (("error_report",), []),
        (("error_report",), {"expected_error": "small"}),
        (("error_report",), {"deep": [float("inf")]}),
        (("error_report",), {"states": {"noon": {"shaded": {"median": 10**400}}}}),
        (("location", "latitude_degrees"), 91),
        (("location", "longitude_degrees"), float("nan")),
        (("location", "timezone"), "Mars/Olympus"),
        (("location", "timezone"), "../../etc/passwd"),
        (("location", "date"), "2024-02-30"),
        (("sun_table", "planes"), 22),
        (("sun_table", "declination_step_degrees"), 0),
        (("rooms", 0, "minimum"), [0, 0]),
        (("rooms", 0, "maximum"), [0, 0, float("inf")]),
        (("rooms", 0, "maximum"), [-1e6, 1e6, 1e6]),
        (("rooms",), [[]]),
        (("lamps", 0, "lumens"), -1),
        (("lamps", 0, "color"), [1, 1, float("nan")]),
        (("lamps", 0, "extra"), 1),
        (("dropped_triangles", "degenerate"), -3),
        (("sectors", "0,0", "probes"), -1),
        (("sectors", "0,0", "probes"), "20"),
        (("sectors", "0,0", "extra"), 1),
        *((("sectors", key), RECORD["sectors"]["0,0"]) for key in ("0", "0,", "0,0,0", "a,b", "1_0,0", " 1,0", "01,0", "-0,0", "1.0,0")),
        *((("sectors", key), RECORD["sectors"]["0,0"]) for key in ("\u0661,0", "1000001,0", "9" * 400 + ",0", "")),
    ],
)
def test_a_value_out_of_its_range_is_refused_by_name(path, value):
    with pytest.raises(CorruptFileError, match=r"city/world\.json"):
        read(at(*path, to=value))


@pytest.mark.parametrize("version", [True, "1", 1.5, None, [], 10**400])
def test_a_version_that_is_no_number_is_refused(version):
    with pytest.raises(FormatError):
        read(at("version", to=version))


@pytest.mark.parametrize("record", [[], {}, None, 3, "sectorlight-dataset", {"format": "other"}])
def test_what_is_no_dataset_says_how_to_make_one(record):
    with pytest.raises(InputError, match="sectorlight bake"):
        read(record)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"format": ' * 20_000,
        b"9" * 5000,
        b'{"format":"sectorlight-dataset","version":' + b"1" * 5000 + b"}",
    ],
    ids=["empty", "cut off", "not UTF-8", "deep list", "deep object", "long number", "long version"],
)
def test_a_file_that_is_no_json_is_refused_by_name(tmp_path, text):
    (tmp_path / "world.json").write_bytes(text)
    with pytest.raises(CorruptFileError, match=r"world\.json"):
        Dataset.open(tmp_path)


def test_a_huge_file_is_refused_before_it_is_read(tmp_path, monkeypatch):
    with (tmp_path / "world.json").open("wb") as file:
        file.truncate(MAX_WORLD_BYTES + 1)  # sparse: takes no disk

    def never(_: Path) -> bytes:
        raise AssertionError("read")

    monkeypatch.setattr(Path, "read_bytes", never)
    with pytest.raises(CorruptFileError, match=f"at most {MAX_WORLD_BYTES} bytes, found {MAX_WORLD_BYTES + 1}"):
        Dataset.open(tmp_path)


def test_more_sectors_than_the_limit_are_refused(monkeypatch):
    monkeypatch.setattr("gi_core.dataset.MAX_SECTORS", 1)
    with pytest.raises(CorruptFileError, match="at most 1 sectors, found 2"):
        read(RECORD)


@pytest.mark.parametrize("name", ["missing", "empty"])
def test_a_folder_without_world_json_says_what_was_expected(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=rf"{name}: no world\.json here; expected a folder that `sectorlight bake` wrote"):
        Dataset.open(tmp_path / name)


JSON_LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from([10**400, -(10**20), 1e308, "9" * 50, "\ud800", "NaN", "", {}, [], "0,0", 2**63])
)
JSON_VALUES = st.recursive(JSON_LEAVES, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4))


def every_place(record: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all members and items of a record."""
    steps = list(record) if isinstance(record, dict) else range(len(record)) if isinstance(record, list) else []
    return [place for step in steps for place in ((*path, step), *every_place(record[step], (*path, step)))]


PLACES = every_place(RECORD)


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(st.sampled_from(PLACES), JSON_VALUES, st.sampled_from(["set", "remove", "add"])), min_size=1, max_size=3))
def test_no_change_of_world_json_gives_a_traceback(changes):
    record = copy.deepcopy(RECORD)
    for path, value, action in changes:
        parent = record
        try:
            for step in path[:-1]:
                parent = parent[step]
            if action == "remove":
                del parent[path[-1]]
            elif action == "add" and isinstance(parent, dict):
                parent[f"{path[-1]}!"] = value
            else:
                parent[path[-1]] = value
        except (KeyError, IndexError, TypeError):
            continue  # an earlier change took this place away
    refusal, world = None, None
    try:
        world = read(record)
    except SectorlightError as error:
        refusal = str(error)
    if world is None:
        assert refusal
        assert "\n" not in refusal
        assert len(refusal) < 1000
        return
    # What is accepted can be used and written again, as strict JSON that reads back the same.
    assert world.counts["sectors"] == len(world.sectors)
    text = json.dumps(world.to_json(), allow_nan=False)
    text.encode()
    assert read(json.loads(text)).to_json() == world.to_json()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2200), st.binary(min_size=1, max_size=4))
def test_no_damage_to_the_text_gives_a_traceback(place, octets):
    text = (GOLDEN / "world.json").read_bytes()
    damaged = text[:place] + octets + text[place + len(octets) :]
    try:
        record = json.loads(damaged)
    except ValueError:
        return  # Dataset.open turns these into CorruptFileError: tested above
    with contextlib.suppress(SectorlightError):
        WorldInfo.from_json(record, "here")


@pytest.mark.parametrize("seed", [-1, 1 << 53])
def test_a_seed_that_no_reader_would_accept_is_refused_before_baking(tmp_path, seed):
    with pytest.raises(InputError, match=f"seed: expected .* found {seed}"):
        bake("procedural:midtown?blocks=1x1", tmp_path / "city", "draft", 1, None, seed)
    assert not (tmp_path / "city").exists()


def test_an_unreadable_file_is_the_users_to_mend(tmp_path, monkeypatch):
    shutil.copy(GOLDEN / "world.json", tmp_path)

    def denied(_: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", denied)
    with pytest.raises(InputError, match="Permission denied"):
        Dataset.open(tmp_path)


def test_an_estimate_of_the_error_is_kept_where_the_bake_made_one():
    assert read(RECORD).estimated_error is None
    record = at("sectors", "-1,0", "estimated_error", to=0.034)
    world = read(record)
    assert (world.sectors[SectorIndex(-1, 0)].estimated_error, world.estimated_error) == (0.034, 0.034)
    assert json.loads(json.dumps(world.to_json())) == record
    for wrong in (-0.1, "small", None, True):
        with pytest.raises(CorruptFileError, match="estimated_error"):
            read(at("sectors", "-1,0", "estimated_error", to=wrong))
