"""Reads dataset files from what gi_core/FORMAT.md says, and from nothing else: a second opinion on the format, and an example."""

import hashlib
import json
import math
import struct
from typing import Any

import numpy as np
import zstandard

Arrays = dict[str, np.ndarray]


def read_container(data: bytes, kind: str, version: int = 1) -> tuple[dict[str, Any], Arrays]:
    """meta and arrays of a container (section 1)."""
    assert 64 <= len(data) <= 64 + 2**20 + 2**28
    magic, found_kind, found_version = struct.unpack_from("<8s4sI", data, 0)
    assert (magic, found_kind, found_version) == (b"SECTORLT", kind.encode(), version)
    header_bytes, _, payload_bytes, raw_bytes = struct.unpack_from("<IIQQ", data, 16)
    assert header_bytes <= 2**20
    assert raw_bytes <= 2**28
    assert len(data) == 64 + header_bytes + payload_bytes
    assert hashlib.blake2b(data[:40] + data[64:], digest_size=16).digest() == data[40:56]
    header = json.loads(data[64 : 64 + header_bytes])
    payload = data[64 + header_bytes :]
    assert zstandard.frame_content_size(payload) == raw_bytes
    raw = zstandard.ZstdDecompressor().decompress(payload)
    arrays: Arrays = {}
    offset = 0
    for entry in header["arrays"]:
        dtype = np.dtype("<" + entry["dtype"])
        items = math.prod(entry["shape"])
        planes = np.frombuffer(raw, np.uint8, items * dtype.itemsize, offset).reshape(dtype.itemsize, items)
        values = np.frombuffer(planes.T.tobytes(), dtype).reshape(entry["shape"])
        if entry["delta"]:
            values = np.cumsum(values, axis=-1, dtype=dtype)
        arrays[entry["name"]] = values
        offset += items * dtype.itemsize
    assert offset == raw_bytes
    return header["meta"], arrays


def length(codes: np.ndarray) -> np.ndarray:
    return codes / 512.0


def root(codes: np.ndarray) -> np.ndarray:
    return (codes / 255.0) ** 2


def signed_root(codes: np.ndarray) -> np.ndarray:
    return np.sign(codes) * (codes / 127.0) ** 2


def harmonic_norms() -> np.ndarray:
    """N of section 3."""
    return np.sqrt(np.array([1, 3, 3, 3, 15, 15, 1.25, 15, 3.75]) / (4 * math.pi))


def unit(codes: np.ndarray) -> np.ndarray:
    """(2, n) -> (n, 3), one vector at a time, as section 2 says it."""
    vectors = []
    for a, b in codes.T.tolist():
        u, v = min((a - 127) / 127, 1.0), min((b - 127) / 127, 1.0)
        y = 1 - abs(u) - abs(v)
        if y < 0:
            u, v = (1 - abs(v)) * (1 if u >= 0 else -1), (1 - abs(u)) * (1 if v >= 0 else -1)
        vectors.append(np.array([u, y, v]) / math.sqrt(u * u + y * y + v * v))
    return np.array(vectors).reshape(-1, 3)


def starts(lengths: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths.astype(np.int64))])


def shares(codes: np.ndarray) -> np.ndarray:
    """Shares along the first axis."""
    total = codes.sum(axis=0, dtype=np.int64)
    return np.where(total > 0, codes / np.maximum(total, 1), 0.0)


def directions(meta: dict[str, Any], a: Arrays) -> np.ndarray:
    """(F, 3) y, z, x of each factor, in steps: what is expected, and the difference that is stored (section 3)."""
    factor_starts, brick_starts = starts(a["factor_count"]), starts(a["brick_count"])
    bricks, single = len(a["brick_count"]), np.float32
    places = np.zeros((bricks + meta["sky_patches"], 3), single)
    for brick in range(bricks):
        step = 4 * 2 ** int(a["brick_level"][brick])
        codes = a["surfel_in_cell"][:, brick_starts[brick] : brick_starts[brick + 1]].astype(np.int64)
        mean = (2 * codes + 1).sum(axis=1) * np.float64(step) / codes.shape[1]
        places[brick] = a["brick_cell"][:, brick] * 512.0 * step + mean
    first = 0
    for count in patches_in_rows(meta["sky_patches"]):
        y = ((1 - first / meta["sky_patches"]) + (1 - (first + count) / meta["sky_patches"])) / 2
        for k in range(count):
            turn, level = 2 * math.pi * (k + 0.5) / count, math.sqrt(1 - y * y)
            place = (0, 1, 0) if first == 0 else (level * math.cos(turn), y, level * math.sin(turn))
            places[bricks + first + k] = np.array(place) * 2.0**40
        first += count
    found = np.zeros((len(a["factor_source"]), 3), np.int8)
    for probe in range(len(a["factor_count"])):
        at = a["probe_position"][:, probe].astype(single)
        for f in range(factor_starts[probe], factor_starts[probe + 1]):
            x, y, z = places[a["factor_source"][f]] - at
            scale = single(16) / np.sqrt(max(x * x + y * y + z * z, single(1)))
            found[f] = np.rint(np.array([y * scale, z * scale, x * scale])).astype(np.int8) + a["factor_direction"][f]
    return found


