"""Volumes of every kind, size and format that the contract has: fog, rooms, cascades, and 3D texture files read by the specification."""

import io
import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

from gi_core.constants import OPENING_DEPTH_M, VOLUME_SHAPE
from gi_core.dataset import Dataset, write_world
from gi_core.rooms import opening_nearness
from gi_core.volume import Volume
from gi_core.world import Opening, Room
from server.app import create_app
from server.routes.volume import volume_facts
from server.settings import Settings

Place = dict[str, Any]


@pytest.fixture
def noon(place: Place) -> Place:
    return {**place, "time": "12:00", "weather": "clear"}


def get(http: httpx.Client, query: Place, **more: Any) -> tuple[bytes, dict[str, Any], str]:
    reply = http.get("/v1/volume", params={**query, **more})
    assert reply.status_code == 200, reply.text
    return reply.content, json.loads(reply.headers["Gi-Volume"]), reply.headers["content-type"]


def array(content: bytes) -> np.ndarray:
    return np.load(io.BytesIO(content), allow_pickle=False)


def refusal(http: httpx.Client, query: Place, **more: Any) -> str:
    reply = http.get("/v1/volume", params={**query, **more})
    assert reply.status_code == 400, reply.text
    return str(reply.json()["detail"])


def room_in(http: httpx.Client) -> tuple[int, dict[str, Any], np.ndarray]:
    """Number, facts and middle of the largest room."""
    rooms = http.get("/v1/world").json()["rooms"]
    sizes = [np.prod(np.subtract(room["maximum"], room["minimum"])) for room in rooms]
    chosen = int(np.argmax(sizes))
    return chosen + 1, rooms[chosen], (np.array(rooms[chosen]["minimum"]) + rooms[chosen]["maximum"]) / 2


def test_fog_is_the_mean_over_directions(http: httpx.Client, noon: Place) -> None:
    cube, fog = array(get(http, noon)[0]), get(http, noon, kind="fog")
    values = array(fog[0])
    assert values.shape == (*VOLUME_SHAPE, 3)
    assert fog[1]["basis"] == "average"
    np.testing.assert_allclose(values, cube.mean(axis=0), rtol=1e-5)
    raw, facts, _ = get(http, noon, kind="fog", format="raw")
    texels = np.frombuffer(raw, "<f2").reshape(facts["shape"])
    assert texels.shape == (*VOLUME_SHAPE, 4)
    np.testing.assert_allclose(texels[..., :3] * np.float32(facts["scale"]), values, rtol=2**-11, atol=2**-25 * facts["scale"])
    assert len(get(http, noon, kind="fog", format="raw", encoding="rgb9e5")[0]) == 4 * values[..., 0].size


def read_ktx2(data: bytes) -> dict[str, Any]:
    """A KTX 2.0 file by the specification alone."""
    assert data[:12] == bytes.fromhex("AB4B5458203230BB0D0A1A0A")
    names = ("vkFormat", "typeSize", "width", "height", "depth", "layers", "faces", "levels", "scheme")
    found: dict[str, Any] = dict(zip(names, struct.unpack_from("<9I", data, 12), strict=True))
    descriptor_at, descriptor_bytes, pairs_at, pairs_bytes = struct.unpack_from("<4I", data, 48)
    assert struct.unpack_from("<2Q", data, 64) == (0, 0)
    level_at, level_bytes, whole_bytes = struct.unpack_from("<3Q", data, 80)
    assert level_bytes == whole_bytes == len(data) - level_at
    assert descriptor_at == 104
    assert pairs_at == descriptor_at + descriptor_bytes
    assert struct.unpack_from("<I", data, descriptor_at)[0] == descriptor_bytes
    kind, version, block_bytes, model, primaries, transfer, flags = struct.unpack_from("<IHH4B", data, descriptor_at + 4)
    assert (kind, version, block_bytes) == (0, 2, descriptor_bytes - 4)
    assert (model, primaries, transfer, flags) == (1, 1, 1, 0)  # RGBSDA, BT.709, linear, straight alpha
    assert data[descriptor_at + 16 : descriptor_at + 20] == bytes(4)  # texel blocks of 1 x 1 x 1
    found["texel_bytes"] = data[descriptor_at + 20]
    samples = (block_bytes - 24) // 16
    found["samples"] = [struct.unpack_from("<HBB4x2I", data, descriptor_at + 28 + 16 * i) for i in range(samples)]
    found["pairs"], at = {}, pairs_at
    while at < pairs_at + pairs_bytes:
        size = struct.unpack_from("<I", data, at)[0]
        key, value = data[at + 4 : at + 4 + size].split(b"\0", 1)
        found["pairs"][key.decode()] = value.rstrip(b"\0").decode()
        at += 4 + size + -size % 4
    assert list(found["pairs"]) == sorted(found["pairs"])
    assert level_at % np.lcm(found["texel_bytes"], 4) == 0
    found["data"] = data[level_at:]
    return found


