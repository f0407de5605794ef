"""The live world of a server: started by the first request that needs it, or at once when players are given; stopped with the server.

A server that only answers queries has no live world: no thread, no memory, no kernels beyond the queries'.
"""

import logging
import threading
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gi_core.dataset import Dataset
from gi_core.epw_weather import EpwWeather
from gi_core.errors import InputError
from gi_core.grid import SectorIndex
from gi_core.live_world import DEFAULT_BUDGET_BYTES, LiveWorld
from gi_core.user_sky import UserSky
from server.kept_edits import KeptEdits, load_kept
from server.live_state import LivePlayer, LiveState, LiveUnavailableError, NotKeptError, Part, Residency, authored_lamps
from server.live_weather import fixed_weather, weather_from_json
from server.players import Player, read_players
from server.settings_json import changed_settings
from server.street_lattice import StreetLattice
from server.ticker import Ticker
from server.world_clock import DEFAULT_TICKS_PER_SECOND, changed_clock, starting_clock

log = logging.getLogger("sectorlight.live")

START_TIME = "12:00"
START_WEATHER = "clear"


@dataclass(frozen=True)
class LiveOptions:
    """What an operator decides about the live world.

    ticks_per_second : of real time; start_time, start_weather : as queries take them
    budget_bytes : of resident sectors, on the device and in this process; places : sectors relit in a tick
    players_file : who walks from the start; state_file : where edits that ask to be kept are kept; epw_file : a measured year's weather
    sky : in place of the model's
    """

    device: str | None = None
    ticks_per_second: int = DEFAULT_TICKS_PER_SECOND
    start_time: str = START_TIME
    start_weather: str = START_WEATHER
    budget_bytes: int = DEFAULT_BUDGET_BYTES
    places: int = 2
    players_file: Path | None = None
    state_file: Path | None = None
    epw_file: Path | None = None
    sky: UserSky | None = None


class Live:
    """Holds the ticker. Safe to use from several threads."""

    def __init__(self, dataset: Dataset, options: LiveOptions) -> None:
        """Reads what the options name, so that a mistake is known at start-up. Raises InputError."""
        self.dataset = dataset
        self.options = options
        self.lattice = StreetLattice(dataset)
        self.measured = None if options.epw_file is None else EpwWeather(options.epw_file)
        self.kept = KeptEdits(options.state_file)
        self._state = self._starting_state()
        self._ticker: Ticker | None = None
        self._walkers: Executor | None = None
        self._lock = threading.Lock()
        self._closed = False

    @property
    def is_started(self) -> bool:
        """Whether there is a live world."""
        return self._ticker is not None

    @property
    def started_ticker(self) -> Ticker | None:
        """The ticker, if there is one; starts none."""
        return self._ticker

    def residency(self) -> dict[SectorIndex, Residency]:
        """Of sectors that the live world holds or failed to load; none where there is no live world."""
        if self._ticker is None:
            return {}
        world = self._ticker.world
        read = set(list(world.volumes.looked_at))  # copied whole, while ticks go on
        found: dict[SectorIndex, Residency] = dict.fromkeys(list(world.streamer.failures), "failed")
        return found | {index: "read by a player" if index in read else "resident" for index in list(world.streamer.residents)}

    @property
    def ticker(self) -> Ticker:
        """The running ticker; starts it. Raises LiveUnavailableError once the server stops, or when it could not start."""
        with self._lock:
            if self._closed:
                raise LiveUnavailableError("the server is stopping")
            if self._ticker is None:
                options = self.options
                world = LiveWorld(self.dataset, options.device, budget_bytes=options.budget_bytes, places=options.places)
                self._walkers = world.background_thread("walker")
                self._ticker = Ticker(world, self._state, options.sky)
                self._ticker.start()
            return self._ticker

    @property
    def walkers(self) -> Executor:
        """Plans walks, which takes up to a second of reading and computing: one at a time, giving way to ticks. Starts the live world."""
        self.ticker  # noqa: B018
        assert self._walkers is not None
        return self._walkers

    def start_if_needed(self) -> None:
        """Start at once when somebody walks from the start."""
        if self._state.players:
            self.ticker  # noqa: B018

    def keep(self) -> None:
        """Write down what is to be kept, as it is now. Not for the event loop. Raises NotKeptError."""
        ticker = self.ticker
        try:
            self.kept.save(lambda: ticker.state)
        except OSError as error:
            raise NotKeptError(f"the change has taken effect, but could not be kept: {error.strerror or error}") from error

    def walking(self, player: Player, since_tick: int, kept: bool) -> LivePlayer:
        """A player on its walk. Reads sectors for a walk along streets: not for the event loop. Raises InputError."""
        return LivePlayer(player, player.walk(self.dataset, self.lattice), since_tick, kept)

    def close(self) -> None:
        """Finish the tick that is under way and stop."""
        with self._lock:
            self._closed = True
            ticker = self._ticker
        if ticker is not None:
            ticker.stop()
        if self._walkers is not None:
            self._walkers.shutdown(cancel_futures=True)

    def _starting_state(self) -> LiveState:
        options, world = self.options, self.dataset.world
        state = LiveState(
            clock=starting_clock(world.location, options.start_time, options.ticks_per_second),
            weather=fixed_weather(options.start_weather),
            lamps=authored_lamps(world.lamps),
        )
        players = [] if options.players_file is None else list(read_players(options.players_file, self.lattice.eye_height))
        kept = load_kept(options.state_file, self.lattice.eye_height)
        lamps = {**state.lamps, **{lamp.id: lamp for lamp in kept.lamps}}
        walking = {player.id: self.walking(player, 0, False) for player in players}
        walking |= {player.id: self.walking(player, 0, True) for player in kept.players}
        boxes = {box.id: box for box in kept.boxes}
        state = self._with_parts(state, kept.parts)
        return replace(state, lamps=MappingProxyType(lamps), boxes=MappingProxyType(boxes), players=MappingProxyType(walking))

    def _with_parts(self, state: LiveState, parts: Mapping[Part, dict[str, Any]]) -> LiveState:
        """Clock, weather and settings as the state file has them. Raises InputError."""
        location = self.dataset.world.location
        try:
            if "clock" in parts:
                state = replace(state, clock=changed_clock(state.clock, 0, parts["clock"], location))
            if "weather" in parts:
                state = replace(state, weather=weather_from_json(parts["weather"], location, self.measured)[0])
            if "settings" in parts:
                state = replace(state, settings=changed_settings(state.settings, parts["settings"]))
        except InputError as error:
            raise InputError(f"{self.options.state_file}: {error}") from error
        return replace(state, kept=frozenset(parts))
