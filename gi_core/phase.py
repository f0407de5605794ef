"""Phase functions: how much of what is scattered goes into each direction, by the cosine of the turn [sr^-1]; each integrates to 1."""

import numpy as np

from gi_core.arrays import Float64

# Forwards: continental average, Hess et al. 1998 (OPAC).
AEROSOL_ASYMMETRY = 0.7


def air_phase(cosine: Float64) -> Float64:
    """Rayleigh's, without the depolarisation of 3 %."""
    return np.asarray(3 / (16 * np.pi) * (1 + cosine * cosine), np.float64)


def aerosol_phase(cosine: Float64) -> Float64:
    """Henyey's and Greenstein's."""
    g = AEROSOL_ASYMMETRY
    return np.asarray((1 - g * g) / (4 * np.pi) / (1 + g * g - 2 * g * cosine) ** 1.5, np.float64)