def face_of(texture: np.ndarray, axis: int, positive: bool) -> np.ndarray:
    """A face (y, z, x, ...) of bevy's texture (3 Rz, 2 Ry, Rx, ...): the half further along the height is the negative one."""
    ny, nz, _ = VOLUME_SHAPE
    part = texture[axis * nz : (axis + 1) * nz, (not positive) * ny : (1 + (not positive)) * ny]
    return np.swapaxes(part, 0, 1)


def bevy_light(texture: np.ndarray, voxel: tuple[int, int, int], normal: np.ndarray) -> np.ndarray:
    """Light (3,) at a voxel (x, y, z) along a normal, in texture coordinates as bevy's irradiance_volume.wgsl works them out."""
    atlas = np.array(texture.shape[2::-1], float)  # textureDimensions: width, height, depth
    uvw = (np.array(voxel) + 0.5) / atlas
    total = np.zeros(3)
    for axis in range(3):
        at = uvw + np.array([0.0, 0.5 if normal[axis] < 0 else 0.0, axis / 3])
        x, y, z = np.floor(at * atlas).astype(int)
        total += normal[axis] ** 2 * texture[z, y, x, :3]
    return total


def test_bevy_s_shader_finds_the_light_that_the_cube_has(http: httpx.Client, noon: Place) -> None:
    cube = array(get(http, noon)[0])
    content, facts, _ = get(http, noon, format="ktx2")
    texture = np.frombuffer(read_ktx2(content)["data"], "<f2").reshape(96, 32, 32, 4).astype(float) * facts["scale"]
    rng = np.random.default_rng(4)
    for _ in range(50):
        voxel = tuple(int(rng.integers(count)) for count in (32, 16, 32))
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        x, y, z = voxel
        expected = sum(normal[axis] ** 2 * cube[2 * axis + (normal[axis] < 0), y, z, x] for axis in range(3))
        # rtol 2^-11: rounding of a half
        np.testing.assert_allclose(bevy_light(texture, voxel, normal), expected, rtol=2**-11, atol=2**-25 * facts["scale"])


