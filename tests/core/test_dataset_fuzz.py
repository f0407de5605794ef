"""Random harm, with a right digest around it: readers give a checked answer or one of the project's own errors, never another."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gi_core import container, distant_file, geometry_file, sector_file
from gi_core.errors import FormatError
from gi_core.sector import check_sector

GOLDEN = Path(__file__).parents[1] / "golden"
FILES = {
    "SECT": (GOLDEN / "v1" / "sectors" / "0_0.gisec", sector_file.decode),
    "SECT 2": (GOLDEN / "v4_sector2" / "sectors" / "0_0.gisec", sector_file.decode),
    "SECT 2 in harmonics": (GOLDEN / "v2_sector2" / "sectors" / "0_0.gisec", sector_file.decode),
    "GEOM": (GOLDEN / "v1" / "geometry" / "0_0.gigeo", geometry_file.decode),
    "DIST": (GOLDEN / "v1" / "distant.gidist", distant_file.decode),
    "DIST 2": (GOLDEN / "distant_v2" / "distant.gidist", distant_file.decode),
}


def parts(kind: str) -> tuple[dict[str, Any], bytes]:
    """A golden file's header and raw bytes."""
    data = FILES[kind][0].read_bytes()
    header_bytes = int.from_bytes(data[16:20], "little")
    return json.loads(data[64 : 64 + header_bytes]), zstandard.ZstdDecompressor().decompress(data[64 + header_bytes :])


PARTS = {kind: parts(kind) for kind in FILES}


def assemble(kind: str, header: Any, raw: bytes) -> bytes:
    text = json.dumps(header).encode()
    payload = zstandard.ZstdCompressor(level=1).compress(raw)
    prefix = container._PREFIX.pack(
        container.MAGIC, kind[:4].encode(), FILES[kind][0].read_bytes()[12], len(text), 0, len(payload), len(raw), bytes(16)
    )
    return prefix[:40] + container._digest(prefix, text, payload) + prefix[56:] + text + payload


def read(kind: str, data: bytes) -> bool:
    """Whether a file is accepted; what is refused names the file in one line."""
    refusal = None
    try:
        found = FILES[kind][1](data, "bad.file")
    except FormatError as error:
        refusal = str(error)
    if refusal is not None:
        assert refusal.startswith("bad.file: ")
        assert "\n" not in refusal
        return False
    if kind.startswith("SECT"):
        check_sector(found[0], 1024)
        assert (found[0].voxel_weight.sum(axis=3) < 1.001).all()  # float32 shares of at most 32
    elif kind == "GEOM":
        assert np.isfinite(found[0].vertices[found[0].triangles]).all()
    return True


@pytest.mark.parametrize("kind", FILES)
def test_the_untouched_file_is_accepted(kind):
    assert read(kind, assemble(kind, *PARTS[kind]))


def every_place(record: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    steps = list(record) if isinstance(record, dict) else range(len(record)) if isinstance(record, list) else []
    return [place for step in steps for place in ((*path, step), *every_place(record[step], (*path, step)))]


VALUES = st.sampled_from(
    [None, True, -1, 0, 1, 2, 7, 255, 65_536, 2**31, 2**40, 10**30, 1.5, float("nan"), float("inf"), "", "u2", "x", [], {}, [0], [3, 20]]
)


@pytest.mark.parametrize("kind", FILES)
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_no_header_gives_a_traceback(kind, data):
    header, raw = PARTS[kind]
    header = copy.deepcopy(header)
    for path in data.draw(st.lists(st.sampled_from(every_place(header)), min_size=1, max_size=2)):
        parent = header
        try:
            for step in path[:-1]:
                parent = parent[step]
            if data.draw(st.booleans()):
                # A copy: the next change may go into it, and one that was put into itself is nothing a file can hold.
                parent[path[-1]] = copy.deepcopy(data.draw(VALUES))
            else:
                del parent[path[-1]]
        except (KeyError, IndexError, TypeError):
            continue  # an earlier change took this place away
    read(kind, assemble(kind, header, raw))


@pytest.mark.parametrize("kind", FILES)
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_no_array_contents_give_a_traceback(kind, data):
    header, raw = PARTS[kind]
    octets = bytearray(raw)
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(raw) - 1))
        run = data.draw(st.binary(min_size=1, max_size=6))
        octets[place : place + len(run)] = run
    read(kind, assemble(kind, header, bytes(octets[: len(raw)])))
