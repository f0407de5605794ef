"""The live world's heartbeat: one thread, a fixed rate, never two ticks at once.

Tick n is due at start + n / rate, whatever the ticks before took: nothing drifts. A tick that is late begins at once; one whose
successor is already due is skipped, and its number with it, so that the world's clock stays true to real time. What is left out under
load, in this order: details for /v1/live, which are made when asked for; volumes, which wait for later ticks, those first whose light has
changed far from their players (gi_core.fill_plan). Streaming and relighting are never left out.
"""

import gc
import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from gi_core.errors import UnknownTimeError
from gi_core.light_blend import LightVector
from gi_core.light_track import KEPT_BLENDS, LightTrack
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.live_sector import LiveLight
from gi_core.live_world import LiveWorld, TickPlayers, TickReport
from gi_core.relight_input import relight_input
from gi_core.settings import Settings
from gi_core.user_sky import UserSky
from gi_core.world import Lamp
from server.live_state import Applied, Command, LivePlayer, LiveState, LiveUnavailableError
from server.tick_stats import TickStats
from server.world_clock import WorldClock

log = logging.getLogger("sectorlight.ticker")

# Of a tick's time; then volumes wait for the next. With 0.4 fifty players had three times as many late ticks and up to a sixth more frames,
# with 0.2 half the frames.
FILL_UNTIL = 0.3
# Ticks shorter than this [ms] look so far ahead: half as long as a clock that runs at 1 x keeps one light.
SHORT_TICK_MS, LOOK_AHEAD_TICKS = 1.5, 5

Listener = Callable[[TickReport], None]


@dataclass(frozen=True, eq=False)
class _Coming:
    """A state that is applied as soon as its light has been made.

    track : of that light, None where the present one has it
    keeps_moment : whether its clock then shows what it was asked for, however late: it was set, or stands; else it goes on from the present
    """

    state: LiveState
    done: Future[Applied]
    track: LightTrack | None
    keeps_moment: bool

    def clock_at(self, number: int, present: WorldClock) -> WorldClock:
        """Its clock, should it be applied at a tick in place of the present one."""
        clock = self.state.clock
        if self.track is None:
            return clock
        return replace(clock, start_tick=number) if self.keeps_moment else present.going_on_as(clock, number)