def test_ktx2_holds_the_raw_halves_where_bevy_reads_them(http: httpx.Client, noon: Place) -> None:
    raw, facts, _ = get(http, noon, format="raw")
    halves = np.frombuffer(raw, "<f2").reshape(facts["shape"])
    content, described, media = get(http, noon, format="ktx2")
    file = read_ktx2(content)
    assert media == "image/ktx2"
    assert (file["vkFormat"], file["typeSize"], file["texel_bytes"]) == (97, 2, 8)  # VK_FORMAT_R16G16B16A16_SFLOAT
    assert (file["width"], file["height"], file["depth"]) == (32, 2 * 16, 3 * 32)
    assert (file["layers"], file["faces"], file["levels"], file["scheme"]) == (0, 1, 1, 0)
    assert [(at, bits, channel) for at, bits, channel, _, _ in file["samples"]] == [
        (0, 15, 0xC0), (16, 15, 0xC1), (32, 15, 0xC2), (48, 15, 0xCF)
    ]  # fmt: skip
    assert {struct.unpack("<2f", struct.pack("<2I", low, high)) for _, _, _, low, high in file["samples"]} == {(-1.0, 1.0)}
    texture = np.frombuffer(file["data"], "<f2").reshape(96, 32, 32, 4)
    for face in range(6):
        np.testing.assert_array_equal(face_of(texture, face // 2, face % 2 == 0), halves[face])
    assert json.loads(file["pairs"]["Gi-Volume"]) == described
    assert (file["pairs"]["KTXwriter"], file["pairs"]["KTXorientation"]) == ("Sectorlight", "ruo")
    assert described["scale"] == facts["scale"]
    assert described["shape"] == [96, 32, 32, 4]


def test_ktx2_of_shared_exponents_and_of_single_fields(http: httpx.Client, noon: Place) -> None:
    raw = np.frombuffer(get(http, noon, format="raw", encoding="rgb9e5")[0], "<u4").reshape(6, *VOLUME_SHAPE)
    file = read_ktx2(get(http, noon, format="ktx2", encoding="rgb9e5")[0])
    assert (file["vkFormat"], file["typeSize"], file["texel_bytes"]) == (123, 4, 4)  # VK_FORMAT_E5B9G9R9_UFLOAT_PACK32
    texture = np.frombuffer(file["data"], "<u4").reshape(96, 32, 32)
    for face in range(6):
        np.testing.assert_array_equal(face_of(texture, face // 2, face % 2 == 0), raw[face])
    assert [(at, bits) for at, bits, *_ in file["samples"]] == [(0, 8), (27, 4), (9, 8), (27, 4), (18, 8), (27, 4)]

    fog = np.frombuffer(get(http, noon, kind="fog", format="raw")[0], "<f2").reshape(*VOLUME_SHAPE, 4)
    file = read_ktx2(get(http, noon, kind="fog", format="ktx2")[0])
    assert (file["width"], file["height"], file["depth"]) == (32, 16, 32)
    np.testing.assert_array_equal(np.frombuffer(file["data"], "<f2").reshape(32, 16, 32, 4), np.swapaxes(fog, 0, 1))

    mask = array(get(http, noon, mask=1)[0])
    file = read_ktx2(get(http, noon, mask=1, format="ktx2")[0])
    assert (file["vkFormat"], file["texel_bytes"]) == (13, 1)  # VK_FORMAT_R8_UINT
    np.testing.assert_array_equal(np.frombuffer(file["data"], "u1").reshape(32, 16, 32), np.swapaxes(mask, 0, 1))


@pytest.mark.parametrize("cascade", [1, 2, 3])
def test_cascades_double_in_size_and_average_what_is_inside(http: httpx.Client, noon: Place, cascade: int) -> None:
    content, facts, _ = get(http, noon, cascade=cascade)
    values, mask = array(content), array(get(http, noon, cascade=cascade, mask=1)[0])
    size = 3.125 * 2**cascade
    assert values.shape == (6, *VOLUME_SHAPE, 3)
    assert facts["voxel_size"] == [size] * 3
    assert facts["cascade"] == cascade
    np.testing.assert_allclose(np.array(facts["origin"]) / size % 1, 0.5)
    middle = np.array(facts["origin"]) + size * (np.array([32, 16, 32]) - 1) / 2
    assert (np.abs(middle - [float(noon[axis]) for axis in "xyz"]) <= size).all()
    assert (values.max(axis=(0, 4)) > 0).all()  # by day no voxel is black, nor is one without a sector
    # A coarse voxel that lies wholly in the talk's volume is the mean of its voxels' open air.
    fine, fine_facts, _ = get(http, noon)
    light, kinds = array(fine), array(get(http, noon, mask=1)[0])
    first = np.round(np.array(fine_facts["origin"]) / 3.125 - 0.5).astype(int)
    coarse_first = np.round(np.array(facts["origin"]) / size - 0.5).astype(int)
    step, checked = 2**cascade, 0
    for y, z, x in np.argwhere(mask == 1):
        low = (coarse_first + np.array([x, y, z])) * step - first
        if (low >= 0).all() and (low + step <= [32, 16, 32]).all():
            part = (slice(low[1], low[1] + step), slice(low[2], low[2] + step), slice(low[0], low[0] + step))
            if (kinds[part] == 3).any():
                continue
            open_air = kinds[part] == 1
            expected = light[(slice(None), *part)][:, open_air].mean(axis=1)
            np.testing.assert_allclose(values[:, y, z, x], expected, rtol=1e-3, atol=1)
            checked += 1
    assert checked > 5


def test_what_is_not_there_is_refused_by_name(http: httpx.Client, noon: Place) -> None:
    assert "no fine voxels; expected 0 to 3, or a bake with --quality reference" in refusal(http, noon, cascade=-1)
    assert "less than or equal to 3" in refusal(http, noon, cascade=4)
    assert "room with kind=interior only" in refusal(http, noon, room="hall")
    assert "cascade=0 of kind=interior" in refusal(http, noon, kind="interior", cascade=1)
    assert "no basis of kind=fog" in refusal(http, noon, kind="fog", basis="sh2")
    assert "expected one of 'block" in refusal(http, noon, kind="interior", room="nowhere")
    assert "or a number of 1 to" in refusal(http, noon, kind="interior", room="99999")
    number, room, middle = room_in(http)
    high = {**noon, "x": middle[0], "y": middle[1] + 60, "z": middle[2]}
    assert f"reaches no voxel of room {room['name']!r}" in refusal(http, high, kind="interior", room=number)


def test_an_interior_is_of_one_room_alone(http: httpx.Client, noon: Place) -> None:
    number, room, middle = room_in(http)
    inside = {**noon, **dict(zip("xyz", middle.tolist(), strict=True))}
    content, facts, _ = get(http, inside, kind="interior")
    assert [found["number"] for found in facts["rooms"]] == [number]
    assert facts["rooms"][0]["minimum"] == room["minimum"]
    for named in (room["name"], str(number)):
        assert get(http, inside, kind="interior", room=named)[0] == content
    values, mask = array(content), array(get(http, inside, kind="interior", mask=1)[0])
    both = array(get(http, inside, mask=1)[0])
    assert set(np.unique(both[mask == 2])) == {2}
    y, z, x = np.nonzero(mask == 2)
    centre = np.array(facts["origin"]) + 3.125 * np.stack([x, y, z], axis=1)
    assert ((centre >= room["minimum"]) & (centre <= room["maximum"])).all()
    # Everywhere else stands what some voxel of the room has.
    own = values[:, mask == 2].transpose(1, 0, 2).reshape(len(x), -1)
    others = values[:, mask != 2].transpose(1, 0, 2).reshape((mask != 2).sum(), -1)
    assert {row.tobytes() for row in np.unique(others, axis=0)} <= {row.tobytes() for row in own}
    texels = np.frombuffer(get(http, inside, kind="interior", format="raw")[0], "<f2").reshape(6, *VOLUME_SHAPE, 4)
    np.testing.assert_array_equal(texels[0, ..., 3], mask == 2)
    outdoors = np.frombuffer(get(http, inside, format="raw")[0], "<f2").reshape(6, *VOLUME_SHAPE, 4)
    np.testing.assert_array_equal(outdoors[0, ..., 3], both == 1)


def test_a_header_tells_of_the_rooms_that_the_volume_reaches(http: httpx.Client, noon: Place) -> None:
    """A header of a whole city's rooms would be megabytes."""
    rooms = http.get("/v1/world").json()["rooms"]
    assert [room["number"] for room in rooms] == list(range(1, len(rooms) + 1))
    _, _, middle = room_in(http)
    on_the_roof = {**noon, "x": middle[0], "y": middle[1] + 12, "z": middle[2]}
    facts = get(http, on_the_roof, kind="interior")[1]
    mask, told = array(get(http, on_the_roof, kind="interior", mask=1)[0]), facts["rooms"]
    y, z, x = np.nonzero(mask == 2)
    centre = np.array(facts["origin"]) + 3.125 * np.stack([x, y, z], axis=1)
    reached = [r for r in rooms if ((centre >= r["minimum"]) & (centre <= r["maximum"])).all(axis=1).any()]
    assert told == [{name: r[name] for name in ("number", "name", "minimum", "maximum")} for r in reached[:16]]
    assert facts["rooms_reached"] == len(reached) > 0


def solid_angle(a: Any, b: Any, c: Any) -> Any:
    """Of triangles (n, 3) seen from the origin (van Oosterom and Strackee, 1983)."""
    x, y, z = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c)))
    dots = (np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (a, c), (b, c)))
    ab, ac, bc = dots
    return 2 * np.arctan2(volume, x * y * z + ab * z + ac * y + bc * x)