def harmonic_weights(meta: dict[str, Any], a: Arrays) -> np.ndarray:
    """(F, B) of a file in harmonics (section 3)."""
    bricks, basis = len(a["brick_count"]), 1 + a["factor_trim"].shape[1]
    weight = np.zeros((len(a["factor_source"]), basis))
    factor_starts, steps = starts(a["factor_count"]), directions(meta, a)
    for probe in range(len(a["factor_count"])):
        for f in range(factor_starts[probe], factor_starts[probe + 1]):
            kind = 0 if a["factor_source"][f] < bricks else 1
            y, z, x = (steps[f] / 16).tolist()
            r = x * x + y * y + z * z
            g = r if r <= 1.5625 else 32 / 45
            second = [15 / 4 * x * y, 15 / 4 * y * z, 5 / 16 * (3 * z * z - r), 15 / 4 * x * z, 15 / 16 * (x * x - y * y)]
            of_direction = np.array([2 * y, 2 * z, 2 * x, *(g * s for s in second)])[: basis - 1]
            most = np.array([3, 3, 3, 2, 2, 1, 2, 1.5])[: basis - 1]
            roots = np.sign(of_direction) * np.rint(127 * np.sqrt(np.minimum(np.abs(of_direction) / most, 1)))
            first = int(a["factor_weight"][0, f])
            codes = np.rint(first * roots / 127)
            shares_of_first = [
                signed_root(first),
                *(most * signed_root(codes) + signed_root(first) * signed_root(a["factor_trim"][kind, :, probe])),
            ]
            weight[f] = np.array(shares_of_first) * np.float64(a["factor_scale"][kind, 0, probe]) / harmonic_norms()[:basis]
    return weight


def cube_weights(a: Arrays) -> np.ndarray:
    """(F, 6) of a file in cubes (section 3)."""
    weight = np.zeros((len(a["factor_source"]), 6))
    factor_starts = starts(a["factor_count"])
    for probe in range(len(a["factor_count"])):
        for f in range(factor_starts[probe], factor_starts[probe + 1]):
            kind = 0 if a["factor_source"][f] < len(a["brick_count"]) else 1
            weight[f] = root(a["factor_weight"][:, f]) * a["factor_scale"][kind, :, probe].astype(np.float64)
    return weight


def voxel_blends(a: Arrays) -> tuple[np.ndarray, np.ndarray]:
    """Probes and shares (ny, nz, nx, K), one voxel at a time (section 3)."""
    weights, number, last = shares(a["voxel_weight"]), np.zeros(a["voxel_list"].size, int), -1
    for v, code in enumerate(a["voxel_list"].reshape(-1).tolist()):
        last += code == 0
        number[v] = last if code == 0 else last + 1 - code
    shape = (*a["voxel_list"].shape, len(weights))
    return a["voxel_probe"].T[number].reshape(shape), weights.T[number].reshape(shape)


