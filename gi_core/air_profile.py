"""How much air, ozone and aerosol there is at each height: the shapes of the air that ``air`` sums along light's way.

Densities are relative to the whole vertical column from the sea, so that each integrates to 1 over height [km^-1].
"""

from functools import cache

import numpy as np

from gi_core.arrays import Float64

TOP_KM = 100.0
# The haze near the ground; Hillaire 2020, section 4.
HAZE_HEIGHT_KM = 1.2

# U.S. Standard Atmosphere: height [km], air [10^18 cm^-3], ozone [ppmv]. Anderson et al., "AFGL Atmospheric Constituent Profiles", 1986
# (AFGL-TR-86-0110), table 1f. An exponential of 8 km has twice the air at 40 km, which is where light comes from in twilight.
_STANDARD = np.array([
    (0, 25.48, 0.0266), (1, 23.13, 0.0293), (2, 20.94, 0.0324), (3, 18.91, 0.0332), (4, 17.04, 0.0339), (5, 15.32, 0.0377),
    (6, 13.73, 0.0411), (7, 12.28, 0.0501), (8, 10.94, 0.0597), (9, 9.719, 0.0917), (10, 8.602, 0.131), (11, 7.589, 0.215),
    (12, 6.489, 0.310), (13, 5.546, 0.385), (14, 4.739, 0.503), (15, 4.050, 0.651), (16, 3.462, 0.870), (17, 2.960, 1.19),
    (18, 2.530, 1.59), (19, 2.163, 2.03), (20, 1.849, 2.58), (21, 1.575, 3.03), (22, 1.342, 3.65), (23, 1.144, 4.17),
    (24, 0.9765, 4.63), (25, 0.8337, 5.12), (27.5, 0.5640, 5.80), (30, 0.3830, 6.55), (32.5, 0.2524, 7.37), (35, 0.1761, 7.84),
    (37.5, 0.1238, 7.80), (40, 0.08310, 7.30), (42.5, 0.05803, 6.20), (45, 0.04090, 5.25), (47.5, 0.02920, 4.10), (50, 0.02136, 3.10),
    (55, 0.01181, 1.80), (60, 6.426e-3, 1.10), (65, 3.386e-3, 0.70), (70, 1.723e-3, 0.30), (75, 8.347e-4, 0.25), (80, 3.832e-4, 0.30),
    (85, 1.711e-4, 0.50), (90, 7.136e-5, 0.70), (95, 2.924e-5, 0.70), (100, 1.189e-5, 0.40),
])  # fmt: skip

_STEP_KM = 0.1  # of the tables that are looked up: straight lines between 1001 heights


@cache
def _tables() -> tuple[Float64, Float64]:
    """Heights (n,) and densities (3, n)."""
    height = np.linspace(0, TOP_KM, round(TOP_KM / _STEP_KM) + 1)
    air = np.exp(np.interp(height, _STANDARD[:, 0], np.log(_STANDARD[:, 1])))
    ozone = air * np.interp(height, _STANDARD[:, 0], _STANDARD[:, 2])
    rows = np.stack([air, np.exp(-height / HAZE_HEIGHT_KM), ozone])
    whole = ((rows[:, 1:] + rows[:, :-1]) / 2 * _STEP_KM).sum(axis=1)
    return height, rows / whole[:, None]


def densities(height_km: Float64) -> Float64:
    """(..., 3): air, haze and ozone at a height."""
    height, rows = _tables()
    return np.stack([np.interp(height_km, height, row) for row in rows], axis=-1)
