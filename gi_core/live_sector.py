"""A resident sector of the live world: its light, which goes on from tick to tick, and what of it is shown."""

import math
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyopencl as cl

from gi_core.arrays import Float32, Float64
from gi_core.background import give_way
from gi_core.basis import basis_of_size, brightness, from_axes
from gi_core.device import Device
from gi_core.light_blend import LightVector
from gi_core.light_geometry import SharedGeometry, UnreadGeometryError
from gi_core.light_surfels import SurfelLights
from gi_core.lighting import Lighting
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import ResidentSector
from gi_core.sector import Sector
from gi_core.settings import Settings
from gi_core.shadow_map import ShadowMap, SunSamples
from gi_core.shadow_plan import FRESH_DEGREES, ShadowPlan, is_near
from gi_core.sky_patches import face_exitance
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.tick_plan import SETTLED_CHANGE
from gi_core.world import Lamp

# After a change this large, as a share, a relight makes several passes where somebody looks, so that bounces follow at once.
BURST_CHANGE = 0.05
BURST_PASSES = 3
# Before a sector is resident: passes at a stretch, and how often at most. After eight, bounces are within half a percent of the end, for a
# quarter of the loader's time. Where others wait for it it is once: later bounces come while the sector fades in.
AHEAD_PASSES, AHEAD_TIMES, HURRIED_TIMES = 2, 4, 1
# A second at 30 Hz, so that nothing pops when a sector arrives late, or when its sun's visibility has another source: in half of that, a
# voxel that ends ten times as bright moves by a third in its first ticks.
FADE_TICKS = 30
# The most that a probe's light from any side moves by in a tick of a fade, as a share of its brightness, where FADE_TICKS are not more
# than enough: a small change is over sooner, and volumes that read it need not be filled for the rest.
FADE_STEP = 0.05
# A probe this much darker than the mean counts as this bright: nobody sees what doubles there.
_FADE_FLOOR_OF_MEAN = 0.01
# What is shown of a sector lags behind its light by less than this share of its brightest probe: volumes need not be filled anew for what
# nobody would see, which a slow sun moves in a second or more.
UNSHOWN_CHANGE = 2e-4
# A sun this far from where it stood has jumped, and all light with it: what follows it follows at once.
SUN_JUMPED_DEGREES = 2 * FRESH_DEGREES


@dataclass(frozen=True, eq=False)
class LiveLight:
    """One tick's light as sectors take it.

    lighting : the tick's snapshot, the settings' gains on it applied; given : the same as relighting takes it
    vector : of ``given``
    static_lamps, dynamic_lamps : those that are on, the settings' gain applied
    standing : nothing of it is going to change by itself
    """

    lighting: Lighting
    given: RelightInput
    vector: LightVector
    static_lamps: tuple[Lamp, ...]
    dynamic_lamps: tuple[Lamp, ...]
    settings: Settings
    standing: bool

    @property
    def sun_is_up(self) -> bool:
        """Whether the first of the lights is the sun."""
        return bool((self.lighting.sun.irradiance > 0).any())

    @cached_property
    def to_sun(self) -> Float64:
        """(3,) float64, unit: towards the first of the lights."""
        return np.asarray(self.given.lights["direction"][0, :3], np.float64)

    @cached_property
    def distant(self) -> Float32:
        """(6, 3) float32 [lx]: what a distant probe's sky factors multiply."""
        return face_exitance(self.lighting)


