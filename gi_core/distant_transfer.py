"""Distant texels in any light: what sky patches, suns and the city's own lamps send to each of them, over all bounces.

Transport is linear in light, so all texels of a world are a few products with what the bake found once (MATH.md, "The distant texture").
"""

from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Float16, Float32, Int64
from gi_core.lighting import Lighting
from gi_core.lights import schedule_is_on
from gi_core.relight_input import RelightInput

# Bare, and under all the snow that can lie.
COVERS = 2
# Near the horizon a sun's light on level ground changes manyfold from one sun of the table to the next, as the sine of its height does;
# on what is upright it hardly changes. So each is kept by itself.
LEVEL, UPRIGHT = 0, 1
SUN_PARTS = 2


@dataclass(frozen=True, eq=False)
class DistantTransfer:
    """What light sends to n texels: irradiance of the six faces. T sky patches, D suns of the dataset's table, G schedules.

    sky : (2, T, n, 6, 3) float16, per exitance of each patch; bare, and under snow
    sun : (2, D, 2, n, 6, 3) float16, per irradiance of what faces the sun; LEVEL also per sine of the sun's height
    glow : (2, G, n, 6, 3) float32 [lx], of lamps that keep a schedule; of surfaces that shine by themselves always
    schedules : (G,) what ``Lamp.schedule`` may be
    """

    sky: Float16
    sun: Float16
    glow: Float32
    schedules: tuple[str, ...]

    @property
    def texels(self) -> int:
        return int(self.sky.shape[2])

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
        return np.maximum(np.asarray(found, np.float32), 0)

    def _covered(self, cover: int, given: RelightInput, on: list[bool], texels: Int64 | slice) -> Float32:
        glow = self.glow[cover][on][:, texels]
        sources, strengths = [glow, self.sky[cover][:, texels]], [np.ones((len(glow), 3), np.float32), given.patch_exitance]
        for light in given.lights:
            suns = self.sun[cover][light["plane"]][:, :, texels]
            on_plane = light["plane_weight"][:, None] * light["irradiance"][:3]
            sources.append(suns.reshape(-1, *suns.shape[2:]))
            strengths.append(np.stack([on_plane * light["direction"][1], on_plane], axis=1).reshape(-1, 3))
        found = np.einsum("snfc,sc->nfc", np.concatenate(sources).astype(np.float32), np.concatenate(strengths).astype(np.float32))
        return np.asarray(found, np.float32)