class Ticker:
    """Runs a live world. Commands may come from any thread; ``state`` and ``stats`` may be read by any."""

    def __init__(self, world: LiveWorld, state: LiveState, sky: UserSky | None = None) -> None:
        """``sky`` takes the place of the model's."""
        self.world = world
        self.state = state
        self.stats = TickStats()
        self.tick = -1
        """The last tick that was begun; -1 before the first."""
        self.failure: str | None = None
        """Why the world stands still, should it ever."""
        self.listeners: list[Listener] = []
        self._commands: queue.SimpleQueue[tuple[Command, Future[Applied]]] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._now = time.perf_counter
        self._worker: Executor = ThreadPoolExecutor(1, thread_name_prefix="lighting")
        self._sky = sky
        self._track = self._track_of(state)
        self._coming: _Coming | None = None
        self._lighting: Lighting | None = None
        self._lights: deque[tuple[tuple[object, ...], LiveLight]] = deque(maxlen=KEPT_BLENDS)
        """Those that were made last, of this tick or a later one, each behind what it was made of."""
        self._lit_lamps: tuple[object, ...] = ()
        self._lamps_now: tuple[tuple[Lamp, ...], tuple[Lamp, ...]] = ((), ())
        self._thread = threading.Thread(target=self._run, name="ticker", daemon=True)
        self._running = threading.Event()

    @property
    def rate_hz(self) -> int:
        """Ticks a second."""
        return self.state.clock.ticks_per_second

    @property
    def is_running(self) -> bool:
        """Whether ticks are being made: not before the kernels are warm."""
        return self._running.is_set() and not self._stop.is_set()

    @property
    def is_stopped(self) -> bool:
        """Whether there will be no tick any more."""
        return self._stop.is_set()

    def start(self) -> None:
        """Begin; returns at once."""
        self._thread.start()

    def wait_until_running(self, timeout_s: float) -> bool:
        """Whether the first tick has been made within some seconds."""
        return self._running.wait(timeout_s)

    def stop(self) -> None:
        """Finish the tick that is under way, and end."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._coming is not None:
            self._coming.done.set_exception(self._stopped())
        self._refuse_commands()
        self._worker.shutdown(cancel_futures=True)
        self.world.close()

    def apply(self, command: Command) -> Future[Applied]:
        """Have a command applied before the next tick, or where it asks for light that was not foreseen, the one that has it; none
        overtakes another. The future tells of that tick, or raises what the command raised."""
        done: Future[Applied] = Future()
        self._commands.put((command, done))
        if self._stop.is_set():
            self._refuse_commands()
        return done

    def _run(self) -> None:
        if self._get_ready():
            self._beat()

    def _get_ready(self) -> bool:
        """Whether the world can be run."""
        try:
            started = time.perf_counter()
            self.world.warm_up(self._stop.is_set)
            self._lighting_at(0)
            # What start-up made stays: looking through it for garbage again and again would stop ticks for tens of milliseconds.
            gc.collect()
            gc.freeze()
            log.info("kernels are warm after %.1f s", time.perf_counter() - started)
        except Exception as error:
            self.failure = str(error)
            log.exception("the live world cannot start")
            self._stop.set()
            self._refuse_commands()
            self._running.set()
            return False
        return True

    def _beat(self) -> None:
        """Ticks, until the ticker is stopped."""
        period_s = 1 / self.rate_hz
        start = self._now()
        while not self._stop.is_set():
            due = start + (self.tick + 1) * period_s
            now = self._now()
            if now < due:
                self._stop.wait(due - now)
                now = self._now()
                if self._stop.is_set():
                    break
            number = self.tick + 1
            overdue = int((now - due) / period_s)
            if overdue > 0:
                self.stats.skipped += overdue
                number += overdue
                due += overdue * period_s
            with self.world.undisturbed():
                self._tick(number, due, period_s)
            self._running.set()

    def _tick(self, number: int, due: float, period_s: float) -> None:
        begun = self._now()
        self.tick = number
        try:
            self._apply_commands(number)
            light = self._light_at(number)
            players = players_at(self.state.players, number, self.rate_hz)
            lit = self._now()
            left_ms = FILL_UNTIL * period_s * 1e3 - (lit - begun) * 1e3
            report = self.world.tick(number, players, light, self.state.moving_boxes, left_ms)
            report.ms["light"] = (lit - begun) * 1e3
        except Exception as error:
            # The world goes on: the next tick may do what this one could not.
            self.stats.failed_ticks += 1
            if self.failure != str(error):
                log.exception("tick %d failed", number)
            self.failure = str(error)
            return
        self.failure = None
        self._look_ahead(number + LOOK_AHEAD_TICKS, begun)
        took_ms = (self._now() - begun) * 1e3
        self.stats.add(report, took_ms, max(begun - due, 0.0) * 1e3, period_s * 1e3)
        for listener in tuple(self.listeners):
            listener(report)

    def _apply_commands(self, number: int) -> None:
        while True:
            if self._coming is None:
                self._coming = self._next_command(number)
            coming = self._coming
            if coming is None:
                return
            clock = coming.clock_at(number, self.state.clock)
            if coming.track is not None:
                if not coming.track.is_ready(*shown_by(clock, number)):
                    return
                self._track = coming.track
            self._coming = None
            after = coming.state if clock is coming.state.clock else replace(coming.state, clock=clock)
            self._note_changes(self.state, after)
            self.state = after
            coming.done.set_result(Applied(number, after))

    def _next_command(self, number: int) -> _Coming | None:
        """What the next command that can be carried out makes of the state; None when there is none."""
        for command, done in self._asked():
            before = self.state
            try:
                after = command(before, number)
                moment, rate = shown_by(after.clock, number)
                # A new haze takes as long as ten ticks.
                is_unforeseen = after.clock is not before.clock and not self._track.has(moment, rate)
                is_unforeseen |= after.weather is not before.weather
                keeps_moment = rate == 0 or moment != shown_by(before.clock, number)[0]
            except Exception as error:
                done.set_exception(error)
                continue
            return _Coming(after, done, self._track_of(after) if is_unforeseen else None, keeps_moment)
        return None

    def _asked(self) -> Iterator[tuple[Command, Future[Applied]]]:
        """The commands that are there, in order, each to be answered by whoever takes it."""
        while True:
            try:
                command, done = self._commands.get_nowait()
            except queue.Empty:
                return
            if done.set_running_or_notify_cancel():  # else whoever asked has gone, and a future that was cancelled takes no answer
                yield command, done

    def _track_of(self, state: LiveState) -> LightTrack:
        return LightTrack(self.world.dataset.world.location, self._worker, state.weather.at, self._sky)

    def _note_changes(self, before: LiveState, after: LiveState) -> None:
        if after.lamps is not before.lamps:
            # By identity first: one lamp moves, and thousands do not.
            pairs = [(before.lamps.get(name), after.lamps.get(name)) for name in before.lamps.keys() | after.lamps.keys()]
            moved = [entry.lamp for pair in pairs if pair[0] is not pair[1] and pair[0] != pair[1] for entry in pair if entry is not None]
            self.world.lamps_moved([(np.array(lamp.position), lamp.range_m) for lamp in moved])

    def _lighting_at(self, number: int) -> Lighting:
        clock = self.state.clock
        last = clock.last_tick
        if last is not None and number > last:  # the end of the years that have a sun
            self.state = replace(self.state, clock=clock.with_paused(last, True))
        return self._track.at(*shown_by(self.state.clock, number))

    def _light_at(self, number: int) -> LiveLight:
        try:
            lighting = self._lighting_at(number)
        except UnknownTimeError:
            if self._lighting is None:
                raise
            lighting = self._lighting
        self._lighting = lighting
        state = self.state
        key = (lighting, state.settings, state.lamps)
        for made_of, light in self._lights:
            if all(a is b for a, b in zip(key, made_of, strict=True)):
                return light
        light = self._make_light(lighting, state)
        self._lights.append((key, light))
        return light

    def _look_ahead(self, number: int, begun: float) -> None:
        """Make a later tick's light in one that has been short: where it changes, sectors are relit and volumes filled as well."""
        last = self.state.clock.last_tick
        if (self._now() - begun) * 1e3 < SHORT_TICK_MS and (last is None or number <= last):
            with suppress(Exception):  # the tick that it is for says so, if it still cannot be made
                self._light_at(number)

    def _make_light(self, lighting: Lighting, state: LiveState) -> LiveLight:
        settings = state.settings
        gained = settings.light(lighting)
        world = self.world.dataset.world
        given = relight_input(gained, world.sun_table, world.sky, world.sky_patches)
        # Which lamps are on changes with the minute and with the sun: the same tuples otherwise, which sectors know at a glance.
        key = (state.lamps, lighting.time[:16], bool(lighting.sun.direction[1] > 0), settings.lights_factor)
        if key != self._lit_lamps:
            self._lamps_now = lamps_now(state, lighting, settings, self._lamps_now)
            self._lit_lamps = key
        static, dynamic = self._lamps_now
        standing = state.clock.paused or state.clock.rate == 0
        return LiveLight(gained, given, LightVector.of(given), static, dynamic, settings, standing)

    def _refuse_commands(self) -> None:
        for _, done in self._asked():
            done.set_exception(self._stopped())

    def _stopped(self) -> LiveUnavailableError:
        return LiveUnavailableError(f"the live world has stopped{': ' + self.failure if self.failure else ''}")


