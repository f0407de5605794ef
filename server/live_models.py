"""JSON replies about the live world. Field names are contract: clients read them."""

from typing import Any

from pydantic import BaseModel, Field

from server.models import Vector3

_TICK = Field(description="the tick that this was true in; of a write: the first in which it holds")
_KEEP = Field(description="whether it is in the server's --state file, and back after a restart")


class ClockReply(BaseModel):
    time: str = Field(description="local time with offset, ISO 8601")
    rate: float = Field(description="world seconds per second")
    paused: bool
    keep: bool = _KEEP
    tick: int = _TICK


class WeatherNow(BaseModel):
    text: str = Field(description="what `weather` of a query takes to get this very weather")
    cloud_cover: float = Field(description="0..1, share of the sky")
    cloud_transmission: float = Field(description="of light through clouds, 0..1")
    haze: float = Field(description="aerosol optical depth at 550 nm")
    fog_density: float = Field(description="extinction per metre")
    snow: float = Field(description="0..1")


class WeatherReply(BaseModel):
    asked: dict[str, Any] = Field(description="what PUT was told last: weather, script_seed or measured")
    now: WeatherNow = Field(description="of this tick, on the way from one weather to another as well")
    keep: bool = _KEEP
    tick: int = _TICK


class SettingsReply(BaseModel):
    bounce_factor: float
    sky_factor: float
    sun_factor: float
    lights_factor: float
    sky_boost: Vector3 = Field(description="cd/m2")
    ambient_factor: float
    ambient_up: Vector3 = Field(description="lux")
    ambient_down: Vector3 = Field(description="lux")
    exterior_ambient_scale: float
    interior_ambient_scale: float
    keep: bool = _KEEP
    tick: int = _TICK


class Light(BaseModel):
    id: str
    kind: str
    position: Vector3 = Field(description="world metres")
    lumens: float
    color: Vector3 = Field(description="linear; its ratios alone count")
    range_m: float
    direction: Vector3 = Field(description="of spots and areas")
    cone_degrees: float = Field(description="full angle of a spot")
    size: tuple[float, float] = Field(description="width and height of an area [m]")
    schedule: str
    dynamic: bool
    keep: bool = _KEEP


class LightReply(Light):
    tick: int = _TICK


class LightsReply(BaseModel):
    lights: list[Light]
    tick: int = _TICK


class Box(BaseModel):
    id: str
    position: Vector3 = Field(description="of its middle, world metres")
    half_size: Vector3 = Field(description="along its own axes [m]")
    turned_degrees: float = Field(description="about the vertical, from +X towards -Z")
    keep: bool = _KEEP


class BoxReply(Box):
    tick: int = _TICK


class BoxesReply(BaseModel):
    boxes: list[Box]
    tick: int = _TICK


class Whereabouts(BaseModel):
    id: str
    position: Vector3 = Field(description="world metres")
    velocity: Vector3 = Field(description="m/s")
    heading_degrees: float = Field(description="0 looks along -Z, 90 along +X")
    since_tick: int = Field(description="when its walk began")
    keep: bool = _KEEP


class PlayerReply(Whereabouts):
    speed: float = Field(description="m/s")
    path: list[Vector3] | None = Field(None, description="null for a walk along streets")
    loop: bool
    pause_s: tuple[float, float] = Field(description="shortest and longest at a corner")
    turn_s: float
    seed: int
    walk_m: float
    near: Vector3 | None = Field(None, description="world metres")
    tick: int = _TICK


class PlayersReply(BaseModel):
    players: list[Whereabouts]
    tick: int = _TICK


class GoneReply(BaseModel):
    id: str
    tick: int = _TICK


class Percentiles(BaseModel):
    p50: float
    p99: float
    max: float


class TickTimes(BaseModel):
    """A list of ticks, and of each how long it took and how late it began."""

    tick: list[int]
    ms: list[float]
    lateness_ms: list[float]


class FailedSector(BaseModel):
    sector: tuple[int, int]
    attempts: int
    retry_in_s: float
    reason: str


class Streams(BaseModel):
    clients: int
    frames: int
    bytes: int


class CacheCounts(BaseModel):
    hits: int = Field(description="queries that were answered with bytes made before")
    misses: int
    bytes: int
    player_volume_hits: int
    player_volume_misses: int


class LiveReply(BaseModel):
    tick: int
    tick_rate: int = Field(description="Hz")
    tick_ms: Percentiles
    parts_ms: dict[str, Percentiles]
    lateness_ms: Percentiles = Field(description="by how much ticks began after they were due")
    late_ticks: int = Field(description="ended after the next was due")
    skipped: int = Field(description="had passed before they could begin")
    ticks: int
    failed_ticks: int
    failure: str | None = Field(description="why the last tick failed; null when it did not")
    misses: int = Field(description="sectors that volumes read and that were not there, summed over ticks")
    loads: int
    evictions: int
    resident_sectors: int
    resident_bytes: int = Field(description="of those, on the device and in the process's memory, as the budget counts them")
    loading: int
    failures: list[FailedSector]
    relit: int
    settled: int
    volumes: int = Field(description="filled since the start")
    waiting: int = Field(description="volumes that wait for another tick")
    players: int
    lamps: int
    boxes: int
    jumps: int = Field(description="changes of clock, weather and settings at once, which light follows at once")
    streams: Streams
    memory_bytes: int | None
    cache: CacheCounts
    recent: TickTimes | None = Field(description="ticks of the last minute that are later than `since`; null without it")
