"""A world's rooms as world.json has them.

Until version 4 a room is a box. Version 5 has openings, and rooms that the bake found, in cells of ROOM_CELL_M; version 6 doors between
rooms, and rooms drawn as meshes, in cells of their own width.
"""

import base64
import zlib
from dataclasses import asdict
from typing import Any

from gi_core.constants import ROOM_CELL_M
from gi_core.errors import CorruptFileError
from gi_core.json_fields import Fields
from gi_core.world import Opening, Room, RoomCells

DOORS_VERSION, ROOMS_VERSION = 6, 5
# Room numbers have 16 bits, and 0 is outdoors.
MAX_ROOMS = 65_535
MAX_OPENINGS = 4096  # of one room
MAX_ROOM_CELLS = 1 << 26  # of the box of one room: 160 m each way
CELL_SIZES_M = (1e-3, 1e3)  # the least and the most that a cell may be wide


def needs_doors_version(room: Room) -> bool:
    """Whether no version before DOORS_VERSION can say what a room is."""
    return any(opening.to for opening in room.openings) or (room.cells is not None and room.cells.size_m != ROOM_CELL_M)


def room_json(room: Room, version: int) -> dict[str, Any]:
    """A room as world.json of a version has it."""
    if version < ROOMS_VERSION:
        return room.box_json()
    since = {"to", "size_m"} if version < DOORS_VERSION else set()
    openings = [{name: value for name, value in asdict(opening).items() if name not in since} for opening in room.openings]
    cells: dict[str, Any] | None = None
    if room.cells is not None:
        cells = {name: value for name, value in asdict(room.cells).items() if name not in since}
        cells["bits"] = base64.b64encode(zlib.compress(room.cells.bits, 9)).decode()
    return room.box_json() | {"openings": openings, "cells": cells}


def read_rooms(top: Fields, version: int) -> tuple[Room, ...]:
    """The rooms of a world.json of a version. Raises CorruptFileError for what is missing, unknown or out of its range."""
    rooms = tuple(_room(record, f"{top.where}: rooms", version) for record in top.sequence("rooms", MAX_ROOMS))
    for number, room in enumerate(rooms, 1):
        for opening in room.openings:
            if opening.to > len(rooms) or opening.to == number:
                raise CorruptFileError(
                    f"{top.where}: rooms: openings: to: expected another of {len(rooms)} rooms, found {opening.to}; bake it again"
                )
    return rooms


def _room(record: Any, where: str, version: int) -> Room:
    room = Fields(record, where, Room.__dataclass_fields__ if version >= ROOMS_VERSION else ("name", "minimum", "maximum"))
    box = room.text("name"), *_corners(room)
    if version < ROOMS_VERSION:
        return Room(*box)
    openings = tuple(_opening(record, f"{room.where}: openings", version) for record in room.sequence("openings", MAX_OPENINGS))
    known = ("first", "shape", "bits", "size_m") if version >= DOORS_VERSION else ("first", "shape", "bits")
    cells = _room_cells(room.fields("cells", known), version) if room.has("cells") else None
    return Room(*box, openings, cells)


def _opening(record: Any, where: str, version: int) -> Opening:
    opening = Fields(record, where, ("minimum", "maximum", "to") if version >= DOORS_VERSION else ("minimum", "maximum"))
    return Opening(*_corners(opening), opening.integer("to", 0) if version >= DOORS_VERSION else 0)


def _corners(box: Fields) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    low, high = box.point("minimum"), box.point("maximum")
    if any(least > most for least, most in zip(low, high, strict=True)):
        raise CorruptFileError(
            f"{box.where}: expected minimum below maximum on every axis, found {list(low)} and {list(high)}; bake it again"
        )
    return low, high


def _room_cells(cells: Fields, version: int) -> RoomCells:
    (x, y, z), (nx, ny, nz) = cells.triple("first", -(1 << 31), (1 << 31) - 1), cells.triple("shape", 1, MAX_ROOM_CELLS)
    size_m = cells.number("size_m", *CELL_SIZES_M) if version >= DOORS_VERSION else ROOM_CELL_M
    size = (nx * ny * nz + 7) // 8
    if size > MAX_ROOM_CELLS // 8:
        raise CorruptFileError(f"{cells.where}: shape: expected at most {MAX_ROOM_CELLS} cells, found {nx * ny * nz}; bake it again")
    try:
        unpacker = zlib.decompressobj()
        # A byte more than there may be tells that there are too many, without making room for them.
        bits = unpacker.decompress(base64.b64decode(cells.text("bits", MAX_ROOM_CELLS // 4), validate=True), size + 1)
    except (ValueError, zlib.error) as error:
        raise CorruptFileError(f"{cells.where}: bits: expected zlib in base64 ({error}); bake it again") from error
    if len(bits) != size or not unpacker.eof:
        raise CorruptFileError(f"{cells.where}: bits: expected {size} bytes for {nx * ny * nz} cells, found another number; bake it again")
    return RoomCells((x, y, z), (nx, ny, nz), bits, size_m)
