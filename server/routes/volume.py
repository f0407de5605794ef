"""The irradiance volume around a point."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request, Response

from gi_core.arrays import AnyArray, Float32, UInt8
from gi_core.basis import average
from gi_core.constants import CUBE_FACES, ROOM_OUTDOORS
from gi_core.errors import InputError
from gi_core.rooms import WEIGHT_CELLS, find_room, weight_lattice
from gi_core.volume import Volume
from gi_core.world import Room
from server import ktx2
from server.caching import Body, conditional, strong_etag
from server.dependencies import ServiceDep, VolumeFormatQuery, VolumeQuery
from server.encoding import (
    MEDIA_TYPE,
    REPLY_VERSION,
    half_scale,
    half_texels,
    header_json,
    npy,
    shared_exponent_scale,
    shared_exponent_texels,
)
from server.openapi import NOT_CHANGED, reply
from server.server_timing import Laps

router = APIRouter(prefix="/v1", tags=["light"])
# What a header may tell of rooms: proxies take 8 kB of headers, and /v1/world has all of them.
MAX_ROOMS_TOLD = 16


@router.get(
    "/volume",
    response_class=Response,
    responses=reply(*MEDIA_TYPE.values(), headers=("Gi-Volume", "Gi-Residual", "ETag"), more=NOT_CHANGED),
)
def volume(request: Request, service: ServiceDep, query: Annotated[VolumeQuery, Query()]) -> Response:
    """Irradiance [lx] in the 32 x 16 x 32 voxels around a point, snapped to the world's lattice.

    `npy`: float32 (B, 16, 32, 32, 3) = coefficient, y, z, x, channel.
    `raw`: little-endian halves (B, 16, 32, 32, 4); lux = rgb x scale; alpha is 1 in the volume's own air, else 0. With `encoding=rgb9e5`,
    of the cube alone: words (6, 16, 32, 32) of three nine-bit mantissas and their exponent, a GPU's E5B9G9R9; lux = rgb x scale.
    `ktx2`: the same texels of the cube as one 3D texture, 32 wide, 2 x 16 high (positive faces, then negative), 3 x 32 deep (X, Y, Z):
    as bevy's shader reads an irradiance volume (its documentation has the halves the other way round), whose `intensity` is then
    scale / pi. The file's key `Gi-Volume` repeats the header.
    `basis=cube`: B = 6 faces +X -X +Y -Y +Z -Z. `sh1`, `sh2`: B = 4, 9 of real spherical harmonics in the order 1, y, z, x, xy, yz,
    3z^2-1, xz, x^2-y^2, of either sign; irradiance along a normal is their sum, each times its harmonic there.

    `kind=outdoor`: no light of rooms; a voxel in one holds what the nearest one outdoors has. `kind=interior`: of a room alone; every other
    voxel holds what the nearest inside has, and `rooms` in the header places its box: inside it sample this volume, else the outdoor
    one; a room whose `shape` in `/v1/world` is `cells` is of that only where plane 0 of `weight=1` is 255. `kind=fog`: outdoor light
    averaged over directions, (16, 32, 32, 3).
    `kind=interior&weight=1`: what makes a step through a door smooth, in cells of a quarter voxel, uint8 (2, 64, 128, 128). Plane 0, read
    at the nearest cell, is 255 in the rooms and 0 outside; plane 1, read linearly, n = 0..1 as 0..255, tells how much an opening fills the
    view. The share of the interior volume is 1 - n / 2 inside and n / 2 outside: sharp at walls, continuous through openings. Read plane 0
    where volumes are sampled, plane 1 on the surface that is lit, 2 cm off it. n is the largest clamp((angle /
    2 pi - 0.25) / 0.75) of all boxes of openings in `/v1/world`: of each take the rectangle across its shortest side, and the solid angle
    from 0.390625 m nearer than the cell is. Worked out by oneself, it is better with the angle from where one is: cells lie up to so
    far from an opening. In its box both volumes have a half.
    `&room=A&to=B` is the same for the doors from A to another room B, `doors` of `/v1/world`, with both rooms' volumes: the share of B is
    n / 2 in A, that of A n / 2 in B, and each has a half in the doorway, where plane 0 is 127. Where a room has doors and other openings
    near, take all of their shares from it.
    `cascade=1..3`: voxels of twice, four and eight times the size, means of those inside them; `-1`: of half the size, where `/v1/world`
    says so. Each cascade covers the middle of the next: blend from one to the other over the last two voxels of the smaller.
    `mask=1`: uint8 (16, 32, 32), 0 solid, 1 outdoors, 2 indoors, 3 no sector there. The header `Gi-Volume` places it in the world.
    The header `Gi-Residual` is what later bounces could still add, as a share of a sector's brightest value: seldom more than 1e-5.
    """
    laps = Laps()
    with laps.lap("light"):
        light = service.lighting(query.time, query.weather)
    etag = strong_etag("volume", REPLY_VERSION, service.light_identity, light.digest, query.model_dump(exclude={"time", "weather"}))

    def compute() -> Body:
        with laps.lap("relight"):
            if query.kind == "interior":
                found = service.engine.interior(query.position, light, basis=query.basis, room=query.room)
            else:
                basis = None if query.kind == "fog" else query.basis
                found = service.engine.volume(query.position, light, basis=basis, cascade=query.cascade)
        with laps.lap("encode"):
            rooms = service.dataset.world.rooms
            if query.weight:
                body = weight_body(found, query, rooms, query.to)
            else:
                body = mask_body(found, query, rooms) if query.mask else light_body(found, query, rooms, is_fog=query.kind == "fog")
        return replace(body, headers={**body.headers, "Gi-Residual": f"{found.residual:.2g}"})

    return conditional(request, etag, compute, laps=laps)


def light_body(found: Volume, query: VolumeFormatQuery, rooms: tuple[Room, ...] = (), is_fog: bool = False) -> Body:
    """The light of a volume in the format that was asked for; of fog its average over directions."""
    basis = "average" if is_fog else found.basis
    values: Float32 = average(found.values) if is_fog else found.values

    def facts(shape: tuple[int, ...], dtype: str, scale: float) -> dict[str, Any]:
        return volume_facts(found, shape, dtype, scale, rooms) | {"basis": basis}

    if query.format == "npy":
        return _body(npy(values), query, facts(values.shape, "float32", 1.0))
    if basis not in ("cube", "average"):
        if query.encoding == "rgb9e5":
            raise InputError(f"encoding: rgb9e5 has no sign; expected basis=cube or encoding=f16, found basis={basis}")
        if query.format == "ktx2":
            raise InputError(f"format: ktx2 holds the cube's six faces; expected basis=cube, or another format, found basis={basis}")
    own = found.own.astype("u1")
    if query.format == "ktx2":
        values, own = _as_texture(values), _as_texture(own if is_fog else np.broadcast_to(own, (6, *own.shape)))
    if query.encoding == "rgb9e5":
        scale, shape, dtype = shared_exponent_scale(values), values.shape[:-1], "rgb9e5"
        texels = shared_exponent_texels(values, scale)
    else:
        scale, shape, dtype = half_scale(values), (*values.shape[:-1], 4), "float16"
        texels = half_texels(values, scale, own)
    described = facts(shape, dtype, scale)
    if query.format == "ktx2":
        texels = _file(texels, shape, ktx2.SHARED_EXPONENT if query.encoding == "rgb9e5" else ktx2.HALF_RGBA, described)
    return _body(texels, query, described)


def mask_body(found: Volume, query: VolumeFormatQuery, rooms: tuple[Room, ...] = ()) -> Body:
    """The classes of a volume's voxels."""
    return bytes_body(found, found.mask, query, {}, rooms)


