"""JSON replies. Field names are contract: clients read them."""

from typing import Any, Literal

from pydantic import BaseModel, Field

from gi_core.lighting import DirectionalLight, Lighting

Vector3 = tuple[float, float, float]


def vector3(values: Any) -> Vector3:
    """Three floats of any array-like (3,)."""
    x, y, z = (float(v) for v in values)
    return x, y, z


class HealthReply(BaseModel):
    status: str


class RefusedSector(BaseModel):
    sector: tuple[int, int]
    reason: str


class ReadyReply(BaseModel):
    status: str = Field(description="ready, or degraded when a sector's file was refused")
    device: str
    dataset: str = Field(description="digest of the dataset: replicas with the same digest give the same bytes")
    refused_sectors: list[RefusedSector]


class LightReply(BaseModel):
    """Sun or moon."""

    direction: Vector3 = Field(description="unit vector towards the light, world frame")
    irradiance: Vector3 = Field(description="lux per channel on a surface that faces it; 0 below the horizon")

    @classmethod
    def of(cls, light: DirectionalLight) -> "LightReply":
        return cls(direction=vector3(light.direction), irradiance=vector3(light.irradiance))


class FogReply(BaseModel):
    density: float = Field(description="extinction per metre")


class LightingReply(BaseModel):
    time: str
    weather: str
    sun: LightReply
    moon: LightReply
    sky_cube: list[Vector3] = Field(description="lux of the unobstructed sky along +X -X +Y -Y +Z -Z")
    snow: float
    fog: FogReply
    exposure: float = Field(description="EV100 that suits the scene")

    @classmethod
    def of(cls, lighting: Lighting) -> "LightingReply":
        return cls(
            time=lighting.time,
            weather=lighting.weather,
            sun=LightReply.of(lighting.sun),
            moon=LightReply.of(lighting.moon),
            sky_cube=[vector3(face) for face in lighting.sky_cube],
            snow=lighting.snow,
            fog=FogReply(density=lighting.fog_density),
            exposure=lighting.exposure,
        )


class BoundsReply(BaseModel):
    minimum: Vector3
    maximum: Vector3


class LocationReply(BaseModel):
    latitude_degrees: float
    longitude_degrees: float
    elevation_m: float
    timezone: str
    north_degrees: float
    date: str = Field(description="the day that a bare HH:MM means")
    source: str


class SectorGridReply(BaseModel):
    size_m: float
    count: int
    minimum: tuple[int, int] | None = Field(description="smallest sector x and z")
    maximum: tuple[int, int] | None = Field(description="largest sector x and z, inclusive")


class LimitsReply(BaseModel):
    probe_radius_m: float
    decal_radius_m: float
    preview_width: int
    probes_per_sector: int


class OpeningReply(BaseModel):
    minimum: Vector3
    maximum: Vector3


class DoorReply(OpeningReply):
    to: int = Field(description="number of the other room")


class RoomReply(BaseModel):
    number: int = Field(description="from 1; probes and interior volumes name rooms so")
    name: str
    minimum: Vector3
    maximum: Vector3
    shape: Literal["box", "cells"] = Field(description="cells: of its box only those of `kind=interior&weight=1` are its air, as of a mesh")
    found: bool = Field(description="the bake found it, and no author drew it")
    openings: list[OpeningReply] = Field(
        description="boxes, most of them flat, in which its air meets the open air: windows, and doors, which go on below the floor"
    )
    doors: list[DoorReply] = Field(description="the same between it and other rooms, from its side of the wall to theirs; each is in both")


class WorldReply(BaseModel):
    name: str
    bounds: BoundsReply
    location: LocationReply
    sectors: SectorGridReply
    weather: list[str] = Field(description="presets that `weather` may name")
    weather_overrides: dict[str, tuple[float, float]] = Field(description="numbers that `preset:name=value` may replace, and their ranges")
    time: str = Field(description="what `time` may be")
    voxel_size_m: float
    volume_shape: tuple[int, int, int] = Field(description="y, z, x")
    bases: list[str] = Field(description="what `basis` of a volume may be: the bake's, those poorer than it, and cube, the default")
    kinds: list[str] = Field(description="what `kind` of a volume may be: outdoor, fog, and where there are rooms interior")
    cascades: list[int] = Field(description="what `cascade` of a volume may be: -1 where fine voxels were baked")
    distant: list[str] = Field(description="what `light` of the distant texture may be, the default last")
    rooms: list[RoomReply]
    limits: LimitsReply
    dataset: dict[str, Any] = Field(description="digest, preset, basis, settings, counts and error report of the bake")


class SectorReply(BaseModel):
    sector: tuple[int, int]
    bytes: int
    digest: str
    probes: int
    href: str


class SectorsReply(BaseModel):
    size_m: float
    sectors: list[SectorReply]


class ProbeReply(BaseModel):
    sector: tuple[int, int]
    position: Vector3 = Field(description="world metres")
    cube: list[Vector3] = Field(description="lux along +X -X +Y -Y +Z -Z")
    room: int = Field(description="0 outdoors")
    flags: int = Field(description="bits: 1 on the ground, 2 on a wall, 4 beyond the sector's border")


class ProbesReply(BaseModel):
    time: str
    weather: str
    probes: list[ProbeReply]


class GradientReply(BaseModel):
    href: str = Field(description="a PNG of one row, 8 bits, linear: how much is hidden; clamp at its ends")
    low: float = Field(description="distance from an edge over height at the texture's left end, within the box")
    high: float = Field(description="the same at its right end, outside")
    below_m: float = Field(description="ground farther under a box is not darkened")


class DecalReply(BaseModel):
    name: str
    position: Vector3 = Field(description="world metres, the middle of the box's underside")
    size: Vector3 = Field(description="metres along the box's own x, y and z")
    yaw_degrees: float = Field(description="about +Y, counter-clockwise seen from above")
    world_from_box: list[tuple[float, float, float, float]] = Field(description="four rows: from the box's own metres to the world's")
    distance: float = Field(description="metres from the queried point to `position`")


class DecalsReply(BaseModel):
    gradient: GradientReply
    decals: list[DecalReply] = Field(description="closest first")
