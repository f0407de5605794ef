"""A few wavelengths that stand for daylight, and what they look like: sunlight, the atmosphere's substances, the eye.

The air's colours come from how strongly they depend on wavelength, which three channels follow badly (at sunset by tens of per cent).
Everything here is a vector over ``WAVELENGTH_NM``; ``RGB_FROM_SPECTRUM`` takes the transmitted or scattered share of each wavelength
of sunlight to linear sRGB. Between nodes that share is taken as linear, while the eye and the sun are integrated nanometre by
nanometre.
"""

import numpy as np

from gi_core.arrays import Float64

WAVELENGTH_NM = np.array([400.0, 440.0, 480.0, 520.0, 560.0, 600.0, 640.0, 680.0])

# Illuminance of the sun above the air at 1 au. Darula, Kittler and Gueymard, "Reference luminous solar constant", 2005.
SOLAR_ILLUMINANCE_LX = 133.3e3
SOLAR_TEMPERATURE_K = 5900.0  # correlated colour temperature of sunlight above the air

LUMINANCE_FROM_RGB = np.array([0.2126, 0.7152, 0.0722])

# IEC 61966-2-1: linear sRGB from XYZ.
_RGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])

# Ozone's Chappuis band at WAVELENGTH_NM [cm^-1 at standard conditions]. Leckner 1978.
_OZONE_ABSORPTION = np.array([0.0, 0.002, 0.014, 0.048, 0.103, 0.125, 0.079, 0.036])
_OZONE_COLUMN_CM = 0.34  # 340 Dobson units, the mean of 35 to 60 degrees; WMO Scientific Assessment of Ozone Depletion


def _lobe(wavelength: Float64, centre: float, narrow: float, wide: float) -> Float64:
    spread = np.where(wavelength < centre, narrow, wide)
    return np.asarray(np.exp(-0.5 * ((wavelength - centre) * spread) ** 2), np.float64)


def colour_matching(wavelength: Float64) -> Float64:
    """CIE 1931 x, y, z for wavelengths (n,) [nm] -> (n, 3). Wyman, Sloan and Shirley, JCGT 2 (2), 2013."""
    x = _lobe(wavelength, 442.0, 0.0624, 0.0374) * 0.362 + _lobe(wavelength, 599.8, 0.0264, 0.0323) * 1.056
    x -= _lobe(wavelength, 501.1, 0.0490, 0.0382) * 0.065
    y = _lobe(wavelength, 568.8, 0.0213, 0.0247) * 0.821 + _lobe(wavelength, 530.9, 0.0613, 0.0322) * 0.286
    z = _lobe(wavelength, 437.0, 0.0845, 0.0278) * 1.217 + _lobe(wavelength, 459.0, 0.0385, 0.0725) * 0.681
    return np.stack([x, y, z], axis=-1)


def _rgb_from_spectrum() -> Float64:
    fine = np.arange(380.0, 781.0)
    planck = fine**-5 / np.expm1(1.438777e7 / (fine * SOLAR_TEMPERATURE_K))
    xyz = colour_matching(fine) * planck[:, None]
    xyz *= SOLAR_ILLUMINANCE_LX / xyz[:, 1].sum()
    # Hat functions of the nodes; beyond the outermost nodes, their values.
    hats = np.stack([np.interp(fine, WAVELENGTH_NM, node) for node in np.eye(len(WAVELENGTH_NM))])
    return np.asarray(_RGB_FROM_XYZ @ (hats @ xyz).T, np.float64)


# (3, 8) [lx per channel]: times all ones it is the sun above the air, at 1 au.
RGB_FROM_SPECTRUM = _rgb_from_spectrum()


def rgb_of_black_body(kelvin: float) -> Float64:
    """Linear sRGB (3,) of luminance 1 of a black body; negative where a channel cannot show it (below about 1900 K)."""
    fine = np.arange(380.0, 781.0)
    planck = fine**-5 / np.expm1(1.438777e7 / (fine * kelvin))
    xyz = (colour_matching(fine) * planck[:, None]).sum(axis=0)
    return np.asarray(_RGB_FROM_XYZ @ (xyz / xyz[1]), np.float64)


def rayleigh_depth() -> Float64:
    """(8,) vertical optical depth of clean air above the sea. Hansen and Travis 1974, eq. 2.30."""
    micron = WAVELENGTH_NM / 1000
    return np.asarray(0.008569 * micron**-4 * (1 + 0.0113 * micron**-2 + 0.00013 * micron**-4), np.float64)


def aerosol_depth(depth_at_550: float) -> Float64:
    """(8,) vertical optical depth of aerosol, by Angstrom's law with his mean exponent 1.3."""
    return np.asarray(depth_at_550 * (WAVELENGTH_NM / 550) ** -1.3, np.float64)


def ozone_depth() -> Float64:
    """(8,) vertical optical depth of ozone."""
    return _OZONE_ABSORPTION * _OZONE_COLUMN_CM