def shown_by(clock: WorldClock, number: int) -> tuple[datetime, float]:
    """The moment that a clock shows at a tick, and its rate, 0 where it stands."""
    last = clock.last_tick
    stands = clock.paused or (last is not None and number > last)
    return clock.moment_at(number if last is None else min(number, last)), 0.0 if stands else clock.rate


def lamps_now(
    state: LiveState, lighting: Lighting, settings: Settings, before: tuple[tuple[Lamp, ...], tuple[Lamp, ...]]
) -> tuple[tuple[Lamp, ...], tuple[Lamp, ...]]:
    """Static and dynamic lamps that are on, their gain applied; the very tuples of ``before`` where nothing has changed."""

    def group(dynamic: bool, was: tuple[Lamp, ...]) -> tuple[Lamp, ...]:
        found = settings.brightened(lamps_on((entry.lamp for entry in state.lamps.values() if entry.dynamic is dynamic), lighting))
        return was if found == was else found

    return group(False, before[0]), group(True, before[1])


def players_at(players: Mapping[str, LivePlayer], number: int, rate_hz: int) -> TickPlayers:
    """Where players are at a tick."""
    poses = [entry.walk.at((number - entry.since_tick) / rate_hz) for entry in players.values()]
    return TickPlayers(
        tuple(players),
        np.array([pose.position for pose in poses], np.float64).reshape(-1, 3),
        np.array([pose.velocity for pose in poses], np.float64).reshape(-1, 3),
    )
