"""The live world's clock: which moment each tick shows.

A clock is a law, not a counter: the moment of a tick is computed from the tick's number, in whole microseconds, so nothing adds up
from tick to tick. Changing the rate, pausing and jumping give a new law that begins at a tick; the part of a microsecond by which the
old law had gone on is carried over, so that a million changes drift no more than one.

    moment(n) = start + floor((n - start_tick) * rate_millionths + remainder, ticks_per_second) microseconds
"""

import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cached_property
from typing import Any

from gi_core.clock_time import FIRST_YEAR, LAST_YEAR, local_time, parse_time
from gi_core.errors import InputError, UnknownTimeError
from gi_core.world import Location
from server.json_input import Members, shown

MAX_RATE = 3600.0  # a day in 24 s; faster than that the light itself would flicker
DEFAULT_TICKS_PER_SECOND = 30
_MILLION = 1_000_000
_MICROSECOND = timedelta(microseconds=1)
# What ``clock_to_json`` writes beyond what people do: parts of a second, and offsets with seconds, which local mean time had.
_WRITTEN = re.compile(r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}(\.\d{6})?[+-]\d{2}:\d{2}(:\d{2}(\.\d{6})?)?", re.ASCII)
_CHANGES = ("time", "rate", "paused")


@dataclass(frozen=True)
class WorldClock:
    """How the world's time goes on from a tick.

    start : aware, in the place's zone: the moment of ``start_tick``
    start_tick : from which on this law holds
    rate_millionths : how fast the world's time runs, in millionths of real time, 0..3600 million
    paused : time stands still, and goes on at the same rate afterwards
    ticks_per_second : of real time
    remainder : parts of a microsecond by which the moment of ``start_tick`` is later than ``start``, in 1 / ticks_per_second
    """

    start: datetime
    start_tick: int = 0
    rate_millionths: int = _MILLION
    paused: bool = False
    ticks_per_second: int = DEFAULT_TICKS_PER_SECOND
    remainder: int = 0

    @property
    def rate(self) -> float:
        """World seconds that pass in a second of real time when the clock is not paused."""
        return self.rate_millionths / _MILLION

    @cached_property
    def last_tick(self) -> int | None:
        """The last tick whose moment is before the end of year 2599; None when the clock stands still. A ticker pauses there."""
        if self._step == 0:
            return None
        return self.start_tick + (self._left * self.ticks_per_second - 1 - self.remainder) // self._step

    def moment_at(self, tick: int) -> datetime:
        """The moment of a tick: aware, in the place's zone. Raises UnknownTimeError once the clock has run beyond year 2599."""
        microseconds, _ = self._passed(tick)
        if microseconds >= self._left:
            raise UnknownTimeError(
                f"clock: expected a moment before the end of year {LAST_YEAR}, found one {microseconds / _MILLION:.0f} s after"
                f" {self.start.isoformat()}; jump to an earlier time"
            )
        return (self.start.astimezone(UTC) + microseconds * _MICROSECOND).astimezone(self.start.tzinfo)

    def with_rate(self, tick: int, rate: float) -> "WorldClock":
        """The clock that runs at another rate from ``tick`` on, kept to a millionth. Raises InputError outside of 0..3600."""
        if not 0 <= rate <= MAX_RATE:
            raise InputError(f"clock: rate: expected a number of 0..{MAX_RATE:g}, found {rate}")
        return replace(self._from(tick), rate_millionths=round(rate * _MILLION))

    def with_paused(self, tick: int, paused: bool) -> "WorldClock":
        """The clock that stands still, or goes on, from ``tick`` on."""
        return replace(self._from(tick), paused=paused)

    def going_on_as(self, other: "WorldClock", tick: int) -> "WorldClock":
        """The clock that goes on from what it shows at ``tick``, or at its last, as another one runs or stands."""
        tick = tick if self.last_tick is None else min(tick, self.last_tick)
        return replace(self._from(tick), rate_millionths=other.rate_millionths, paused=other.paused)

    def jumped(self, tick: int, text: str, location: Location) -> "WorldClock":
        """The clock that shows another moment at ``tick``, at the same rate.

        ``text`` is what ``parse_time`` takes, or what ``clock_to_json`` wrote; HH:MM means the day that the clock shows at ``tick``.
        Raises UnknownTimeError for anything else. A clock that ran beyond year 2599 can jump back with a date.
        """
        return replace(self, start=_parse_moment(text, location, self._day_for(text, tick)), start_tick=tick, remainder=0)

    @property
    def _step(self) -> int:
        """What a tick adds, in microseconds / ticks_per_second."""
        return 0 if self.paused else self.rate_millionths

    @cached_property
    def _left(self) -> int:
        """Microseconds from ``start`` to the end of the last year, which no moment may reach."""
        # By way of UTC: datetimes of one zone are subtracted as their clocks read, which change twice a year.
        end = datetime(LAST_YEAR + 1, 1, 1, tzinfo=self.start.tzinfo)
        return (end.astimezone(UTC) - self.start.astimezone(UTC)) // _MICROSECOND

    def _passed(self, tick: int) -> tuple[int, int]:
        """Whole microseconds since ``start`` at a tick, and the remainder."""
        if tick < self.start_tick:
            raise ValueError(f"tick {tick}: this clock holds from tick {self.start_tick} on")
        return divmod((tick - self.start_tick) * self._step + self.remainder, self.ticks_per_second)

    def _from(self, tick: int) -> "WorldClock":
        """The same law, written down at a later tick."""
        return replace(self, start=self.moment_at(tick), start_tick=tick, remainder=self._passed(tick)[1])

    def _day_for(self, text: str, tick: int) -> datetime | None:
        return None if "-" in text else self.moment_at(tick)


