"""The first message of a player's stream, and the errors of both ends. STREAM.md describes it member by member."""

import json
import math
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from gi_core.constants import BASIS_SIZES, VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.errors import SectorlightError

PROTOCOL = "sectorlight-stream"
VERSION = 1
MAX_HEADER_BYTES = 1 << 16
MAX_AXIS = 64  # of a volume, in voxels: 2^18 voxels at most, whatever a header says

# A step of 1 % is below what an eye tells apart in neighbouring surfaces (Weber's fraction in daylight is 1 to 2 %).
DEFAULT_THRESHOLD = 0.01
# Light 2^-16 of the volume's brightest is black on any display that shows both.
DEFAULT_FLOOR = 2.0**-16

TexelEncoding = Literal["f16"]


class StreamError(SectorlightError, ValueError):
    """A message of a stream that does not fit together; the state it was meant for is as before."""

    code = "bad_stream"


class FrameLostError(StreamError):
    """A delta against a frame that this end does not have; ask for a full one."""

    code = "frame_lost"


@dataclass(frozen=True)
class StreamHeader:
    """What holds for all frames of one stream.

    shape : (B, y, z, x) of a volume; three channels each
    basis : directional basis of the B coefficients
    encoding : how texels travel
    voxel_size : edge of a voxel [m]
    threshold : relative change of a voxel's largest coefficient beyond which it is sent again; larger: fewer bytes, coarser steps
    floor : change, as a share of the volume's largest coefficient, that is never worth sending
    tick_rate : ticks per second [Hz]
    """

    shape: tuple[int, int, int, int] = (BASIS_SIZES["cube"], *VOLUME_SHAPE)
    basis: str = "cube"
    encoding: TexelEncoding = "f16"
    voxel_size: float = VOXEL_SIZE_M
    threshold: float = DEFAULT_THRESHOLD
    floor: float = DEFAULT_FLOOR
    tick_rate: float = 30.0

    @property
    def voxels(self) -> int:
        """How many a volume has."""
        return math.prod(self.shape[1:])

    def to_text(self) -> str:
        """The message: one JSON object."""
        members = {"protocol": PROTOCOL, "version": VERSION, "unit": "lx", **asdict(self), "shape": [*self.shape, 3]}
        return json.dumps(members, separators=(",", ":"), allow_nan=False)


def parse_header(text: str | bytes) -> StreamHeader:
    """The header that a message holds. Raises StreamError; members that this version does not know are ignored."""
    if len(text) > MAX_HEADER_BYTES:
        raise StreamError(f"stream header: expected at most {MAX_HEADER_BYTES} bytes, found {len(text)}")
    try:
        members = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise StreamError(f"stream header: expected a JSON object, found {text[:60]!a}") from error
    if not isinstance(members, dict) or members.get("protocol") != PROTOCOL or members.get("version") != VERSION:
        raise StreamError(f"stream header: expected {PROTOCOL} version {VERSION}, found {text[:120]!a}")
    _expect(members, "unit", members.get("unit") == "lx", "lx")
    basis = members.get("basis")
    _expect(members, "basis", isinstance(basis, str) and basis in BASIS_SIZES, " or ".join(BASIS_SIZES))
    _expect(members, "encoding", members.get("encoding") in get_args(TexelEncoding), " or ".join(get_args(TexelEncoding)))
    return StreamHeader(
        shape=_shape(members, str(basis)),
        basis=str(basis),
        encoding=members["encoding"],
        voxel_size=_number(members, "voxel_size", 1e-3, 1e6),
        threshold=_number(members, "threshold", 0.0, 1.0),
        floor=_number(members, "floor", 0.0, 1.0),
        tick_rate=_number(members, "tick_rate", 1e-3, 1e6),
    )


def _shape(members: dict[str, Any], basis: str) -> tuple[int, int, int, int]:
    value, size = members.get("shape"), BASIS_SIZES[basis]
    axes = value if isinstance(value, list) and len(value) == 5 and all(type(n) is int for n in value) else [0] * 5
    fits = axes[0] == size and axes[4] == 3 and all(1 <= n <= MAX_AXIS for n in axes[1:4])
    _expect(members, "shape", fits, f"[{size}, y, z, x, 3] with axes of 1..{MAX_AXIS}")
    return size, axes[1], axes[2], axes[3]


def _number(members: dict[str, Any], name: str, low: float, high: float) -> float:
    value = members.get(name)
    fits = isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
    _expect(members, name, fits, f"a number of {low:g}..{high:g}")
    return float(members[name])


def _expect(members: dict[str, Any], name: str, fits: object, expected: str) -> None:
    if not fits:
        raise StreamError(f"stream header: {name}: expected {expected}, found {str(members.get(name))[:60]!a}")