def bytes_body(found: Volume, values: UInt8, query: VolumeFormatQuery, facts: Mapping[str, Any], rooms: tuple[Room, ...] = ()) -> Body:
    """A byte for each voxel (y, z, x), and facts that are other than those of a volume's classes."""
    texels = np.swapaxes(values, 0, 1) if query.format == "ktx2" else values
    described = {**volume_facts(found, texels.shape, "uint8", 1.0, rooms), **facts}
    if query.format == "npy":
        content = npy(texels)
    else:
        content = texels.tobytes()
        if query.format == "ktx2":
            content = _file(content, texels.shape, ktx2.BYTE, described)
    return _body(content, query, described)


def weight_body(found: Volume, query: VolumeFormatQuery, rooms: tuple[Room, ...], to: str | None = None) -> Body:
    """Where an interior volume's rooms are, and how near their openings, in cells of a quarter voxel; ``to`` names the room behind them.

    Raises InputError for a room that no door leads to.
    """
    beyond = ROOM_OUTDOORS if to is None else find_room(rooms, to)
    behind = {opening.to for number in found.rooms for opening in rooms[number - 1].openings if opening.to}
    if to is not None and beyond not in behind:
        shown = ", ".join(repr(rooms[number - 1].name[:40]) for number in sorted(behind)[:8]) or "none"
        raise InputError(f"to: expected a room behind a door ({shown}), found {to[:40]!r}")
    lattice = weight_lattice(found.first_voxel, rooms, found.rooms, beyond)
    size = found.voxel_size / WEIGHT_CELLS
    corner = found.origin - found.voxel_size / 2
    placed = {"origin": (corner + size / 2).tolist(), "voxel_size": size.tolist(), "unit": "1"}
    described = volume_facts(found, lattice.shape, "uint8", 1 / 255, rooms) | placed
    return _body(npy(lattice) if query.format == "npy" else lattice.tobytes(), query, described)