class LiveSector:
    """One sector that is lit tick by tick. Made by a loader's thread, then the ticker's alone."""

    def __init__(self, device: Device, sector: Sector, sky_patches: int, shared: SharedGeometry) -> None:
        """``shared`` : what lamps' shadows are traced through."""
        self.resident = ResidentSector(device, sector, sky_patches)
        self.resident.prepare()
        self.resident.release_host_arrays()
        self.lamps = SurfelLights(device, sector, shared.geometry)
        self.samples: SunSamples | None = None
        self.sampled_of: ShadowPlan | None = None
        """The plan of the shadow map that its samples are from; None before any."""
        self.has_other_source = False
        """Whether the next relight finds the sun's visibility from another source than the last did."""
        self._has_other_samples = False
        """Whether it finds other samples than the last did, as it does where the source is another. Even of nearly the same sun they may
        differ much from those before: more of a tower's surfels lie on one map than on another."""
        self.lit_ahead: LiveLight | None = None
        """What ``light_ahead`` lit it by, and how far its light moved in the end."""
        self.moved_ahead = 0.0
        self.shown_at = -1
        """The last tick in which what is shown of it changed."""
        self._device = device
        self._shared = shared
        self._reading: Future[None] | None = None
        """Of triangles that its lamps need, until they have been traced through."""
        self._low, self._high = _bounds(sector)
        self._unshown = 0.0
        """How far its light has moved, at most, since something of it was shown, as a share of its brightest probe."""
        self._faded = 0
        self._blended_faded = 0
        """``_faded`` when what is shown was last blended."""
        self._starts_fade = False
        """Whether the relight under way makes what it fades to, from what ``_cubes`` are or what it fades to already."""
        self._cubes: Float32 = np.zeros((sector.probe_count, sector.basis_size, 3), np.float32)
        self.host_nbytes = self.resident.host_nbytes + self._cubes.nbytes
        """Bytes in the host's memory."""
        self._shown: cl.Buffer | None = None
        self._first: cl.Buffer | None = None
        self._room: cl.Buffer | None = None
        self._blended_at = -1
        self._converted: cl.Buffer | None = None
        """What is shown, in the basis that is served, and the ``shown_at`` that it is of."""
        self._converted_at = -1
        self._lamps_late = False

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return self.resident.nbytes + self.lamps.nbytes + self._shown_nbytes + (self.samples.nbytes if self.samples else 0)

    @property
    def _shown_nbytes(self) -> int:
        return sum(int(buffer.size) for buffer in (self._shown, self._first, self._room) if buffer is not None)

    def budget_bytes(self, lamps: bool) -> int:
        """What the budget counts: bytes on the device and in the host's memory, and room for all that light may yet ask for, so that what
        was counted stays true from sunrise to sunset; of ``lamps`` only where there are any."""
        sector = self.resident.sector
        samples = 0 if self.samples else SunSamples.nbytes_of(sector.surfel_count)
        # Fading and gains: two copies of the probes, and their rooms.
        shown = (2 * 16 * sector.basis_size + 2) * sector.probe_count - self._shown_nbytes
        room = self.resident.unused_nbytes(lamps) + samples + max(shown, 0) + (self.lamps.unused_nbytes if lamps else 0)
        return self.nbytes + self.host_nbytes + room

    @property
    def is_fading(self) -> bool:
        """Whether it is still blended with what was shown before."""
        return self._faded < FADE_TICKS

    def make_room_for_samples(self) -> None:
        """What ``sample_sun`` would make at its first call, should another thread have the time."""
        if self.samples is None:
            self.samples = SunSamples(self._device, self.resident)

    def sample_sun(self, shadow_map: ShadowMap) -> None:
        """Take samples of a shadow map that was just drawn; they light the sector at its next relight."""
        self.make_room_for_samples()
        assert self.samples is not None
        shadow_map.sample(self.samples)
        self.has_other_source |= self.sampled_of is None
        self._has_other_samples = True
        self.sampled_of = shadow_map.plan

    def drop_sun_samples(self) -> None:
        """Back to the bake's visibility, with no room for samples: the sun has set."""
        if self.samples is not None:
            self.samples = self.sampled_of = None
            self.resident.set_sun_sample(None)

    def set_lamps(self, light: LiveLight, wait: bool) -> bool:
        """Have the next relight read these lamps; whether it will: without ``wait``, not while another thread traces shadows, nor before
        one has read the triangles that cast them."""
        if self.lamps.given == (light.static_lamps, light.dynamic_lamps):
            return True
        if not wait and self._reading is not None and not self._reading.done():
            return False
        if not self._shared.tracing.acquire(blocking=wait):
            return False
        before = self.lamps.buffer
        try:
            # What was read and given up again, for want of room, is read here: it would be given up for ever.
            may_read = wait or self._reading is not None
            self.lamps.set_static(light.static_lamps, may_read)
            self.lamps.set_dynamic(light.dynamic_lamps, may_read)
            self._reading = None
        except UnreadGeometryError as error:
            self._reading = self._shared.read_soon(error.sectors)
            return False
        finally:
            # The geometry on the device is shared with threads that have another queue.
            self._device.queue.finish()
            self._shared.tracing.release()
            if before is not None or self.lamps.buffer is not None:
                self.resident.set_lamps(self.lamps.buffer)
        return True

    def reaches(self, position: Float64, range_m: float) -> bool:
        """Whether a lamp at a world position (3,) [m] may light one of its surfels."""
        local = position - self.resident.sector.index.origin
        beyond = local - np.clip(local, self._low, self._high)
        return bool(beyond @ beyond < range_m * range_m)

    def light(self, light: LiveLight, is_read: bool) -> None:
        """Have the relight that follows read the lamps of this light, if they can be had at once. ``measure`` must follow it. ``is_read``:
        by a published volume."""
        self._lamps_late = not self.set_lamps(light, wait=False)
        self._take_samples(light, is_read)

    def light_ahead(self, relighter: Relighter, light: LiveLight, times: int) -> None:
        """From darkness until it has settled or nearly so, so many ``times`` AHEAD_PASSES at most, in a loader's thread, before it is
        anybody's."""
        self.set_lamps(light, wait=True)
        for _ in range(times):
            give_way()
            relighter.relight([self.resident], light.given, AHEAD_PASSES)
            self.moved_ahead = self.measure(self.resident.read_cubes())
            if self.moved_ahead <= SETTLED_CHANGE:
                break
        self.lit_ahead = light

    def measure(self, after: Float32) -> float:
        """Take note of the cubes (P, B, 3) [lx] that a relight gave: how far it moved the probes' light, as a share of the brightest."""
        peak = float(after.max(initial=0.0))
        moved = float(np.abs(after - self._cubes).max(initial=0.0))
        self._take_cubes(after)
        share = moved / peak if peak > 0 else float(moved > 0)
        self._unshown += share
        return 1.0 if self._lamps_late else share

    def settle(self, relighter: Relighter, light: LiveLight, is_read: bool) -> bool:
        """Converge from darkness, as a query does: what is held then depends on the light alone, and on nothing that was before.

        False, and nothing done, while another thread traces the shadows of lamps that this needs.
        """
        if not self.set_lamps(light, wait=False):
            return False
        self._take_samples(light, is_read)
        self._take_cubes(relighter.converge(self.resident, light.given).cubes)
        return True

    def advance(self, tick: int, must_show: bool, is_read: bool) -> float | None:
        """Whether what is shown changes at a tick, and how far as a share of its brightest probe: because its light has moved far enough,
        or wholly (1.0), because it is final or gains are others (``must_show``) or because it fades. None where it does not.

        A sector fades where something else was shown before: while no published volume reads it (``is_read``), it changes unseen.
        """
        if self.is_fading:
            if is_read:
                self._faded += 1
            else:
                self._faded, self._shown = FADE_TICKS, None
            must_show = True
        moved = 1.0 if must_show else self._unshown
        if moved < UNSHOWN_CHANGE:
            return None
        self.shown_at, self._unshown = tick, 0.0
        return moved

    def shown(self, settings: Settings, placeholder: Callable[[], Float32], basis: str) -> cl.Buffer:
        """The light to show, on the device, in a basis: the sector's own under the artists' gains, or while it fades a blend with what
        was shown before: ``placeholder`` (6, 3) [lx], a cube, where that was not of the sector. As it is in the tick ``shown_at``."""
        if basis == basis_of_size(self.resident.sector.basis_size):
            return self._own_shown(settings, placeholder)
        if self._converted is None or self._converted_at != self.shown_at:
            self._converted, self._converted_at = self.resident.converted(basis, self._own_shown(settings, placeholder)), self.shown_at
        return self._converted

    def _own_shown(self, settings: Settings, placeholder: Callable[[], Float32]) -> cl.Buffer:
        if not self.is_fading and settings.bounce_factor == 1.0 and not settings.has_ambient:
            self._shown = self._first = self._room = None
            return self.resident.cubes
        if self._shown is None:
            self._shown = self._device.allocate(self.resident.cubes.size)
            self._blended_at = -1
            if self.is_fading:
                self._blended_faded = 0
                self._write_shown(placeholder())
        if self._blended_at != self.shown_at:
            self._blend(self._shown, settings)
            self._blended_at, self._blended_faded = self.shown_at, self._faded
        return self._shown

    def _blend(self, shown: cl.Buffer, settings: Settings) -> None:
        device, resident = self._device, self.resident
        sector = resident.sector
        rows = sector.probe_count * sector.basis_size
        self._room = self._room or device.upload(sector.probe_room)
        gains = settings.bounce_factor != 1.0
        ambient = np.zeros((2, sector.basis_size, 4), np.float32)
        basis = basis_of_size(sector.basis_size)
        ambient[:, :, :3] = settings.ambient(basis)
        share = (self._faded - self._blended_faded) / (FADE_TICKS - self._blended_faded) if self.is_fading else 1.0
        arguments: list[object] = [np.uint32(rows), resident.cubes]
        if gains:
            self._first = self._first or device.allocate(16 * rows)
            resident.enqueue_first_bounce(self._first)
            arguments += [self._first, np.float32(settings.bounce_factor)]
        kernel = device.shared_kernel("show_probes", CUBE_ROWS=sector.basis_size, HAS_BOUNCE_FACTOR=int(gains))
        if rows:
            kernel.launch_1d(rows, *arguments, self._room, device.upload(ambient), np.float32(share), shown)

    def _write_shown(self, placeholder: Float32) -> None:
        """Show a cube (6, 3) [lx] at every probe."""
        sector = self.resident.sector
        row = np.pad(from_axes(basis_of_size(sector.basis_size)) @ placeholder.astype(np.float32), ((0, 0), (0, 1)))
        if sector.probe_count:
            cl.enqueue_copy(self._device.queue, self._shown, np.tile(row.astype(np.float32), (sector.probe_count, 1)))

    def _take_samples(self, light: LiveLight, is_read: bool) -> None:
        """Before a relight: forget samples that are too old for it, and where it finds others, have what is shown go over from what it
        was, if it is read."""
        self._expire_samples(light)
        if not self._has_other_samples:
            return
        self.has_other_source = self._has_other_samples = False
        if not is_read or (self._shown is None and self.is_fading):
            return  # nobody sees it change, or nothing of it was shown
        if self._shown is None:
            self._shown = self._device.allocate(self.resident.cubes.size)
            cl.enqueue_copy(self._device.queue, self._shown, self.resident.cubes)
        self._starts_fade = True

    def _take_cubes(self, after: Float32) -> None:
        """What a relight gave (P, B, 3) [lx]. A fade that it starts takes as long as its size asks for, and what is left of one before."""
        if self._starts_fade:
            self._starts_fade = False
            left = FADE_TICKS - self._faded + fade_ticks(self._cubes, after)
            self._faded = self._blended_faded = max(FADE_TICKS - left, 0)
        self._cubes = after

    def _expire_samples(self, light: LiveLight) -> None:
        """Forget samples of maps for a sun too far from where it stands; back to the bake's visibility when none is left."""
        samples, of = self.samples, self.sampled_of
        if samples is None or of is None:
            return
        if not light.sun_is_up:  # the first of the lights is the moon, which samples know nothing of
            self.drop_sun_samples()
        elif samples.forget_old(light.to_sun):
            if samples.are_there:
                self.resident.set_sun_sample(samples.sun_sample)
                self._has_other_samples = True
            else:
                self.sampled_of = None
                self.resident.set_sun_sample(None)
                self.has_other_source = self._has_other_samples = is_near(of.to_sun, light.to_sun, SUN_JUMPED_DEGREES)


def fade_ticks(before: Float32, after: Float32) -> int:
    """In how many ticks, of FADE_TICKS at most, probes (P, B, 3) [lx] go over from one light to another by FADE_STEP or less in each."""
    basis = basis_of_size(before.shape[1])
    old, new = (brightness(cubes.swapaxes(0, 1), basis) for cubes in (before, after))
    if not new.any():
        return FADE_TICKS
    darker = np.maximum(np.minimum(old, new), _FADE_FLOOR_OF_MEAN * new.mean())
    moved = np.abs((after - before) @ LUMINANCE_FROM_RGB.astype(np.float32)).max(axis=1)
    return min(max(math.ceil(float((moved / darker).max()) / FADE_STEP), 1), FADE_TICKS)


def _bounds(sector: Sector) -> tuple[Float64, Float64]:
    """The corners (3,) [m] of the box of a sector's surfels, sector-local; without any, of an empty one at its origin."""
    position = sector.surfel_position if sector.surfel_count else np.zeros((1, 3))
    # Axis by axis: over rows of three NumPy takes thirty times as long, 2 ms.
    axes = np.ascontiguousarray(position.T)
    return axes.min(axis=1).astype(np.float64), axes.max(axis=1).astype(np.float64)