def starting_clock(location: Location, time: str, ticks_per_second: int = DEFAULT_TICKS_PER_SECOND) -> WorldClock:
    """A clock that shows ``time`` at tick 0; HH:MM means the location's own date. Raises UnknownTimeError."""
    if ticks_per_second < 1:
        raise ValueError(f"expected at least one tick a second, got {ticks_per_second}")
    return WorldClock(_parse_moment(time, location, None), ticks_per_second=ticks_per_second)


def clock_to_json(clock: WorldClock, tick: int) -> dict[str, Any]:
    """What a clock shows at a tick. ``changed_clock`` takes it back without its tick."""
    return {"time": clock.moment_at(tick).isoformat(), "rate": clock.rate, "paused": clock.paused, "tick": tick}


def changed_clock(clock: WorldClock, tick: int, record: Any, location: Location) -> WorldClock:
    """The clock after a request: an object with any of ``time``, ``rate`` and ``paused``, all of which apply at ``tick`` together.

    Raises InputError, and nothing has changed then.
    """
    members = Members(record, "clock", _CHANGES)
    if not any(name in members for name in _CHANGES):
        raise InputError(f"clock: expected any of {', '.join(_CHANGES)}, found nothing")
    # First the jump: it is the way back for a clock that ran beyond the end.
    if "time" in members:
        text = members.value("time")
        if not isinstance(text, str):
            raise InputError(f"clock: time: expected a text, found {shown(text)}")
        clock = clock.jumped(tick, text, location)
    if "rate" in members:
        clock = clock.with_rate(tick, members.number("rate", None, 0.0, MAX_RATE))
    if "paused" in members:
        clock = clock.with_paused(tick, members.flag("paused", clock.paused))
    return clock


def _parse_moment(text: str, location: Location, today: datetime | None) -> datetime:
    """A moment within the supported years as the place's clocks show them; ``today`` is what HH:MM counts from."""
    if _WRITTEN.fullmatch(text):
        try:
            moment = local_time(datetime.fromisoformat(text), location)
        except (ValueError, OverflowError) as error:
            raise UnknownTimeError(f"time {text!r}: {error}") from error
    else:
        moment = parse_time(text, location if today is None else replace(location, date=today.date()))
    # An offset can put a moment of a supported year into one that is not, here.
    if not FIRST_YEAR <= moment.year <= LAST_YEAR:
        raise UnknownTimeError(f"time {text!r}: expected a local year of {FIRST_YEAR}..{LAST_YEAR}, found {moment.isoformat()}")
    return moment
