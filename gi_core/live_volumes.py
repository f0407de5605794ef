"""All players' volumes: which have to be filled, in which order, and which sectors somebody looks at.

Found by what has changed, not by looking at everybody: a player who moved to other voxels, a sector whose light was changed, and the
players whose volumes read it. A thousand players who stand in settled light cost nothing.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Float32, Float64
from gi_core.constants import SECTOR_SIZE_M
from gi_core.device import Device
from gi_core.fill_plan import fill_order
from gi_core.grid import SectorIndex, volume_first_voxel
from gi_core.live_sector import LiveSector
from gi_core.live_volume import LiveVolume, ShownCubes, volume_arrays

# Ticks that relight and fill volumes are the longest. So those that relight leave volumes in which light has moved by less than this share
# since they were filled, a third of the finest step that an 8-bit sRGB picture shows, and those whose players have just moved on to other
# voxels, for so many ticks.
SEEN_CHANGE = 0.003
MOST_PUT_OFF_TICKS = 3
# A new player's first volume is held back until all of its sectors are there, but not for longer than two seconds at 30 Hz.
HELD_TICKS = 60


@dataclass(slots=True)
class _Behind:
    """A volume that has to be filled: since which tick, how far from its player the nearest change is [m], and how far light has moved at
    most, as a share of the brightest."""

    since: int
    away_m: float
    moved: float = 0.0


class LiveVolumes:
    """The ticker's alone. ``residents`` is the streamer's, as it stands."""

    def __init__(self, device: Device, known: frozenset[SectorIndex], residents: Mapping[SectorIndex, LiveSector], basis: str) -> None:
        """``known`` : sectors of the world; ``basis`` : of all volumes."""
        self.of_player: dict[str, LiveVolume] = {}
        self.looked_at: Counter[SectorIndex] = Counter()
        """How many published volumes read each sector, there or not."""
        self._device, self._known, self._residents, self._basis = device, known, residents, basis
        self._arrays = volume_arrays(basis)
        self._firsts: dict[str, bytes] = {}
        self._readers: dict[SectorIndex, set[str]] = {}
        self._behind: dict[str, _Behind] = {}
        self._places: dict[str, list[float]] = {}
        """Where players stood at the last ``follow``, x and z [m]."""

    @property
    def missing(self) -> tuple[SectorIndex, ...]:
        """Sectors that published volumes read and that are not there."""
        return tuple(index for index in self.looked_at if index not in self._residents)

    @property
    def are_behind(self) -> bool:
        """Whether any has to be filled."""
        return bool(self._behind)

    def follow(self, tick: int, ids: Sequence[str], positions: Float64) -> None:
        """Have volumes stand where players are: ``ids`` (p) at positions (p, 3) [m]. Those who moved to other voxels have to be filled."""
        for gone in self.of_player.keys() - set(ids):
            self._unread(gone, self.of_player.pop(gone))
            self._behind.pop(gone, None)
            del self._firsts[gone]
        firsts = volume_first_voxel(positions)
        for row, name in enumerate(ids):
            place = firsts[row].tobytes()
            if self._firsts.get(name) != place:
                volume = self.of_player.get(name)
                if volume is None:
                    volume = self.of_player[name] = LiveVolume(self._device, self._basis, self._arrays)
                self._unread(name, volume)
                volume.move(firsts[row], self._known)
                self._firsts[name] = place
                for index in volume.touched:
                    self._readers.setdefault(index, set()).add(name)
                if volume.published is not None:
                    self.looked_at.update(volume.touched)
                self._fall_behind(name, tick, 0.0)
        self._places = dict(zip(ids, positions[:, [0, 2]].tolist(), strict=True))

    def note(self, tick: int, changed: Mapping[SectorIndex, float]) -> None:
        """Sectors show something else from this tick on, by a share of their brightest probe: who reads them has to be filled."""
        for index, moved in changed.items():
            for name in self._readers.get(index, ()):
                self._fall_behind(name, tick, _away_m(index, *self._places[name])).moved += moved

    def fill(
        self, tick: int, is_busy: bool, is_over: Callable[[], bool], shown: ShownCubes, placeholder: Callable[[SectorIndex], Float32]
    ) -> tuple[tuple[str, ...], int]:
        """Fill and publish volumes in the order of ``fill_plan``, at least one, until the time for it ``is_over``. While the device
        fills one, the one before is published. A tick that ``is_busy`` leaves those that nobody would miss.

        -> whose, and how many wait for another tick
        """
        waiting = [name for name in sorted(self._behind) if not self._is_held(name, tick)]
        ready = [name for name in waiting if not (is_busy and self._is_put_off(name, tick))]
        behind = [self._behind[name] for name in ready]
        order = fill_order(tick, np.array([b.since for b in behind], np.int64), np.array([b.away_m for b in behind], np.float64))
        filled: list[str] = []

        def publish(name: str) -> None:
            volume = self.of_player[name]
            if volume.published is None:
                self.looked_at.update(volume.touched)
            volume.publish(tick, placeholder)
            del self._behind[name]
            filled.append(name)

        under_way: str | None = None
        for row in order.tolist():
            if under_way is not None and is_over():
                break
            name = ready[row]
            self.of_player[name].enqueue(self._residents, shown)
            if under_way is not None:
                publish(under_way)
            under_way = name
        if under_way is not None:
            publish(under_way)
        return tuple(filled), len(waiting) - len(filled)

    def _fall_behind(self, name: str, tick: int, away_m: float) -> _Behind:
        behind = self._behind.setdefault(name, _Behind(tick, away_m))
        behind.away_m = min(behind.away_m, away_m)
        return behind

    def _is_put_off(self, name: str, tick: int) -> bool:
        """Whether a volume can wait for a tick with less to do."""
        behind, is_new = self._behind[name], self.of_player[name].published is None
        return not is_new and behind.moved < SEEN_CHANGE and tick < behind.since + MOST_PUT_OFF_TICKS

    def _unread(self, name: str, volume: LiveVolume) -> None:
        """A player's volume no longer reads what it read."""
        for index in volume.touched:
            self._readers[index].discard(name)
        if volume.published is not None:
            for index in volume.touched:
                self.looked_at[index] -= 1
                if not self.looked_at[index]:
                    del self.looked_at[index]

    def _is_held(self, name: str, tick: int) -> bool:
        """Whether a new player's first volume waits for sectors that are on their way."""
        volume = self.of_player[name]
        if volume.published is not None or tick >= self._behind[name].since + HELD_TICKS:
            return False
        return not all(index in self._residents for index in volume.touched)


def _away_m(index: SectorIndex, x: float, z: float) -> float:
    """From (x, z) [m], world frame, to the nearest point of a sector; 0 in it."""
    low_x, low_z = index.x * SECTOR_SIZE_M, index.z * SECTOR_SIZE_M
    return math.hypot(max(low_x - x, 0.0, x - low_x - SECTOR_SIZE_M), max(low_z - z, 0.0, z - low_z - SECTOR_SIZE_M))