def read_sector(data: bytes) -> tuple[dict[str, Any], Arrays]:
    """meta, and the arrays under the names and shapes of gi_core.sector.Sector (section 3)."""
    version = data[12]
    meta, a = read_container(data, "SECT", version)
    factor_starts, brick_starts = starts(a["factor_count"]), starts(a["brick_count"])
    bricks = len(a["brick_count"])
    weight = cube_weights(a) if "factor_trim" not in a else harmonic_weights(meta, a)
    if version == 1:
        voxel_probe, voxel_weight = (np.moveaxis(values, 0, 3) for values in (a["voxel_probe"], shares(a["voxel_weight"])))
    else:
        voxel_probe, voxel_weight = voxel_blends(a)
    position = np.zeros((brick_starts[-1], 3))
    for brick in range(bricks):
        for s in range(brick_starts[brick], brick_starts[brick + 1]):
            in_cell = (a["surfel_in_cell"][:, s] + 0.5) / 256
            position[s] = (a["brick_cell"][:, brick] + in_cell) * 4 * 2 ** int(a["brick_level"][brick])
    lit = a["feedback_probe"] != 65535
    feedback_codes = a["feedback_weight"] if len(lit) > 1 else np.ones(lit.shape, np.uint8)
    decoded = {
        "probe_position": length(a["probe_position"]).T,
        "probe_flags": a["probe_flags"],
        "probe_room": a["probe_room"],
        "factor_starts": factor_starts,
        "factor_source": a["factor_source"],
        "factor_weight": weight,
        "brick_starts": brick_starts,
        "brick_level": a["brick_level"],
        "brick_cell": a["brick_cell"].T,
        "brick_direction": a["brick_direction"],
        "surfel_position": position,
        "surfel_normal": unit(a["surfel_normal"]),
        "surfel_albedo": np.minimum(root(a["surfel_albedo"].T if version == 1 else a["surfel_albedo"]), 0.95),
        "surfel_snow": a["surfel_snow"] / 255.0,
        "feedback_probe": np.where(lit, a["feedback_probe"], 0).T,
        "feedback_weight": shares(np.where(lit, feedback_codes, 0)).T,
        "sun_visibility": a["sun_visibility"] if version == 1 else np.ascontiguousarray(a["sun_visibility"]).view("<u4"),
        "voxel_first": np.array(meta["voxel_first"]),
        "voxel_class": a["voxel_class"],
        "voxel_room": a["voxel_room"],
        "voxel_probe": voxel_probe,
        "voxel_weight": voxel_weight,
    }
    if "surfel_emission" in a:
        decoded["surfel_emission"] = a["surfel_emission"].T
    return meta, decoded


def read_geometry(data: bytes) -> tuple[dict[str, Any], Arrays]:
    """meta, and world-frame vertices, triangles, albedo and emission of each triangle (section 4)."""
    meta, a = read_container(data, "GEOM")
    x, z = meta["sector"]
    return meta, {
        "vertices": length(a["vertex"]).T + np.array([64.0 * x, 0.0, 64.0 * z]),
        "triangles": a["triangle"].T,
        "albedo": root(a["material_albedo"])[a["material"]],
        "emission": a["material_emission"][a["material"]],
    }


def read_distant(data: bytes) -> tuple[dict[str, Any], Arrays]:
    """meta, sky and valid, and of version 2 what is there for the valid texels (section 5)."""
    (version,) = struct.unpack_from("<I", data, 12)
    assert version in (1, 2)
    return read_container(data, "DIST", version)


def read_fine(data: bytes) -> tuple[dict[str, Any], Arrays]:
    """meta, and the arrays under the names and shapes of gi_core.voxel_grid.VoxelGrid (section 6)."""
    meta, a = read_container(data, "FINE")
    first = np.array(meta["voxel_first"])
    weight = np.moveaxis(shares(a["voxel_weight"]), 0, 3)
    return meta, {"first": first, "kind": a["voxel_class"], "probe": np.moveaxis(a["voxel_probe"], 0, 3), "weight": weight}


def patches_in_rows(patches: int) -> list[int]:
    """The dome's rows, from the zenith down (section 7)."""
    cap = math.acos(1 - 1 / patches)
    rings = max(1, round((math.pi / 2 - cap) / math.sqrt(2 * math.pi / patches)))
    edge = [math.cos(cap + (math.pi / 2 - cap) * i / rings) for i in range(rings + 1)]
    rows, owed = [1], 0.0
    for i in range(rings):
        wanted = patches * (edge[i] - edge[i + 1]) + owed
        rows.append(max(1, round(wanted)))
        owed = wanted - rows[-1]
    rows[-1] += patches - sum(rows)
    return rows


def patch_at(patches: int, x: float, y: float, z: float) -> int:
    """The patch that a direction above the horizon looks at (section 7)."""
    before = 0
    for count in patches_in_rows(patches):
        if 1 - (before + count) / patches < y <= 1 - before / patches:
            return before + int(math.atan2(z, x) % (2 * math.pi) / (2 * math.pi / count))
        before += count
    raise AssertionError("below the horizon")


def sun_plane_count(latitude: float, north: float, declination_step: float, hour_angle_step: float) -> int:
    """D, by walking over the nodes (section 6)."""
    rows, columns = math.ceil(46.88 / declination_step) + 1, math.ceil(360 / hour_angle_step)
    kept = 0
    for row in range(rows):
        declination = math.radians(-23.44 + 46.88 * row / (rows - 1))
        for column in range(columns):
            hour_angle = 2 * math.pi * column / columns
            at = math.radians(latitude)
            y = math.sin(at) * math.sin(declination) + math.cos(at) * math.cos(declination) * math.cos(hour_angle)
            kept += y > -math.sin(math.radians(max(declination_step, hour_angle_step)))
    return kept
