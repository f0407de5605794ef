"""From cd/m2 to the bytes of a picture."""

import io

import numpy as np
from PIL import Image

from gi_core.arrays import Float32, UInt8
from gi_core.spectrum import LUMINANCE_FROM_RGB

# Saturation-based ISO speed (ISO 12232): the luminance that EV100 exposes to white is 1.2 x 2^EV100.
WHITE_PER_EV = 1.2
# One stop over the meter: indirect light is looked at in the shade, and the shoulder keeps what the sun hits.
BRIGHTENING = 2.0


# A reflected-light meter reads L = 12.5 / 100 * 2^EV100 (ISO 2720).
METER_PER_EV = 0.125
# Times white: the curve is flat from here on, and its squares would only lose precision.
FLAT_BEYOND = 1e4


def metered(radiance: Float32, ev100: float) -> float:
    """EV100 for a picture (..., 3) [cd m^-2]: the sky's, unless lamps make the picture brighter than the sky would.

    The meter reads the mean lightness, a cube root (CIE 1976): a mean of luminance would follow the few pixels of the lamps themselves,
    a mean of logarithms the black sky above a lit street.
    """
    luminance = np.maximum(radiance @ LUMINANCE_FROM_RGB.astype(np.float32), np.float32(1e-6))
    return max(ev100, 3 * float(np.log2(np.cbrt(luminance).mean(dtype=np.float64))) - float(np.log2(METER_PER_EV)))


def exposed(radiance: Float32, ev100: float) -> Float32:
    """Radiance [cd m^-2] relative to white, one stop brighter than the meter's; as far as FLAT_BEYOND either way."""
    gain = BRIGHTENING / (WHITE_PER_EV * 2.0**ev100)
    most = min(FLAT_BEYOND / gain, float(np.finfo(np.float32).max))  # float32 has no room for all of it under a black sky
    return np.asarray(np.clip(radiance, np.float32(-most), np.float32(most)) * np.float32(gain), np.float32)


def filmic(linear: Float32) -> Float32:
    """0..inf -> 0..1 with a shoulder and a toe: Narkowicz's fit of the ACES curve (2015), per channel."""
    x = np.minimum(np.maximum(linear, 0), FLAT_BEYOND)
    return np.asarray(np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1), np.float32)


def srgb_bytes(linear: Float32) -> UInt8:
    """Linear 0..1 -> sRGB 0..255 (IEC 61966-2-1)."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
    return np.asarray(encoded * 255 + 0.5).astype(np.uint8)


def developed(radiance: Float32, ev100: float) -> UInt8:
    """Radiance (..., 3) [cd m^-2], exposed at ``ev100``, as sRGB 0..255."""
    return srgb_bytes(filmic(exposed(radiance, ev100)))


def png(radiance: Float32, ev100: float) -> bytes:
    """A PNG of radiance (rows, columns, 3) [cd m^-2]; ``ev100`` suits what the sky lights."""
    return png_file(developed(radiance, metered(radiance, ev100)))


def png_file(picture: UInt8) -> bytes:
    """A PNG of sRGB (rows, columns, 3), or of grey (rows, columns)."""
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "PNG", compress_level=6)
    return out.getvalue()