def test_a_weight_is_sharp_at_walls_and_smooth_through_openings(http: httpx.Client, noon: Place) -> None:
    _, room, middle = room_in(http)
    inside = {**noon, **dict(zip("xyz", middle.tolist(), strict=True))}
    content, facts, _ = get(http, inside, kind="interior", weight=1)
    weight = array(content)
    assert (weight.shape, weight.dtype, facts["dtype"], facts["shape"]) == ((2, 64, 128, 128), np.uint8, "uint8", [2, 64, 128, 128])
    assert get(http, inside, kind="interior", weight=1, format="raw")[0] == weight.tobytes()
    assert facts["voxel_size"] == [0.78125] * 3
    at = (
        np.stack(np.meshgrid(*(np.arange(n) for n in weight.shape[1:]), indexing="ij"), axis=-1)[..., [2, 0, 1]] * 0.78125 + facts["origin"]
    )
    np.testing.assert_array_equal(weight[0] == 255, ((at >= room["minimum"]) & (at <= room["maximum"])).all(axis=-1))
    assert set(np.unique(weight[0]).tolist()) == {0, 255}
    # Of the openings, rectangles across their boxes' shortest side, the one that fills most of the view; each as a pair of triangles.
    chosen = np.random.default_rng(2).choice(np.flatnonzero(weight[1].ravel() > 0), 500)
    eye, view = at.reshape(-1, 3)[chosen], np.zeros(500)
    for opening in room["openings"]:
        low, high = np.array(opening["minimum"]), np.array(opening["maximum"])
        axis = int(np.argmin(high - low))
        nearer, deep = eye.copy(), high[axis] - low[axis]
        assert 0.2 < deep < 0.5  # through the wall
        low[axis] = high[axis] = low[axis] + deep / 2
        off = eye[:, axis] - low[axis]
        nearer[:, axis] -= np.sign(off) * np.minimum(np.abs(off) - 1e-9, 0.390625 + deep / 2)
        corners = np.stack([low, low, high, high])
        corners[1, (axis + 1) % 3], corners[3, (axis + 1) % 3] = high[(axis + 1) % 3], low[(axis + 1) % 3]
        a, b, c, d = (corner - nearer for corner in corners)
        view = np.maximum(view, (solid_angle(a, b, c) + solid_angle(a, c, d)) / (2 * np.pi))
    np.testing.assert_allclose(weight[1].ravel()[chosen], 255 * np.clip((view - 0.25) / 0.75, 0, 1), atol=0.6)
    assert weight[1].max() == 255
    # mask=1 says what it always said.
    assert set(np.unique(array(get(http, inside, kind="interior", mask=1)[0])).tolist()) <= {0, 1, 2, 3}
    for wrong in ({"mask": 1}, {"format": "ktx2"}):
        assert "weight with kind=interior, format=npy or raw, and no mask" in refusal(http, inside, kind="interior", weight=1, **wrong)
    assert "weight with kind=interior" in refusal(http, inside, weight=1)


