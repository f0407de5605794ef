"""Commands between ticks: in order, whole or not at all, and nobody else's are lost with one that fails or is given up."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from datetime import datetime, timedelta
from types import MappingProxyType, SimpleNamespace

import pytest

from gi_core.errors import InputError
from gi_core.light_track import LightTrack
from gi_core.lighting import Lighting
from gi_core.shadow_plan import MovingBox
from gi_core.world import Lamp, Location
from server.live_state import (
    MAX_BOXES,
    Applied,
    LiveBox,
    LiveLamp,
    LiveState,
    LiveUnavailableError,
    NoSuchThingError,
    TakenIdError,
    authored_lamps,
)
from server.live_weather import fixed_weather
from server.ticker import Ticker, shown_by
from server.world_clock import changed_clock, starting_clock


class World:
    """Stands in for a live world: notes where lamps were said to have changed."""

    def __init__(self) -> None:
        self.dataset = SimpleNamespace(world=SimpleNamespace(location=Location()))
        self.touched: list[list[tuple[float, ...]]] = []

    def lamps_moved(self, touched: list[tuple[object, float]]) -> None:
        self.touched.append([tuple(position.tolist()) for position, _ in touched])

    def close(self) -> None:
        pass


def lamp(name: str, x: float = 0.0) -> LiveLamp:
    return LiveLamp(name, Lamp(name, "point", (x, 0.0, 0.0), 100.0))


@pytest.fixture
def ticker() -> Ticker:
    lamps = {f"lamp{n}": lamp(f"lamp{n}", float(n)) for n in range(100)}
    state = LiveState(starting_clock(Location(), "12:00"), fixed_weather("clear"), lamps=MappingProxyType(lamps))
    return Ticker(World(), state)


def jumping(by: int) -> Callable[[LiveState, int], LiveState]:
    return lambda state, tick: replace(state, jumps=state.jumps * 10 + by)


def test_commands_apply_in_order_and_name_their_tick(ticker: Ticker) -> None:
    done = [ticker.apply(jumping(n)) for n in (1, 2, 3)]
    ticker._apply_commands(7)
    assert ticker.state.jumps == 123
    assert [future.result(0).tick for future in done] == [7, 7, 7]


def test_one_that_fails_changes_nothing_and_stops_no_other(ticker: Ticker) -> None:
    before = ticker.state
    missing = ticker.apply(lambda state, _: state.without_lamp("none"))
    after = ticker.apply(jumping(1))
    ticker._apply_commands(0)
    with pytest.raises(NoSuchThingError):
        missing.result(0)
    assert after.result(0).tick == 0
    assert ticker.state.lamps is before.lamps


def test_one_that_was_given_up_is_left_out(ticker: Ticker) -> None:
    """A request that is cancelled takes its future with it; the tick must not fail for that."""
    given_up, after = ticker.apply(jumping(1)), ticker.apply(jumping(2))
    assert given_up.cancel()
    ticker._apply_commands(0)
    assert ticker.state.jumps == 2
    assert after.result(0).tick == 0


def test_a_ticker_that_stops_refuses_what_is_left(ticker: Ticker) -> None:
    waiting, given_up = ticker.apply(jumping(1)), ticker.apply(jumping(1))
    given_up.cancel()
    ticker.stop()
    late = ticker.apply(jumping(1))
    for future in (waiting, late):
        with pytest.raises(LiveUnavailableError):
            future.result(0)


def test_another_weather_waits_for_its_light_and_none_overtakes_it(ticker: Ticker, monkeypatch: pytest.MonkeyPatch) -> None:
    """A new haze takes as long as ten ticks to make: those ticks go on in the old one."""
    ticker._lighting_at(0)
    may_be_made = threading.Event()
    made = LightTrack._lighting

    def slow(track: LightTrack, moment: datetime, keep: bool = True) -> Lighting:
        assert may_be_made.wait(10)
        return made(track, moment, keep)

    monkeypatch.setattr(LightTrack, "_lighting", slow)
    rain = fixed_weather("rain")
    weather = ticker.apply(lambda state, _: state.with_weather(rain, is_jump=True))
    after = ticker.apply(jumping(1))
    for number in (1, 2):
        ticker._apply_commands(number)
        assert ticker._lighting_at(number).weather == "clear"
        assert not weather.done()
        assert not after.done()
        assert ticker.state.weather is not rain
    may_be_made.set()
    number = ticks_until(ticker, weather, 3)
    assert weather.result(0).tick == after.result(0).tick == number
    assert weather.result(0).state.weather is rain
    assert ticker.state.jumps == 11
    assert ticker._track.is_ready(*shown_by(ticker.state.clock, number))
    assert ticker._lighting_at(number).weather == "rain"


def test_a_clock_that_is_set_shows_that_time_when_its_light_is_there(ticker: Ticker) -> None:
    def noon(state: LiveState, tick: int) -> LiveState:
        return state.with_clock(changed_clock(state.clock, tick, {"time": "13:00", "rate": 60}, Location()), is_jump=True)

    done = ticker.apply(noon)
    number = ticks_until(ticker, done, 5)
    applied = done.result(0)
    assert number > 5, "its light cannot have been there"
    assert applied.tick == number
    assert applied.state.clock.moment_at(number).strftime("%H:%M:%S.%f") == "13:00:00.000000"
    assert applied.state.clock.moment_at(number + 30).strftime("%H:%M:%S") == "13:01:00"


def test_a_clock_that_runs_faster_waits_for_its_light_and_goes_on_from_the_present(ticker: Ticker) -> None:
    """Snapshots of a faster clock are farther apart, and none is there yet. What the clock showed meanwhile, it showed at the old rate."""
    ticker._lighting_at(0)
    done = ticker.apply(lambda state, tick: state.with_clock(state.clock.with_rate(tick, 3600), is_jump=False))
    number = ticks_until(ticker, done, 30)
    assert number > 30, "its light cannot have been there"
    clock = done.result(0).state.clock
    noon = starting_clock(Location(), "12:00")
    assert clock.moment_at(number) == noon.moment_at(number)
    assert clock.moment_at(number + 30) - clock.moment_at(number) == timedelta(hours=1)
    assert ticker._track.has(*shown_by(clock, number)), "no tick waits"


def test_a_clock_that_stops_shows_the_moment_it_was_stopped_at(ticker: Ticker) -> None:
    ticker._lighting_at(0)
    done = ticker.apply(lambda state, tick: state.with_clock(state.clock.with_paused(tick, True), is_jump=False))
    number = ticks_until(ticker, done, 30)
    assert number > 30
    assert {done.result(0).state.clock.moment_at(n) for n in (number, number + 99)} == {starting_clock(Location(), "12:00").moment_at(30)}
    ticker._lighting_at(number)
    goes_on = ticker.apply(lambda state, tick: state.with_clock(state.clock.with_paused(tick, False), is_jump=False))
    number = ticks_until(ticker, goes_on, number + 1)
    assert goes_on.result(0).state.clock.moment_at(number) == starting_clock(Location(), "12:00").moment_at(30)
    assert ticker._track.has(*shown_by(ticker.state.clock, number)), "no tick waits"


def test_a_clock_whose_light_is_there_runs_as_it_is_told_in_the_same_tick(ticker: Ticker) -> None:
    """Up to 40 x a clock's snapshots are equally far apart."""
    ticker._lighting_at(0)
    done = ticker.apply(lambda state, tick: state.with_clock(state.clock.with_rate(tick, 20), is_jump=False))
    ticker._apply_commands(1)
    assert done.result(0).tick == 1


