"""What a whole world has: where on Earth it lies, its rooms, lamps and decals. Part of world.json; no geometry."""

import re
from dataclasses import dataclass
from datetime import date
from typing import Any

import numpy as np

from gi_core.arrays import Float64
from gi_core.constants import ROOM_CELL_M


@dataclass(frozen=True)
class Location:
    """Where and when the world is.

    latitude_degrees, longitude_degrees : WGS84, north and east positive
    elevation_m : above the sea
    timezone : IANA name; local times are read in it
    north_degrees : compass azimuth of the world's -Z axis, clockwise from true north, so that streets can run along the axes
    date : the day that a bare ``HH:MM`` means
    source : "given", or "default" when the input says nothing about its place
    """

    latitude_degrees: float = 40.7484
    longitude_degrees: float = -73.9857
    elevation_m: float = 10.0
    timezone: str = "America/New_York"
    north_degrees: float = 0.0
    date: date = date(2024, 6, 21)
    source: str = "default"


@dataclass(frozen=True)
class Opening:
    """An axis-aligned box, most often flat, in which the air of a room meets the open air, or that of another room.

    minimum, maximum : as of a room
    to : the number of the other room, from 1; 0 is the open air
    """

    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]
    to: int = 0


@dataclass(frozen=True)
class RoomCells:
    """The shape of a room that is no box: which cells of its box hold its air.

    first : world lattice index (x, y, z) of cell (0, 0, 0); shape : cells along x, y, z
    bits : a bit a cell, x fastest, then z, then y, the lowest bit of each byte first
    size_m : a cell's width [m], each way; lattices begin at the world's origin
    """

    first: tuple[int, int, int]
    shape: tuple[int, int, int]
    bits: bytes
    size_m: float = ROOM_CELL_M


@dataclass(frozen=True)
class Room:
    """Indoor air: an axis-aligned box, or the cells of one. ``minimum`` and ``maximum`` are world positions (x, y, z) [m].

    cells : of a room that the bake found, or whose author drew a mesh; None of one that is its box
    """

    name: str
    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]
    openings: tuple[Opening, ...] = ()
    cells: RoomCells | None = None

    @property
    def is_found(self) -> bool:
        """Whether the bake found it, and no author drew it."""
        return self.cells is not None and is_found_name(self.name)

    def box_json(self) -> dict[str, Any]:
        """What an author says of it, as JSON has it."""
        return {"name": self.name, "minimum": self.minimum, "maximum": self.maximum}


def is_found_name(name: str) -> bool:
    """Whether a room of that name, where it is no box, was found by the bake: ``found-1`` and so on."""
    return re.fullmatch(r"found-[0-9]+", name) is not None


LAMP_KINDS = ("point", "spot", "area")


@dataclass(frozen=True)
class Lamp:
    """A local light as authored. Carried in the dataset.

    kind : "point"; "spot", a cone about ``direction``; "area", a rectangle that shines to the side of ``direction``, its normal
    position : (x, y, z) [m], of an area its centre
    lumens : luminous flux [lm]
    color : linear sRGB; only its ratios count, since the lumens say how much
    range_m : light fades smoothly and beyond this, measured from ``position``, there is none
    direction : (x, y, z), of any length but 0; a point ignores it
    cone_degrees : full angle of a spot's cone, 1..180
    size : width and height of an area [m]; the width is level, or along x when the normal is vertical
    schedule : "always", "night" (the sun is below the horizon), or local times such as "18:00-23:30"
    """

    name: str
    kind: str
    position: tuple[float, float, float]
    lumens: float
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    range_m: float = 30.0
    direction: tuple[float, float, float] = (0.0, -1.0, 0.0)
    cone_degrees: float = 90.0
    size: tuple[float, float] = (1.0, 1.0)
    schedule: str = "always"


@dataclass(frozen=True)
class Decal:
    """A box that hides light from the ground under and beside it: a parked vehicle that the mesh does not have (slide "Ambient occlusion").

    position : (x, y, z) [m], world frame, the middle of its underside
    size : width, height and length [m] along its own x, y and z
    yaw_degrees : turn about +Y, counter-clockwise seen from above: 90 turns its x axis to the world's -Z
    """

    name: str
    position: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw_degrees: float = 0.0


def direction_from_azimuth(azimuth_degrees: float, elevation_degrees: float, north_degrees: float) -> Float64:
    """Unit vector (3,) in the world frame towards a compass azimuth (clockwise from true north) and an elevation.

    With north_degrees = 0, azimuth 0 is -Z and azimuth 90 is +X.
    """
    azimuth = np.radians(azimuth_degrees - north_degrees)
    elevation = np.radians(elevation_degrees)
    level = np.cos(elevation)
    return np.array([level * np.sin(azimuth), np.sin(elevation), -level * np.cos(azimuth)])


def world_from_east_north(east: Float64, north: Float64, north_degrees: float) -> tuple[Float64, Float64]:
    """World x and z [m] of offsets towards true east and true north [m], arrays of any equal shape."""
    turn = np.radians(north_degrees)
    # A compass bearing b lies at bearing b - north_degrees from -Z.
    x = east * np.cos(turn) - north * np.sin(turn)
    minus_z = east * np.sin(turn) + north * np.cos(turn)
    return x, -minus_z
