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
    time: str = Field(description="local time with offset, ISO 8601")
    weather: str = Field(description="what `weather` of a query takes to get this very weather")
    sun: LightReply = Field(description="`direction`, unit, towards it, world frame; `irradiance` [lx] on a surface that faces it")
    moon: LightReply = Field(description="the same")
    sky_cube: list[Vector3] = Field(description="lux of the unobstructed sky along +X -X +Y -Y +Z -Z")
    snow: float = Field(description="0..1, how much of what lies open to the sky is white")
    fog: FogReply = Field(description="`density`: extinction per metre")
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
    minimum: Vector3 = Field(description="world metres")
    maximum: Vector3 = Field(description="world metres")


class LocationReply(BaseModel):
    latitude_degrees: float
    longitude_degrees: float
    elevation_m: float
    timezone: str
    north_degrees: float = Field(description="compass azimuth of -Z")
    date: str = Field(description="the day that a bare HH:MM means")
    source: str = Field(description="given, or default where the source did not say")


class SectorGridReply(BaseModel):
    size_m: float
    count: int
    minimum: tuple[int, int] | None = Field(description="smallest sector x and z")
    maximum: tuple[int, int] | None = Field(description="largest sector x and z, inclusive")


class LimitsReply(BaseModel):
    probe_radius_m: float
    decal_radius_m: float
    preview_width: int = Field(description="pixels")
    probes_per_sector: int
    body_bytes: int = Field(description="of what a write sends")
    players: int = Field(description="of the live world, as are the next three")
    lights: int
    boxes: int
    streams: int = Field(description="of players' volumes, all clients together")


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
        description="boxes, most through a wall, in which its air meets the open air: windows, and doors, which go on below the floor"
    )
    doors: list[DoorReply] = Field(description="the same between it and other rooms, from its side of the wall to theirs; each is in both")


class WorldReply(BaseModel):
    name: str
    bounds: BoundsReply = Field(description="`minimum` and `maximum` of the geometry, world metres")
    location: LocationReply = Field(description="latitude, longitude, elevation, time zone, compass azimuth of -Z, date of a bare HH:MM")
    sectors: SectorGridReply = Field(description="how large sectors are, how many were baked, and the least and greatest x and z of them")
    weather: list[str] = Field(description="presets that `weather` may name")
    weather_overrides: dict[str, tuple[float, float]] = Field(description="numbers that `preset:name=value` may replace, and their ranges")
    time: str = Field(description="what `time` may be")
    voxel_size_m: float
    volume_shape: tuple[int, int, int] = Field(description="y, z, x")
    bases: list[str] = Field(description="what `basis` of a volume may be: the bake's, those poorer than it, and cube, the default")
    kinds: list[str] = Field(description="what `kind` of a volume may be: outdoor, fog, and where there are rooms interior")
    cascades: list[int] = Field(description="what `cascade` of a volume may be: -1 where fine voxels were baked")
    distant: list[str] = Field(description="what `light` of the distant texture may be, the default last")
    rooms: list[RoomReply] = Field(description="their boxes in world metres, and the openings of each")
    limits: LimitsReply = Field(description="of what may be asked for")
    dataset: dict[str, Any] = Field(description="digest, preset, basis, settings, counts and error report of the bake")


class SectorReply(BaseModel):
    sector: tuple[int, int] = Field(description="x, z: it covers [64 x, 64 x + 64) by [64 z, 64 z + 64) m")
    bytes: int
    digest: str = Field(description="BLAKE2b, 16 bytes, of the file; its ETag")
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
