"""The light of a running clock: snapshots ahead of time, made by a thread of their own, and blended for each tick.

A snapshot takes some milliseconds to make, and a tick must not wait for it. The track keeps the two snapshots about the present and has
the next one made meanwhile. Steps are short against how fast the sky changes, and grow with the clock's rate: at 600 x, five minutes.
Where the clock stands still the light is the moment's own, to the bit what a query gives.
"""

import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from datetime import UTC, datetime, timedelta

from gi_core.light_blend import between_lightings
from gi_core.lighting import Lighting
from gi_core.lighting_model import make_lighting
from gi_core.user_sky import UserSky, lighting_with_sky
from gi_core.weather import Weather
from gi_core.world import Location

# The sun moves by a twelfth of a degree in this, a sixth of its disc; deep twilight changes by 6 %, a straight line through which
# is off by 0.05 %.
SHORTEST_STEP_S = 20.0
# Real time that one step lasts at least: as often as one core makes a snapshot, with much to spare.
STEP_REAL_S = 0.5
# Blends within a step: a third of a second of a clock that runs at 1 x, in which the sky changes by less than any eye or file sees.
BLENDS_PER_STEP = 64
# Of this moment, and of one that somebody looks ahead to.
KEPT_BLENDS = 8
_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)

WeatherAt = Callable[[datetime], Weather]


class LightTrack:
    """The light at the moments that a clock shows, in any order. One thread asks; ``worker`` makes what it will ask for next."""

    def __init__(self, location: Location, worker: Executor, weather_at: WeatherAt, sky: UserSky | None = None) -> None:
        """``sky`` takes the place of the model's."""
        self._location = location
        self._sky = sky
        self._worker = worker
        self._weather_at = weather_at
        self._step_s = 0.0
        self._begin = _EPOCH
        """From when on there are snapshots in such steps. The weather may be another from then on: none is made of the time before."""
        self._made: dict[int, Future[Lighting]] = {}
        self._standing: tuple[datetime, Future[Lighting]] | None = None
        self._blended: dict[tuple[int, int], Lighting] = {}
        """By step and part of it: of the moments that were asked for last."""

    def has(self, moment: datetime, rate: float) -> bool:
        """Whether ``at`` would not wait for the same; nothing is made."""
        if rate == 0:
            return self._standing is not None and self._standing[0] == moment.astimezone(UTC) and self._standing[1].done()
        if _step_s(rate) != self._step_s or moment < self._begin:
            return False
        here = self._number_of(moment)
        return all(number in self._made and self._made[number].done() for number in (here, here + 1))

    def is_ready(self, moment: datetime, rate: float) -> bool:
        """As ``has``; what it lacks is made from now on, in place of what another rate or an earlier moment asks for."""
        if rate == 0:
            self._have_standing(moment)
        else:
            here = self._step_of(moment, rate)
            self._have_made(here, here + 1)
        return self.has(moment, rate)

    def at(self, moment: datetime, rate: float) -> Lighting:
        """The light at an aware moment while the clock runs at ``rate`` x real time (0: it stands).

        Waits only for what could not be foreseen: a first moment, a jump, another rate. Raises UnknownTimeError beyond the supported
        years, once the clock stands there.
        """
        if rate == 0:
            return self._have_standing(moment).result()
        self._standing = None
        here = self._step_of(moment, rate)
        self._have_made(here, here + 1)
        # The one before stays for who looks ahead over its end, and then asks for now.
        for number in [n for n in self._made if not here - 1 <= n <= here + 2]:
            del self._made[number]
        begin = self._moment_of(here)
        length = self._moment_of(here + 1) - begin
        part = math.floor((moment - begin) / length * BLENDS_PER_STEP)
        found = self._blended.get((here, part))
        if found is None:
            first, second = self._made[here].result(), self._made[here + 1].result()
            time = (begin + part / BLENDS_PER_STEP * length).astimezone(moment.tzinfo).isoformat()
            found = self._blended[here, part] = between_lightings(first, second, part / BLENDS_PER_STEP, time)
            while len(self._blended) > KEPT_BLENDS:
                del self._blended[next(iter(self._blended))]
        # Last, so that the worker does not take Python's lock from who asks.
        self._have_made(here + 2)
        return found

    def _step_of(self, moment: datetime, rate: float) -> int:
        """The step that a moment is in. Where the rate asks for steps of another length, or the moment is before all, they begin anew."""
        step_s = _step_s(rate)
        if step_s != self._step_s or moment < self._begin:
            self._step_s, self._begin = step_s, moment.astimezone(UTC)
            self._made.clear()
            self._blended.clear()
        return self._number_of(moment)

    def _number_of(self, moment: datetime) -> int:
        """Of the step that a moment is in."""
        return math.floor((moment - _EPOCH).total_seconds() / self._step_s)

    def _moment_of(self, number: int) -> datetime:
        """When a step begins."""
        return max(_EPOCH + timedelta(seconds=number * self._step_s), self._begin)

    def _have_standing(self, moment: datetime) -> Future[Lighting]:
        utc = moment.astimezone(UTC)  # equal only to the same moment, also in the hour that clocks repeat
        if self._standing is None or self._standing[0] != utc:
            self._standing = utc, self._worker.submit(self._lighting, moment)
        return self._standing[1]

    def _have_made(self, *numbers: int) -> None:
        for number in numbers:
            if number not in self._made:
                # A clock that runs at 60 x makes two a second: kept, they would push out what queries ask for again and again.
                self._made[number] = self._worker.submit(self._lighting, self._moment_of(number), keep=False)

    def _lighting(self, moment: datetime, keep: bool = True) -> Lighting:
        lighting = make_lighting(self._location, moment, self._weather_at(moment), keep)
        with_sky = lighting_with_sky if keep else lighting_with_sky.__wrapped__
        return lighting if self._sky is None else with_sky(lighting, self._sky)


def _step_s(rate: float) -> float:
    """How long a step of a clock that runs at a rate is [s]."""
    return max(SHORTEST_STEP_S, 2.0 ** math.ceil(math.log2(max(rate * STEP_REAL_S, 1.0))))