def test_a_weight_to_another_room_is_of_the_doors_between_them(serving: Any, city: Path, tmp_path: Path, noon: Place) -> None:
    """The tiny city with a door drawn from one of its rooms to another: its sectors know of none."""
    joined = tmp_path / "joined"
    shutil.copytree(city, joined)
    world = Dataset.open(city).world
    first, second, *others = world.rooms
    middle = (np.array(first.minimum) + first.maximum) / 2
    low, high = (first.maximum[0], middle[1] - 1, middle[2] - 1), (first.maximum[0] + 0.25, middle[1] + 1, middle[2] + 1)
    rooms = (
        replace(first, openings=(*first.openings, Opening(low, high, 2))),
        replace(second, openings=(*second.openings, Opening(low, high, 1))),
        *others,
    )
    write_world(joined, replace(world, rooms=rooms))
    inside = {**noon, **dict(zip("xyz", middle.tolist(), strict=True)), "kind": "interior", "weight": 1, "room": first.name}
    with serving(create_app(joined, Settings())) as client:
        told = client.get("/v1/world").json()["rooms"]
        assert told[0]["doors"] == [{"minimum": list(low), "maximum": list(high), "to": 2}]
        assert [len(told[0]["openings"]), told[1]["doors"][0]["to"]] == [len(first.openings), 1]
        to_the_street, to_the_room = (array(get(client, inside, **more)[0]) for more in ({}, {"to": second.name}))
        facts = get(client, inside, to="2")[1]
        grid = np.meshgrid(*(np.arange(n) for n in to_the_room.shape[1:]), indexing="ij")
        at = np.stack([grid[axis] for axis in (2, 0, 1)], axis=-1) * facts["voxel_size"] + facts["origin"]
        near = opening_nearness(rooms[0], at.reshape(-1, 3), 2, OPENING_DEPTH_M).reshape(at.shape[:-1])
        np.testing.assert_allclose(to_the_room[1], 255 * near, atol=0.51)
        assert to_the_room[1].any()
        # What is asked for without `to` is what it was before there were doors.
        with serving(create_app(city, Settings())) as before:
            np.testing.assert_array_equal(to_the_street, array(get(before, inside)[0]))
        assert f"to: expected a room behind a door ({second.name!r})" in refusal(client, inside, to=first.name)
        assert "expected one of" in refusal(client, inside, to="nowhere")
        for wrong in ({"weight": 0}, {"room": None}):
            query = {name: value for name, value in (inside | wrong).items() if value is not None}
            assert "to with weight=1 and room only" in refusal(client, query, to="2")


