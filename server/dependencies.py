"""What requests may say. Each route takes one of these classes; a parameter that its class does not have is refused by name.

Bounds here only keep arithmetic finite and work small; whether a place or a weather exists is the engine's to say.
"""

import math
from collections import Counter
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import Depends
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError
from starlette.requests import HTTPConnection

from gi_core.arrays import Float64
from gi_core.client_light import Beyond
from gi_core.constants import MAX_CASCADE
from gi_core.distant_file import DistantLight
from gi_core.errors import InputError
from gi_core.json_fields import LARGEST_INTEGER
from server.encoding import ArrayFormat, RawEncoding, VolumeFormat
from server.preview_views import ViewName
from server.service import Service

# Beyond this float32 metres are coarser than a voxel's position needs, and no world reaches it.
MAX_COORDINATE_M = 1e7
MAX_PROBE_RADIUS_M = 100.0  # at most 5 x 5 sectors, 25 000 probes
MAX_DECAL_RADIUS_M = 500.0  # of the talk's 22 300 vehicles on 6 km2 some 3 000
MAX_PREVIEW_WIDTH = 1920

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M, allow_inf_nan=False, description="world metres")]


class StrictQuery(BaseModel):
    """Query parameters; unknown ones are refused, so that a typo is not silently the default."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown(cls, values: Any) -> Any:
        unknown = sorted(set(values) - set(cls.model_fields)) if isinstance(values, dict) else []
        if unknown:
            shown = ", ".join(name[:40] for name in unknown[:5])
            known = f"one of {', '.join(cls.model_fields)}" if cls.model_fields else "no parameter"
            raise PydanticCustomError("unknown_parameter", "{shown}: expected {known}", {"known": known, "shown": shown})
        return values


class LightingQuery(StrictQuery):
    time: str = Field(max_length=64, description="`13:00`, or ISO 8601 local time with a date", examples=["13:00"])
    weather: str = Field(
        max_length=200,
        description="a preset that /v1/world lists, at a strength as in `snow:0.7`, or with numbers as in `clear:haze=0.3`",
        examples=["clear"],
    )


class SkyQuery(LightingQuery):
    format: Literal["npy", "exr"] = Field("npy", description="npy: float32; exr: a picture")


class PositionQuery(LightingQuery):
    x: Coordinate
    y: Coordinate
    z: Coordinate

    @property
    def position(self) -> Float64:
        """(3,) float64 [m], world frame."""
        return np.array([self.x, self.y, self.z], np.float64)


class VolumeFormatQuery(StrictQuery):
    format: VolumeFormat = Field("npy", description="npy: float32, exact; raw: a texture's bytes; ktx2: a 3D texture file, bevy's layout")
    encoding: RawEncoding = Field(
        "f16",
        description="of raw and ktx2: RGBA halves, alpha = 1 in the volume's own air, else 0; or rgb9e5, half the bytes; lux = rgb x scale",
    )
    mask: bool = Field(False, description="1: the voxels' classes (uint8) instead of light")


class VolumeQuery(PositionQuery, VolumeFormatQuery):
    kind: Literal["outdoor", "interior", "fog"] = Field(
        "outdoor", description="interior: light of rooms alone; fog: outdoor light averaged over all directions"
    )
    room: str | None = Field(
        None, max_length=200, description="of kind=interior, a name or number of /v1/world; none: the room at x, y, z, or all rooms"
    )
    weight: bool = Field(
        False, description="of kind=interior, 1: where its rooms are and how near their openings, instead of light: uint8, npy or raw"
    )
    to: str | None = Field(
        None,
        max_length=200,
        description="of weight, a name or number: how near the room's doors to that one are, instead of its other openings",
    )
    basis: Literal["cube", "sh1", "sh2"] = Field(
        "cube", description="cube: +X -X +Y -Y +Z -Z; harmonics: 4 or 9 coefficients, where `/v1/world` says that they can be had"
    )
    cascade: int = Field(
        0, ge=-1, le=MAX_CASCADE, description="0: 32 x 16 x 32 voxels of 3.125 m; n doubles their size n times; -1 halves it, where baked"
    )

    @model_validator(mode="after")
    def _fits_its_kind(self) -> "VolumeQuery":
        if self.kind != "interior" and self.room is not None:
            raise ValueError("room with kind=interior only")
        if self.weight and (self.kind != "interior" or self.mask or self.format == "ktx2"):
            raise ValueError("weight with kind=interior, format=npy or raw, and no mask")
        if self.to is not None and (not self.weight or self.room is None):
            raise ValueError("to with weight=1 and room only")
        if self.kind == "interior" and self.cascade != 0:
            raise ValueError("cascade=0 of kind=interior")
        if self.kind == "fog" and self.basis != "cube":
            raise ValueError("no basis of kind=fog, which has no direction")
        return self


class PlayerVolumeQuery(VolumeFormatQuery):
    since: int | None = Field(
        None,
        ge=-1,
        le=LARGEST_INTEGER,
        description="the tick that the client has, of this run of the server: 304 when there is no later one",
    )
    stale: bool = Field(
        False, description="1: of each voxel's light the share (uint8, 255: all) that comes from probes which moving boxes hide from it"
    )

    @model_validator(mode="after")
    def _one_kind_of_bytes(self) -> "PlayerVolumeQuery":
        if self.stale and (self.mask or self.since is not None):
            raise ValueError("stale: expected without mask and since: it is worked out anew each time")
        return self


class LiveQuery(StrictQuery):
    since: int | None = Field(
        None, ge=-1, le=LARGEST_INTEGER, description="a tick: each later one of the last minute is told of in `recent`"
    )


class DistantQuery(LightingQuery):
    light: DistantLight | None = Field(
        None, description="sky: the sky's direct light alone; full: sun, lamps as baked and all bounces too; none: full where it was baked"
    )
    format: ArrayFormat = Field("npy", description="npy: float32, exact; raw: a texture's bytes")
    encoding: Literal["f16"] = Field("f16", description="of raw: RGBA halves; lux = rgb x scale")


class ProbesQuery(PositionQuery):
    radius: float = Field(30.0, gt=0, le=MAX_PROBE_RADIUS_M, allow_inf_nan=False, description="metres")


class DecalsQuery(StrictQuery):
    x: Coordinate
    y: Coordinate
    z: Coordinate
    radius: float = Field(100.0, gt=0, le=MAX_DECAL_RADIUS_M, allow_inf_nan=False, description="metres")


def _three_numbers(text: str) -> str:
    parse_vector(text)
    return text


def parse_vector(text: str) -> Float64:
    """(3,) float64 from "x,y,z"; ValueError when it is anything else."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(v) and abs(v) <= MAX_COORDINATE_M for v in values):
        raise ValueError(f"three numbers x,y,z within {MAX_COORDINATE_M:g} m")
    return np.array(values, np.float64)


