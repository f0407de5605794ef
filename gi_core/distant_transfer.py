"""Distant texels in any light: what sky patches, suns and the city's own lamps send to each of them, over all bounces.

Transport is linear in light, so all texels of a world are a few products with what the bake found once (MATH.md, "The distant texture").
"""

from dataclasses import dataclass

import numpy as np

from gi_core.arrays import AnyArray, Float16, Float32, Int64
from gi_core.lighting import Lighting
from gi_core.lights import schedule_is_on
from gi_core.relight_input import RelightInput

# Bare, and under all the snow that can lie.
COVERS = 2
# Near the horizon a sun's light on level ground changes manyfold from one sun of the table to the next, as the sine of its height does;
# on what is upright it hardly changes. So each is kept by itself.
LEVEL, UPRIGHT = 0, 1
SUN_PARTS = 2
CHANNELS = 3


@dataclass(frozen=True, eq=False)
class DistantTransfer:
    """What light sends to n texels: irradiance of each channel of the six faces. T sky patches, D suns of the dataset's table, G schedules.

    sky : (2, T, 3, n, 6) float32 of float16's precision, per exitance of each patch; bare, and under snow
    sun : (2, D, 2, 3, n, 6) float16, per irradiance of what faces the sun; LEVEL also per sine of the sun's height
    glow : (2, G, 3, n, 6) float32 [lx], of lamps that keep a schedule; of surfaces that shine by themselves always
    schedules : (G,) what ``Lamp.schedule`` may be
    """

    sky: Float32
    sun: Float16
    glow: Float32
    schedules: tuple[str, ...]

    @property
    def texels(self) -> int:
        return int(self.sky.shape[3])

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return self.sky.nbytes + self.sun.nbytes + self.glow.nbytes

    def light(self, given: RelightInput, lighting: Lighting, texels: Int64 | slice = slice(None)) -> Float32:
        """(n, 6, 3) float32 [lx]: the texels, or some of them, in a light. As in probes, direct light of sun, moon and lamps is left out.

        given : ``lighting`` as relighting takes it; of the latter only what schedules ask for is read
        """
        on = [schedule_is_on(schedule, lighting) for schedule in self.schedules]
        snow = min(max(given.snow, 0.0), 1.0)
        # Snow blends albedos; here it blends the light that they send, without the bounces between half white surfaces: 2 % too bright.
        covers = [(cover, np.float32(share)) for cover, share in enumerate((1 - snow, snow)) if share > 0]
        found = sum(share * self._covered(cover, given, on, texels) for cover, share in covers)
        # Harmonics may say less than nothing of a dark face.
        return np.ascontiguousarray(np.moveaxis(np.maximum(found, 0), 0, -1), np.float32)

    def _covered(self, cover: int, given: RelightInput, on: list[bool], texels: Int64 | slice) -> Float32:
        """(3, n, 6)"""
        found = _weighed(self.sky[cover][:, :, texels], given.patch_exitance) + self.glow[cover][on][:, :, texels].sum(axis=0)
        for light in given.lights:
            suns = self.sun[cover][light["plane"]][:, :, :, texels]
            on_plane = light["plane_weight"][:, None] * light["irradiance"][:3]
            strength = np.stack([on_plane * light["direction"][1], on_plane], axis=1)
            found += _weighed(suns.reshape(-1, *suns.shape[2:]).astype(np.float32), strength.reshape(-1, CHANNELS))
        return found


def _weighed(sources: Float32, strength: AnyArray) -> Float32:
    """(3, n, 6): the sum over sources (k, 3, n, 6), each channel times its strength (k, 3)."""
    # No matrix product of a library's: on a busy machine its threads wait for each other longer than one takes for all.
    return np.asarray(np.einsum("kcnf,kc->cnf", sources, strength.astype(np.float32)))