def test_a_ticker_that_stops_refuses_what_waits_for_light(ticker: Ticker) -> None:
    waiting = ticker.apply(lambda state, _: state.with_weather(fixed_weather("rain"), is_jump=True))
    ticker._apply_commands(0)
    ticker.stop()
    with pytest.raises(LiveUnavailableError):
        waiting.result(0)


def ticks_until(ticker: Ticker, done: Future[Applied], first: int) -> int:
    """The number of the tick, from ``first`` on, that carries a command out."""
    for number in range(first, first + 1000):
        ticker._apply_commands(number)
        if done.done():
            return number
        time.sleep(0.01)
    raise AssertionError("none did")


def test_only_lamps_that_changed_are_said_to_have(ticker: Ticker) -> None:
    world = ticker.world
    assert isinstance(world, World)
    ticker.apply(lambda state, _: state.with_lamp(lamp("lamp3", 50.0), new=False))
    ticker._apply_commands(0)
    ticker.apply(lambda state, _: state.with_lamp(lamp("lamp3", 50.0), new=False))  # as it is already
    ticker._apply_commands(1)
    ticker.apply(lambda state, _: state.with_lamp(lamp("new", 60.0), new=True))
    ticker._apply_commands(2)
    ticker.apply(lambda state, _: state.without_lamp("new"))
    ticker._apply_commands(3)
    assert world.touched == [[(3.0, 0.0, 0.0), (50.0, 0.0, 0.0)], [], [(60.0, 0.0, 0.0)], [(60.0, 0.0, 0.0)]]


def test_authored_lamps_have_distinct_ids_that_fit_into_paths() -> None:
    names = ["block 0,0 street lamp 1", "block 0,0 street lamp 1", "", "lamp-1", "???", "a" * 100, "a" * 99]
    found = authored_lamps(tuple(Lamp(name, "point", (float(n), 0.0, 0.0), 1.0) for n, name in enumerate(names)))
    assert len(found) == len(names)
    assert next(iter(found)) == "block-0-0-street-lamp-1"
    assert all(len(name) <= 64 and name.replace("-", "").replace("_", "").isalnum() for name in found)
    assert all(name == entry.id for name, entry in found.items())


def test_a_lamp_that_is_there_is_no_new_one(ticker: Ticker) -> None:
    with pytest.raises(InputError, match="PATCH"):
        ticker.state.with_lamp(lamp("lamp1"), new=True)


def test_there_are_no_more_boxes_than_a_tick_can_draw(ticker: Ticker) -> None:
    state = ticker.state
    for number in range(MAX_BOXES):
        state = state.with_box(LiveBox(f"box{number}", MovingBox((number, 0.0, 0.0), (1.0, 1.0, 1.0))), new=True)
    with pytest.raises(InputError, match=f"at most {MAX_BOXES}"):
        state.with_box(LiveBox("another", MovingBox((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))), new=True)
    moved = state.with_box(LiveBox("box7", MovingBox((0.0, 5.0, 0.0), (1.0, 1.0, 1.0))), new=False)
    assert [box.position for box in moved.moving_boxes[6:9]] == [(6, 0, 0), (0, 5, 0), (8, 0, 0)]
    assert moved.moving_boxes is moved.moving_boxes
    with pytest.raises(TakenIdError):
        moved.without_box("box0").with_box(LiveBox("box7", moved.box("box7").box), new=True)
