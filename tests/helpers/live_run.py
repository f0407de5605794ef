"""Ticks of a live world on the golden dataset, and what to ask about them: for tests of the live world."""

import time
from pathlib import Path

import numpy as np

from gi_core.basis import brightness
from gi_core.constants import VOXEL_INDOORS, VOXEL_OUTDOORS
from gi_core.light_blend import LightVector
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.live_sector import LiveLight
from gi_core.live_volume import PublishedVolume
from gi_core.live_world import LiveWorld, TickPlayers, TickReport
from gi_core.relight_input import relight_input
from gi_core.settings import NEUTRAL, Settings
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.world import Lamp

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
HARMONICS = GOLDEN.parent / "v2_sector2"
STREET = np.array([5.0, 2.0, 30.0])  # its volume reads both sectors
EAST = np.array([1.0, 0.0, 0.0])
LATE_S = 30.0


def light_of(
    world: LiveWorld, lighting: Lighting, lamps: tuple[Lamp, ...] = (), settings: Settings = NEUTRAL, standing: bool = True
) -> LiveLight:
    gained = settings.light(lighting)
    info = world.dataset.world
    given = relight_input(gained, info.sun_table, info.sky, info.sky_patches)
    on = settings.brightened(lamps_on(lamps, lighting))
    return LiveLight(gained, given, LightVector.of(given), on, (), settings, standing)


def at(*places: np.ndarray, velocity=(0.0, 0.0, 0.0)) -> TickPlayers:
    positions = np.array(places, np.float64).reshape(-1, 3)
    return TickPlayers(tuple(f"p{i}" for i in range(len(places))), positions, np.tile(np.array(velocity, np.float64), (len(places), 1)))


def largest_step(before: PublishedVolume, after: PublishedVolume) -> float:
    """By how much a cube's luminance changed on any side, as a share of its brightness, in any voxel of free air that two volumes share;
    the second lies as far along x or further."""
    shift = after.first_voxel - before.first_voxel
    assert shift[0] >= 0
    assert not shift[1:].any()
    count = before.values.shape[3] - int(shift[0])
    free = np.isin(after.mask[:, :, :count], (VOXEL_OUTDOORS, VOXEL_INDOORS))
    return largest_change(before.values[:, :, :, -count:][:, free], after.values[:, :, :, :count][:, free])


def largest_change(before: np.ndarray, after: np.ndarray) -> float:
    """By how much cubes' luminance (6, n, 3) [lx] differs on any side, as a share of the darker cube's brightness."""
    darker = np.minimum(brightness(before, "cube"), brightness(after, "cube"))
    return float((np.abs((after - before) @ LUMINANCE_FROM_RGB).max(axis=0) / darker).max())


def is_exact(world: LiveWorld) -> bool:
    """Whether every resident sector holds a query's bytes."""
    return bool(world._needs.exact[world.streamer.resident_rows()].all())


class Run:
    """Ticks of one world, numbered."""

    def __init__(self, world: LiveWorld) -> None:
        self.world, self.number = world, -1

    def tick(self, players: TickPlayers, light: LiveLight) -> TickReport:
        self.number += 1
        return self.world.tick(self.number, players, light)

    def until(self, players: TickPlayers, light: LiveLight, done, pause_s: float = 0.001) -> int:
        """Ticks until something holds, with a pause after each."""
        before, deadline = self.number, time.monotonic() + LATE_S
        while not done(self.tick(players, light)):
            assert time.monotonic() < deadline, "it never came to hold"
            time.sleep(pause_s)
        return self.number - before

    def settle(self, players: TickPlayers, light: LiveLight) -> np.ndarray:
        """The first player's volume once nothing moves any more."""

        def settled(report: TickReport) -> bool:
            residents = self.world.streamer.residents
            loaded = residents and not self.world.streamer.loading and not report.missing
            return bool(loaded and is_exact(self.world) and not any(s.is_fading for s in residents.values()) and not report.filled)

        self.until(players, light, settled)
        return self.world.volumes.of_player[players.ids[0]].published.values


def sampled(world: LiveWorld, count: int = 2) -> bool:
    """Whether as many sectors are resident, and each has samples that are bound."""
    residents = world.streamer.residents.values()
    return len(residents) == count and all(s.sampled_of and s.resident.sun_sample for s in residents)


def unbound(world: LiveWorld) -> bool:
    """Whether no resident sector has samples that are bound."""
    return all(s.sampled_of is None and s.resident.sun_sample is None for s in world.streamer.residents.values())
