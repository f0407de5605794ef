"""The irradiance volume around a point."""

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from gi_core.constants import VOXEL_INDOORS, VOXEL_OUTDOORS
from gi_core.errors import InputError
from gi_core.volume import Volume
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
from server.server_timing import Laps

router = APIRouter(prefix="/v1", tags=["light"])


@router.get("/volume", response_class=Response, responses={200: {"content": {media: {} for media in MEDIA_TYPE.values()}}})
def volume(request: Request, service: ServiceDep, query: Annotated[VolumeQuery, Query()]) -> Response:
    """Irradiance [lx] in the 32 x 16 x 32 voxels around a point, snapped to the world's lattice.

    `npy`: float32 (B, 16, 32, 32, 3) = coefficient, y, z, x, channel.
    `raw`: little-endian halves (B, 16, 32, 32, 4); lux = rgb x scale; alpha is 1 in free air, else 0. With `encoding=rgb9e5`, of the cube
    alone: words (6, 16, 32, 32) of three nine-bit mantissas and their exponent, a GPU's E5B9G9R9; lux = rgb x scale.
    `basis=cube`: B = 6 faces +X -X +Y -Y +Z -Z. `sh1`, `sh2`: B = 4, 9 of real spherical harmonics in the order 1, y, z, x, xy, yz,
    3z^2-1, xz, x^2-y^2, of either sign; irradiance along a normal is their sum, each times its harmonic there.
    `mask=1`: uint8 (16, 32, 32), 0 solid, 1 outdoors, 2 indoors, 3 no sector there. The header `Gi-Volume` places it in the world.
    """
    laps = Laps()
    with laps.lap("light"):
        light = service.lighting(query.time, query.weather)
    etag = strong_etag("volume", REPLY_VERSION, service.light_identity, light.digest, query.model_dump(exclude={"time", "weather"}))

    def compute() -> Body:
        with laps.lap("relight"):
            found = service.engine.volume(query.position, light, basis=query.basis)
        with laps.lap("encode"):
            return mask_body(found, query) if query.mask else light_body(found, query)

    return conditional(request, etag, compute, laps=laps)


def light_body(found: Volume, query: VolumeFormatQuery) -> Body:
    """The light of a volume in the format that was asked for."""
    values = found.values
    if query.format == "npy":
        return _body(npy(values), query, volume_facts(found, values.shape, "float32", 1.0))
    if query.encoding == "rgb9e5":
        if found.basis != "cube":
            raise InputError(f"encoding: rgb9e5 has no sign; expected basis=cube or encoding=f16, found basis={found.basis}")
        scale = shared_exponent_scale(values)
        return _body(shared_exponent_texels(values, scale), query, volume_facts(found, values.shape[:-1], "rgb9e5", scale))
    scale = half_scale(values)
    free = ((found.mask == VOXEL_OUTDOORS) | (found.mask == VOXEL_INDOORS)).astype("u1")
    texels = half_texels(values, scale, free)
    return _body(texels, query, volume_facts(found, (*values.shape[:-1], 4), "float16", scale))


def mask_body(found: Volume, query: VolumeFormatQuery) -> Body:
    """The classes of a volume's voxels."""
    content = npy(found.mask) if query.format == "npy" else found.mask.tobytes()
    return _body(content, query, volume_facts(found, found.mask.shape, "uint8", 1.0))


def volume_facts(found: Volume, shape: tuple[int, ...], dtype: str, scale: float) -> dict[str, Any]:
    """What ``Gi-Volume`` says. ``origin`` is the centre of voxel (0, 0, 0) in world metres."""
    return {
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
    }


def _body(content: bytes, query: VolumeFormatQuery, facts: Mapping[str, Any]) -> Body:
    return Body(content, MEDIA_TYPE[query.format], {"Gi-Volume": header_json(facts)})
