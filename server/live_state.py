"""What the live world is told to be: clock, weather, settings, lamps, boxes, players. Immutable; commands make another state of it.

Requests don't change the world: they hand in commands, which the ticker applies in order between two ticks. So a tick sees one state,
and a command either takes effect whole, from the tick that its reply names, or not at all.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Literal, TypeVar

from gi_core.errors import InputError, SectorlightError
from gi_core.settings import NEUTRAL, Settings
from gi_core.shadow_plan import MovingBox
from gi_core.world import Lamp
from server.live_weather import WeatherSource
from server.path_walk import PathWalk
from server.players import MAX_PLAYERS, Player
from server.world_clock import WorldClock

MAX_LAMPS = 20_000
# Their triangles, twelve each, are drawn in one tick, at half a millisecond a thousand.
MAX_BOXES = 256
# What there is one of, and may be kept.
Part = Literal["clock", "weather", "settings"]
# What the live world has of a sector.
Residency = Literal["read by a player", "resident", "failed", "not resident"]
_NOT_OF_IDS = re.compile(r"[^A-Za-z0-9_-]+")


class NoSuchThingError(InputError, LookupError):
    """A player, a lamp or a box that is not there: HTTP 404."""

    code = "no_such_id"


class TakenIdError(InputError):
    """An id that is in use: HTTP 409."""

    code = "id_taken"


class LiveUnavailableError(SectorlightError, RuntimeError):
    """The live world cannot answer now: HTTP 503."""

    code = "live_unavailable"


class NotKeptError(SectorlightError, RuntimeError):
    """A change that took effect but could not be written to the state file: HTTP 507."""

    code = "not_kept"


@dataclass(frozen=True)
class LiveLamp:
    """A lamp of the live world.

    dynamic : evaluated apart, so that it can move every tick; kept : written to the state file, and back after a restart
    """

    id: str
    lamp: Lamp
    dynamic: bool = False
    kept: bool = False


@dataclass(frozen=True)
class LiveBox:
    """A moving box of the live world. kept : written to the state file, and back after a restart"""

    id: str
    box: MovingBox
    kept: bool = False


@dataclass(frozen=True, eq=False)
class LivePlayer:
    """A simulated player and the walk it is on since a tick."""

    player: Player
    walk: PathWalk
    since_tick: int
    kept: bool = False


@dataclass(frozen=True, eq=False)
class LiveState:
    """The world as it is told to be at a tick.

    jumps : counts what made light or players jump on purpose
    kept : which of clock, weather and settings are written to the state file, and back after a restart
    """

    clock: WorldClock
    weather: WeatherSource
    settings: Settings = NEUTRAL
    lamps: Mapping[str, LiveLamp] = field(default_factory=lambda: MappingProxyType({}))
    players: Mapping[str, LivePlayer] = field(default_factory=lambda: MappingProxyType({}))
    boxes: Mapping[str, LiveBox] = field(default_factory=lambda: MappingProxyType({}))
    jumps: int = 0
    kept: frozenset[Part] = frozenset()

    @cached_property
    def moving_boxes(self) -> tuple[MovingBox, ...]:
        """The boxes as ticks take them, the same tuple each time: another is looked at anew."""
        return tuple(entry.box for entry in self.boxes.values())

    def expect_room_for(self, name: str) -> None:
        """Raises TakenIdError where a player of that name is there, and InputError when there are too many."""
        if name in self.players:
            raise TakenIdError(f"player {name!r}: expected a new id, found one in use; delete that player first")
        if len(self.players) >= MAX_PLAYERS:
            raise InputError(f"players: expected at most {MAX_PLAYERS}, found as many already")

    def with_player(self, added: LivePlayer) -> "LiveState":
        """Another player. Raises as ``expect_room_for`` does."""
        self.expect_room_for(added.player.id)
        return replace(self, players=MappingProxyType({**self.players, added.player.id: added}))

    def without_player(self, name: str) -> "LiveState":
        """One player less. Raises NoSuchThingError."""
        return replace(self, players=_without(self.players, name, "player"))

    def with_lamp(self, lamp: LiveLamp, new: bool) -> "LiveState":
        """Another lamp, or one changed. Raises TakenIdError, NoSuchThingError, and InputError when there are too many."""
        return replace(self, lamps=_with(self.lamps, lamp, "light", MAX_LAMPS, new))

    def without_lamp(self, name: str) -> "LiveState":
        """One lamp less. Raises NoSuchThingError."""
        return replace(self, lamps=_without(self.lamps, name, "light"))

    def with_box(self, box: LiveBox, new: bool) -> "LiveState":
        """Another box, or one changed. Raises TakenIdError, NoSuchThingError, and InputError when there are too many."""
        return replace(self, boxes=_with(self.boxes, box, "box", MAX_BOXES, new))

    def without_box(self, name: str) -> "LiveState":
        """One box less. Raises NoSuchThingError."""
        return replace(self, boxes=_without(self.boxes, name, "box"))

    def with_clock(self, clock: WorldClock, is_jump: bool) -> "LiveState":
        """Another clock."""
        return replace(self, clock=clock, jumps=self.jumps + is_jump)

    def with_weather(self, weather: WeatherSource, is_jump: bool) -> "LiveState":
        """Another weather."""
        return replace(self, weather=weather, jumps=self.jumps + is_jump)

    def with_settings(self, settings: Settings) -> "LiveState":
        """Other settings, which light follows at once."""
        return replace(self, settings=settings, jumps=self.jumps + 1)

    def keeping(self, part: Part, keep: bool) -> "LiveState":
        """The same, with a part that is kept or is not."""
        return self if keep == (part in self.kept) else replace(self, kept=self.kept ^ {part})

    def lamp(self, name: str) -> LiveLamp:
        """A lamp by its id. Raises NoSuchThingError."""
        return _found(self.lamps, name, "light")

    def box(self, name: str) -> LiveBox:
        """A box by its id. Raises NoSuchThingError."""
        return _found(self.boxes, name, "box")

    def player(self, name: str) -> LivePlayer:
        """A player by its id. Raises NoSuchThingError."""
        return _found(self.players, name, "player")


# From the state before a tick, and its number, to the state in that tick.
Command = Callable[[LiveState, int], LiveState]


@dataclass(frozen=True)
class Applied:
    """What a command did: the tick from which it holds, and the state in it."""

    tick: int
    state: LiveState


Thing = TypeVar("Thing")
Changeable = TypeVar("Changeable", LiveLamp, LiveBox)


def authored_lamps(lamps: tuple[Lamp, ...]) -> Mapping[str, LiveLamp]:
    """The dataset's lamps under ids: their names as far as ids have such letters, where those are distinct, else their numbers."""
    found: dict[str, LiveLamp] = {}
    for number, lamp in enumerate(lamps):
        name = _NOT_OF_IDS.sub("-", lamp.name).strip("-")[:64]
        name = name if name and name not in found else f"lamp-{number}"
        while name in found:  # somebody named a lamp like that
            name += "-"
        found[name] = LiveLamp(name, lamp)
    return MappingProxyType(found)


def _with(things: Mapping[str, Changeable], thing: Changeable, what: str, most: int, new: bool) -> Mapping[str, Changeable]:
    """Another thing, or one changed."""
    if not new:
        _found(things, thing.id, what)
    elif thing.id in things:
        raise TakenIdError(f"{what} {thing.id!r}: expected a new id, found one in use; PATCH changes a {what}")
    elif len(things) >= most:
        raise InputError(f"{what}: expected at most {most} of them, found as many already")
    return MappingProxyType({**things, thing.id: thing})


def _without(things: Mapping[str, Thing], name: str, what: str) -> Mapping[str, Thing]:
    _found(things, name, what)
    return MappingProxyType({key: value for key, value in things.items() if key != name})


def _found(things: Mapping[str, Thing], name: str, what: str) -> Thing:
    if name not in things:
        raise NoSuchThingError(f"{what} {name[:64]!r}: expected the id of a {what} that is there, found none")
    return things[name]
