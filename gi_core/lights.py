"""Lamps: what they are checked for, when they are on, their photometry, and the records that kernels read.

    point   I = lumens / (4 pi)                                  [cd]
    spot    I(angle) = I0 smoothstep(cos outer, cos inner, cos angle),  I0 = lumens / (2 pi (1 - (cos inner + cos outer) / 2))
    area    L = lumens / (pi width height)                       [cd m^-2], Lambertian, one-sided

A spot's I0 is exact: smoothstep's mean over its edge is one half, so the cone's flux is the lumens. All three fade by the window
(1 - (d / range)^4)^2 of Karis, "Real Shading in Unreal Engine 4", 2013: it takes 0.3 % at a fifth of the range, 2.5 % at a third,
12 % at a half, and all at the range itself. MATH.md has the rest.
"""

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import astuple
from datetime import datetime

import numpy as np

from gi_core.arrays import AnyArray, Float64
from gi_core.errors import InputError
from gi_core.layout import AREA_SHADOW_RAYS, LOCAL_AREA, LOCAL_LIGHT, LOCAL_POINT, LOCAL_SPOT
from gi_core.lighting import Lighting
from gi_core.spectrum import LUMINANCE_FROM_RGB, rgb_of_black_body
from gi_core.world import LAMP_KINDS, Lamp

MAX_LUMENS = 1e12
MIN_RANGE_M, MAX_RANGE_M = 0.01, 1e5
MIN_CONE_DEGREES, MAX_CONE_DEGREES = 1.0, 180.0
MIN_SIZE_M, MAX_SIZE_M = 0.01, 1e4
# From a candle's ember to beyond the bluest sky.
MIN_TEMPERATURE_K, MAX_TEMPERATURE_K = 1000.0, 40_000.0
# A spot's edge: the outer part of its half angle over which it fades. A hard edge would make a moved spot pop from surfel to surfel.
SPOT_EDGE_SHARE = 0.2

_KIND_NUMBER = {"point": LOCAL_POINT, "spot": LOCAL_SPOT, "area": LOCAL_AREA}
_CLOCK = r"([01]\d|2[0-3]):([0-5]\d)"
_INTERVAL = re.compile(f"{_CLOCK}-{_CLOCK}", re.ASCII)
ALLOWED_SCHEDULES = '"always", "night", or two different local times such as "18:00-23:30"'


def check_lamp(lamp: Lamp) -> None:
    """Raise InputError, naming the lamp and the field, unless every field is one that can be lit with."""

    def expect(ok: bool, field: str, what: str) -> None:
        if not ok:
            raise InputError(f"lamp {lamp.name[:60]!a}: {field}: expected {what}, found {getattr(lamp, field)!r:.60}")

    def within(value: float, low: float, high: float) -> bool:
        return bool(low <= value <= high)  # no NaN is

    expect(lamp.kind in LAMP_KINDS, "kind", " or ".join(LAMP_KINDS))
    expect(len(lamp.position) == 3 and all(within(v, -1e9, 1e9) for v in lamp.position), "position", "three numbers of -1e9..1e9")
    expect(within(lamp.lumens, 0, MAX_LUMENS), "lumens", f"a number of 0..{MAX_LUMENS:g}")
    expect(len(lamp.color) == 3 and all(within(v, 0, 1e6) for v in lamp.color), "color", "three numbers of 0..1e6")
    expect(within(lamp.range_m, MIN_RANGE_M, MAX_RANGE_M), "range_m", f"a number of {MIN_RANGE_M:g}..{MAX_RANGE_M:g}")
    whole = len(lamp.direction) == 3 and all(within(v, -1e9, 1e9) for v in lamp.direction)
    expect(whole and math.hypot(*lamp.direction) > 1e-6, "direction", "three numbers, not all 0")
    expect(within(lamp.cone_degrees, MIN_CONE_DEGREES, MAX_CONE_DEGREES), "cone_degrees", f"{MIN_CONE_DEGREES:g}..{MAX_CONE_DEGREES:g}")
    expect(
        len(lamp.size) == 2 and all(within(v, MIN_SIZE_M, MAX_SIZE_M) for v in lamp.size),
        "size",
        f"two of {MIN_SIZE_M:g}..{MAX_SIZE_M:g} m",
    )
    expect(is_schedule(lamp.schedule), "schedule", ALLOWED_SCHEDULES)


def is_schedule(text: str) -> bool:
    """Whether a text is one of ALLOWED_SCHEDULES."""
    if text in ("always", "night"):
        return True
    match = _INTERVAL.fullmatch(text)
    return match is not None and match.group(1, 2) != match.group(3, 4)


def is_on(schedule: str, clock: datetime, sun_is_up: bool) -> bool:
    """Whether a lamp of this schedule is on at a local time. From the first minute, until just before the second; across midnight too."""
    if schedule == "always":
        return True
    if schedule == "night":
        return not sun_is_up
    match = _INTERVAL.fullmatch(schedule)
    if match is None:
        raise InputError(f"schedule {schedule[:60]!r}: expected {ALLOWED_SCHEDULES}")
    on_hour, on_minute, off_hour, off_minute = (int(part) for part in match.groups())
    on, off, now = 60 * on_hour + on_minute, 60 * off_hour + off_minute, 60 * clock.hour + clock.minute
    return on <= now < off if on < off else now >= on or now < off