Vector = Annotated[str, Field(max_length=120, examples=["32,20,96"]), AfterValidator(_three_numbers)]


class PreviewQuery(LightingQuery):
    eye: Vector = Field(description="where the camera is, x,y,z [m]")
    look: Vector = Field(description="what it looks at, x,y,z [m]")
    fov: float = Field(60.0, ge=1, le=150, allow_inf_nan=False, description="horizontal angle [degrees]")
    width: int = Field(640, ge=16, le=MAX_PREVIEW_WIDTH, description="pixels; the height is 9/16 of it")
    gi: Literal["on", "off", "split", "error"] = Field(
        "on", description="off: direct light only; split: left off, right on; error: against a path tracer, in false colour"
    )
    distant: Beyond = Field(
        "on",
        description="beyond the volumes: the distant texture, or off; client: beyond the eye's one; cascades: beyond coarser ones",
    )
    distant_light: DistantLight | None = Field(
        None, description="of the distant texture the sky's light alone, or with sun, lamps and bounces; none: the best that was baked"
    )
    interior: Literal["on", "off"] = Field("on", description="off: rooms are lit by the outdoor volume, as without interior ones")
    ao: Literal["on", "off"] = Field("off", description="on: what stands within 3 m, and decals, dim indirect light")
    view: Literal["lit"] | ViewName = Field("lit", description="what lies behind the picture, in false colours or as spheres")

    @model_validator(mode="after")
    def _has_direction(self) -> "PreviewQuery":
        if np.linalg.norm(parse_vector(self.look) - parse_vector(self.eye)) < 1e-3:
            raise ValueError("look to be at least 1 mm from eye")
        return self

    @model_validator(mode="after")
    def _one_kind(self) -> "PreviewQuery":
        if self.distant_light is not None and self.distant == "off":
            raise ValueError("distant_light with distant=on, client or cascades only")
        if self.gi == "error" and self.view != "lit":
            raise ValueError("either gi=error or another view than lit, not both")
        return self


class NoQuery(StrictQuery):
    """For routes that take no parameters."""


# Dependencies are coroutines though they wait for nothing: plain functions are called in a thread of the pool, which may be long in coming.
async def refuse_repeated_parameters(request: HTTPConnection) -> None:
    """InputError when a parameter is given twice: either value may be the one that was meant."""
    counts = Counter(name for name, _ in request.query_params.multi_items())
    repeated = min((name for name, count in counts.items() if count > 1), default=None)
    if repeated is not None:
        raise InputError(f"query: expected each parameter once, found {repeated[:40]} more than once")


def service_of(request: HTTPConnection) -> Service:
    """The running server's service."""
    service = request.app.state.service
    assert isinstance(service, Service)
    return service


async def _service(request: HTTPConnection) -> Service:
    return service_of(request)


ServiceDep = Annotated[Service, Depends(_service)]