def volume_facts(found: Volume, shape: tuple[int, ...], dtype: str, scale: float, rooms: tuple[Room, ...]) -> dict[str, Any]:
    """What ``Gi-Volume`` says. ``origin`` is the centre of voxel (0, 0, 0) in world metres."""
    facts = {
        "origin": [float(v) for v in found.origin],
        "voxel_size": [float(v) for v in found.voxel_size],
        "shape": list(shape),
        "dtype": dtype,
        "basis": found.basis,
        "unit": "lx",
        "scale": scale,
        "sectors": [[index.x, index.z] for index in found.sectors],
        "valid": round(found.valid, 6),
        "expected_error": found.expected_error,
        "cascade": found.cascade,
    }
    if found.rooms:
        facts["rooms"] = [room_facts(rooms, number) for number in found.rooms[:MAX_ROOMS_TOLD]]
        facts["rooms_reached"] = len(found.rooms)
    return facts


def room_facts(rooms: tuple[Room, ...], number: int) -> dict[str, Any]:
    """Where a room is, and what /v1/world calls it."""
    room = rooms[number - 1]
    return {"number": number, "name": room.name, "minimum": room.minimum, "maximum": room.maximum}


def _as_texture(values: AnyArray) -> AnyArray:
    """Six faces (6, y, z, x, ...) stacked into one texture, or one field (y, z, x, ...) as one: (z, y, x, ...)."""
    return ktx2.stacked_faces(values) if len(values) == len(CUBE_FACES) else np.swapaxes(values, 0, 1)


def _file(texels: bytes, shape: tuple[int, ...], kind: ktx2.TexelFormat, facts: Mapping[str, Any]) -> bytes:
    depth, height, width = shape[:3]
    return ktx2.texture_file(texels, (depth, height, width), kind, {"Gi-Volume": header_json(facts)})


def _body(content: bytes, query: VolumeFormatQuery, facts: Mapping[str, Any]) -> Body:
    return Body(content, MEDIA_TYPE[query.format], {"Gi-Volume": header_json(facts)})