def test_a_header_stays_small_whatever_the_world_has() -> None:
    volume = Volume(
        values=np.ones((6, *VOLUME_SHAPE, 3), np.float32),
        mask=np.full(VOLUME_SHAPE, 2, np.uint8),
        first_voxel=np.zeros(3, np.int64),
        sectors=(),
        rooms=tuple(range(1, 1001)),
    )
    rooms = tuple(Room(f"room {i}", (0, 0, 0), (1, 1, 1)) for i in range(1000))
    facts = volume_facts(volume, volume.values.shape, "float32", 1.0, rooms)
    assert [room["number"] for room in facts["rooms"]] == list(range(1, 17))
    assert facts["rooms_reached"] == 1000


def test_world_says_what_can_be_asked_for(http: httpx.Client) -> None:
    world = http.get("/v1/world").json()
    assert world["kinds"] == ["outdoor", "fog", "interior"]
    assert world["cascades"] == [0, 1, 2, 3]


def test_the_sky_as_openexr_is_the_sky(http: httpx.Client) -> None:
    query = {"time": "09:30", "weather": "partly_cloudy"}
    expected = array(http.get("/v1/sky", params=query).content)
    reply = http.get("/v1/sky", params={**query, "format": "exr"})
    assert reply.headers["content-type"] == "image/x-exr"
    data = reply.content
    assert struct.unpack_from("<2i", data) == (20000630, 2)
    at, attributes = 8, {}
    while data[at]:
        name, kind, rest = data[at:].split(b"\0", 2)
        size = struct.unpack_from("<i", rest)[0]
        attributes[name.decode()] = (kind.decode(), rest[4 : 4 + size])
        at += len(name) + len(kind) + 2 + 4 + size
    assert attributes["compression"] == ("compression", b"\0")
    assert struct.unpack("<4i", attributes["dataWindow"][1]) == (0, 0, 127, 63)
    names = [attributes["channels"][1][i : i + 1] for i in range(0, 54, 18)]
    assert names == [b"B", b"G", b"R"]
    lines = struct.unpack_from("<64Q", data, at + 1)
    for row, line in enumerate(lines):
        assert struct.unpack_from("<2i", data, line) == (row, 12 * 128)
        blue, green, red = np.frombuffer(data, "<f4", 3 * 128, line + 8).reshape(3, 128)
        np.testing.assert_array_equal(np.stack([red, green, blue], axis=1), expected[row])
    assert len(data) == lines[-1] + 8 + 12 * 128