def schedule_is_on(schedule: str, lighting: Lighting) -> bool:
    """``is_on`` at a snapshot's time and under its sun."""
    return is_on(schedule, datetime.fromisoformat(lighting.time), bool(lighting.sun.direction[1] > 0))


def lamps_on(lamps: Iterable[Lamp], lighting: Lighting) -> tuple[Lamp, ...]:
    """Those that are on at the snapshot's time and under its sun, and give any light, in their order."""
    clock, sun_is_up = datetime.fromisoformat(lighting.time), bool(lighting.sun.direction[1] > 0)
    return tuple(lamp for lamp in lamps if lamp.lumens > 0 and any(lamp.color) and is_on(lamp.schedule, clock, sun_is_up))


def lamps_digest(lamps: Sequence[Lamp]) -> str:
    """32 hexadecimal digits of everything in lamps that changes light; their names and schedules do not."""
    h = hashlib.blake2b(digest_size=16)
    for lamp in lamps:
        _, *shape, _ = astuple(lamp)
        h.update(repr(shape).encode())
    return h.hexdigest()


def color_from_temperature(kelvin: float) -> tuple[float, float, float]:
    """Linear sRGB of luminance 1 of a black body at 1000..40 000 K; what lies outside of sRGB is brought to its nearest edge.

    Raises InputError beyond that range.
    """
    if not MIN_TEMPERATURE_K <= kelvin <= MAX_TEMPERATURE_K:
        raise InputError(f"temperature_k: expected {MIN_TEMPERATURE_K:g}..{MAX_TEMPERATURE_K:g} K, found {kelvin:g}")
    inside = np.maximum(rgb_of_black_body(kelvin), 0.0)
    r, g, b = (inside / (LUMINANCE_FROM_RGB @ inside)).tolist()
    return r, g, b


def light_records(lamps: Sequence[Lamp], origin: Float64) -> AnyArray:
    """(n,) records of layout.LOCAL_LIGHT, sector-local to ``origin`` (3,) [m]; shadow planes are numbered from 0 in their order."""
    records = np.zeros(len(lamps), LOCAL_LIGHT.dtype)
    plane = 0
    for record, lamp in zip(records, lamps, strict=True):
        record["kind"] = _KIND_NUMBER[lamp.kind]
        record["position"] = np.subtract(lamp.position, origin)
        record["range"] = lamp.range_m
        axis = unit_direction(lamp)
        record["axis"] = axis
        record["intensity"] = _intensity(lamp)
        if lamp.kind == "spot":
            record["cos_outer"], record["cos_inner"] = _cone_cosines(lamp)
        if lamp.kind == "area":
            record["half_u"], record["half_v"] = area_halves(lamp)
        record["first_plane"] = plane
        plane += shadow_planes(lamp)
    return records


def shadow_planes(lamp: Lamp) -> int:
    """How many shadow rays each surfel sends to a lamp."""
    return AREA_SHADOW_RAYS if lamp.kind == "area" else 1


def reach_m(lamp: Lamp) -> float:
    """How far from its position a lamp lights or its shadow rays end [m]."""
    return max(lamp.range_m, math.hypot(*lamp.size) / 2 if lamp.kind == "area" else 0.0)


def unit_direction(lamp: Lamp) -> Float64:
    """(3,) unit: a spot's axis, an area's normal."""
    direction = np.array(lamp.direction, np.float64)
    return np.asarray(direction / np.linalg.norm(direction))


def area_halves(lamp: Lamp) -> tuple[Float64, Float64]:
    """Vectors (3,) [m] from an area's centre to the middle of its side at the end of its width, and of its height."""
    normal = unit_direction(lamp)
    level = np.cross((0.0, 1.0, 0.0), normal)
    length = float(np.linalg.norm(level))
    # A normal this close to vertical has no stable level direction.
    across = level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    across -= normal * (across @ normal)
    across /= np.linalg.norm(across)
    width, height = lamp.size
    return across * (width / 2), np.cross(normal, across) * (height / 2)


def _cone_cosines(lamp: Lamp) -> tuple[float, float]:
    half = math.radians(lamp.cone_degrees) / 2
    return math.cos(half), math.cos(half * (1 - SPOT_EDGE_SHARE))


def _intensity(lamp: Lamp) -> Float64:
    """(3,) linear sRGB whose luminance is the lamp's intensity [cd], or an area's radiance [cd m^-2]."""
    brightest = max(lamp.color)
    if brightest <= 0:
        return np.zeros(3)
    # Only ratios count. Without this the luminance of the least of colours is too small to divide by.
    color = np.array(lamp.color, np.float64) / brightest
    spread = 4 * math.pi
    if lamp.kind == "spot":
        spread = 2 * math.pi * (1 - sum(_cone_cosines(lamp)) / 2)
    elif lamp.kind == "area":
        spread = math.pi * lamp.size[0] * lamp.size[1]
    return color * (lamp.lumens / (spread * float(LUMINANCE_FROM_RGB @ color)))
