"""Records and numbers that host and kernels share, declared once. ``kernels_cl/layout.h`` is generated from here:

    python -m gi_core.layout > kernels_cl/layout.h

A test compares the two, and ``Device`` asks the compiler for each record's size before it trusts it.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gi_core.basis import SH_NORM
from gi_core.constants import SNOW_ALBEDO
from gi_core.factor_weights import AMPLITUDES

# The sun and the moon.
MAX_DIRECTIONAL_LIGHTS = 2
# Sun visibility blends the four baked directions around the sun.
PLANES_PER_LIGHT = 4
# A bounce keeps its row in the fraction bits of a float between 1 and 2: as a whole number its bits would be a denormal float, which
# some processors multiply a hundred times as slowly, and the row shares a vector with colours.
ROW_BITS, ROW_ONE = 0x7FFFFF, 0x3F800000
# A surfel's sample of the sun's shadow map is a share of this; NO_SAMPLE stands for none.
WHOLE_SAMPLE, NO_SAMPLE = 254, 255
# Surfels whose bits share a uint.
SURFELS_PER_WORD = 32
# Values of LocalLight.kind.
LOCAL_POINT, LOCAL_SPOT, LOCAL_AREA = range(3)
# Shadow rays to an area light, one to the middle of each quarter; points and spots take one.
AREA_SHADOW_RAYS = 4
# A lamp has a size: closer than this [m] its light grows no more. Else a surfel where the lamp hangs would take infinity.
LAMP_RADIUS_M = 0.05
# Shadow rays start this far off a surfel [m], whose position is a mean of hits and may lie a little below the surface,
SHADOW_START_M = 0.05
# and end this far before the lamp, so that a lamp on a ceiling or a wall is not hidden by it.
SHADOW_END_M = 0.02
# A surfel is looked up this far in front of its plane, in metres and in shares of its cell: its position is a mean of hits, which
# where the surface bends lies below some of it.
SHADOW_BIAS_M, SHADOW_BIAS_CELLS = 0.05, 0.05
# Points of a surfel's cell that are looked up in the shadow map, two texels each. Twice as many texels took half as long again, and the
# error was 5 % less.
SHADOW_TAPS = 4
# Floats from one row of the map to the next: 64 bytes more than the 1024 texels, so that texels under one another do not all compete for
# the same places of a cache.
SHADOW_ROW_TEXELS = 1040
# What makes weights of squares of harmonics' codes, beside a probe's scale (gi_core.factor_weights).
HARMONIC_SQUARES = (AMPLITUDES / SH_NORM).tolist()

_SCALARS = {"float": "f4", "uint": "u4", "int": "i4"}


@dataclass(frozen=True)
class Record:
    """A struct of 4-byte scalars and arrays of them; its size is a multiple of 16 bytes, padding is a named field.

    fields : (name, C type, length); length 1 is a scalar
    """

    name: str
    comment: str
    fields: tuple[tuple[str, str, int], ...]

    @cached_property
    def dtype(self) -> "np.dtype[Any]":
        """The same record in NumPy."""
        return np.dtype(
            [(name, _SCALARS[kind]) if length == 1 else (name, _SCALARS[kind], (length,)) for name, kind, length in self.fields]
        )


BOUNCE = Record(
    "Bounce",
    "How much of one row of the probes' light a brick sends on, per channel. row : ROW_ONE + probe * coefficients, and of the cube + face.",
    (("albedo", "float", 3), ("row", "uint", 1)),
)
DIRECTIONAL_LIGHT = Record(
    "DirectionalLight",
    "Sun or moon. irradiance [lx] on a surface that faces it; plane, plane_weight: the baked directions around it, and how to blend them.",
    (
        ("direction", "float", 4),
        ("irradiance", "float", 4),
        ("plane", "uint", PLANES_PER_LIGHT),
        ("plane_weight", "float", PLANES_PER_LIGHT),
    ),
)
VOLUME_BOX = Record(
    "VolumeBox",
    "Which of a sector's voxels go where in a volume: sizes and first indices along x, y, z.",
    (
        ("box_size", "int", 4),
        ("volume_first", "int", 4),
        ("volume_size", "int", 4),
        ("sector_first", "int", 4),
        ("sector_size", "int", 4),
    ),
)
SURFEL_WORD = Record(
    "SurfelWord",
    "Where 32 surfels are [m], sector-local, and their unit normals, by coordinate, and the box about them. A word of bits has as many.",
    (
        ("position_x", "float", SURFELS_PER_WORD),
        ("position_y", "float", SURFELS_PER_WORD),
        ("position_z", "float", SURFELS_PER_WORD),
        ("normal_x", "float", SURFELS_PER_WORD),
        ("normal_y", "float", SURFELS_PER_WORD),
        ("normal_z", "float", SURFELS_PER_WORD),
        ("low", "float", 3),
        ("padding_a", "float", 1),
        ("high", "float", 3),
        ("padding_b", "float", 1),
    ),
)
LOCAL_LIGHT = Record(
    "LocalLight",
    "A lamp, sector-local [m]. intensity [cd], or an area's radiance [cd m^-2]; axis and halves as gi_core/lights.py defines them.",
    (
        ("position", "float", 3),
        ("range", "float", 1),
        ("intensity", "float", 3),
        ("cos_outer", "float", 1),
        ("axis", "float", 3),
        ("cos_inner", "float", 1),
        ("half_u", "float", 3),
        ("kind", "uint", 1),
        ("half_v", "float", 3),
        ("first_plane", "uint", 1),
    ),
)
SHADOW_TRIANGLE = Record(
    "ShadowTriangle",
    "A corner and the two edges that leave it [m], local to the sector that it lies in.",
    (
        ("corner", "float", 3),
        ("padding_a", "float", 1),
        ("edge_a", "float", 3),
        ("padding_b", "float", 1),
        ("edge_b", "float", 3),
        ("padding_c", "float", 1),
    ),
)
SHADOW_FRAME = Record(
    "ShadowFrame",
    "A shadow map's axes, unit, world frame; size [texels] along each side; origin: a sector's, relative to the middle of the map [m].",
    (
        ("across", "float", 3),
        ("texels_per_metre", "float", 1),
        ("down", "float", 3),
        ("size", "float", 1),
        ("to_sun", "float", 3),
        ("padding_a", "float", 1),
        ("origin", "float", 3),
        ("padding_b", "float", 1),
    ),
)
SHADOW_NODE = Record(
    "ShadowNode",
    "A box about triangles [m]. skip: the next node for a ray that misses it. leaf: its first triangle * 8 + how many; 0 of a branch.",
    (("low", "float", 3), ("skip", "uint", 1), ("high", "float", 3), ("leaf", "uint", 1)),
)
SHADOW_TILE = Record(
    "ShadowTile",
    "One sector's nodes and triangles, where they are. offset [m]: from the lit sector's coordinates to its own.",
    (("offset", "float", 3), ("first_node", "uint", 1), ("end_node", "uint", 1), ("first_triangle", "uint", 1), ("padding", "uint", 2)),
)
RECORDS = (
    BOUNCE,
    DIRECTIONAL_LIGHT,
    VOLUME_BOX,
    LOCAL_LIGHT,
    SHADOW_TRIANGLE,
    SHADOW_FRAME,
    SURFEL_WORD,
    SHADOW_NODE,
    SHADOW_TILE,
)
CONSTANTS: dict[str, int | float] = {
    "MAX_DIRECTIONAL_LIGHTS": MAX_DIRECTIONAL_LIGHTS,
    "PLANES_PER_LIGHT": PLANES_PER_LIGHT,
    "SNOW_ALBEDO": SNOW_ALBEDO,
    "ROW_BITS": ROW_BITS,
    "ROW_ONE": ROW_ONE,
    "WHOLE_SAMPLE": WHOLE_SAMPLE,
    "NO_SAMPLE": NO_SAMPLE,
    "SURFELS_PER_WORD": SURFELS_PER_WORD,
    "LOCAL_POINT": LOCAL_POINT,
    "LOCAL_SPOT": LOCAL_SPOT,
    "LOCAL_AREA": LOCAL_AREA,
    "AREA_SHADOW_RAYS": AREA_SHADOW_RAYS,
    "LAMP_RADIUS_M": LAMP_RADIUS_M,
    "SHADOW_START_M": SHADOW_START_M,
    "SHADOW_END_M": SHADOW_END_M,
    "SHADOW_BIAS_M": SHADOW_BIAS_M,
    "SHADOW_BIAS_CELLS": SHADOW_BIAS_CELLS,
    "SHADOW_TAPS": SHADOW_TAPS,
    "SHADOW_ROW_TEXELS": SHADOW_ROW_TEXELS,
    **{f"SQUARE_{b}": value for b, value in enumerate(HARMONIC_SQUARES)},
}


def header_text() -> str:
    """The text of ``kernels_cl/layout.h``."""
    lines = ["// Generated by `python -m gi_core.layout`; edit gi_core/layout.py instead.", "#ifndef LAYOUT_H", "#define LAYOUT_H", ""]
    lines += [f"#define {name} {value}{'f' if isinstance(value, float) else ''}" for name, value in CONSTANTS.items()]
    for record in RECORDS:
        lines += ["", f"// {record.comment}", "typedef struct {"]
        lines += [f"    {kind} {name}{'' if length == 1 else f'[{length}]'};" for name, kind, length in record.fields]
        lines += [f"}} {record.name};"]
    return "\n".join([*lines, "", "#endif", ""])


if __name__ == "__main__":
    print(header_text(), end="")