def test_the_sky_as_openexr_opens_in_openexr(http: httpx.Client, tmp_path: Any) -> None:
    openexr = pytest.importorskip("OpenEXR", reason="the extra `sky` is not installed")
    query = {"time": "12:00", "weather": "clear"}
    path = tmp_path / "sky.exr"
    path.write_bytes(http.get("/v1/sky", params={**query, "format": "exr"}).content)
    channels = openexr.File(str(path)).channels()
    picture = channels["RGB"].pixels if "RGB" in channels else np.stack([channels[c].pixels for c in "RGB"], axis=2)
    np.testing.assert_array_equal(picture, array(http.get("/v1/sky", params=query).content))


def test_a_picture_shows_a_room_without_its_interior_volume(http: httpx.Client, noon: Place) -> None:
    """The street's light at noon, which the walls keep out."""
    _, _, middle = room_in(http)
    look = {"eye": ",".join(map(str, middle)), "look": ",".join(map(str, middle - (1.0, 0.3, 0.0))), "width": 64}
    look |= {"time": noon["time"], "weather": noon["weather"]}
    with_it, without = (Image.open(io.BytesIO(http.get("/v1/preview.png", params=look | {"interior": on}).content)) for on in ("on", "off"))
    assert np.asarray(without).mean() > 1.5 * np.asarray(with_it).mean() > 0


def test_what_compare_measured_is_quoted(serving: Any, city: Path, tmp_path: Path, noon: Place) -> None:
    measured = tmp_path / "measured"
    shutil.copytree(city, measured)
    world = Dataset.open(city).world
    stage = "shaded" if world.basis == "cube" else "shaded_cube"
    report = {"states": {"noon": {stage: {"median": 0.03}}, "overcast": {stage: {"median": 0.05}}}, "expected_error": 0.04}
    write_world(measured, replace(world, error_report=report))
    with serving(create_app(measured, Settings())) as client:
        assert client.get("/v1/world").json()["dataset"]["error_report"] == report
        assert get(client, noon)[1]["expected_error"] == pytest.approx(0.04)
        assert get(client, noon, cascade=1)[1]["expected_error"] is None
    with serving(create_app(city, Settings())) as client:
        assert client.get("/v1/world").json()["dataset"]["error_report"] is None
        assert get(client, noon)[1]["expected_error"] is None
