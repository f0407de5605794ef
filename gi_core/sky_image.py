"""Reading pictures of radiance: OpenEXR (.exr, by the optional package OpenEXR) and Radiance (.hdr), as linear RGB."""

import math
import re
from pathlib import Path

import numpy as np

from gi_core.arrays import Float32
from gi_core.errors import InputError

MOST_PIXELS = 1 << 25  # 8192 x 4096: 400 MB as float32
_LARGEST_BYTES = 1 << 30
_LONGEST_HEADER = 1 << 16
_LONGEST_ECHO = 60
# Radiance's run-length code holds lengths of 8..32767; other widths are stored flat.
_CODED_WIDTHS = range(8, 32768)
_SIZE = re.compile(rb"-Y +(\d{1,7}) +\+X +(\d{1,7})")


def read_image(path: Path | str) -> Float32:
    """(rows, columns, 3) linear RGB of an .exr or .hdr file, top row first, as stored. Raises InputError."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".exr", ".hdr"):
        raise InputError(f"{path.name}: expected a sky as .exr or .hdr, got {suffix or 'no suffix'!r}")
    try:
        size = path.stat().st_size
        if size > _LARGEST_BYTES:
            raise InputError(f"{path.name}: expected a picture of at most {_LARGEST_BYTES} bytes, found {size}")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path.name}: cannot read it: {error.strerror}") from error
    return _read_exr(path, data) if suffix == ".exr" else decode_hdr(data, path.name)


def _read_exr(path: Path, data: bytes) -> Float32:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError(f"{path.name}: .exr needs the package OpenEXR; install sectorlight[sky], or save the sky as .hdr") from error
    # The library prints a warning and goes on where pixels are missing, so what it returns is checked.
    if data[:4] != b"\x76\x2f\x31\x01":
        raise InputError(f"{path.name}: expected an OpenEXR file, found other bytes at its start")
    try:
        low, high = OpenEXR.File(str(path), separate_channels=True, header_only=True).header()["dataWindow"]
        columns, rows = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        _check_size(rows, columns, path.name)
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        found = [channels[name].pixels for name in "RGB"]
    except KeyError as error:
        raise InputError(f"{path.name}: expected channels R, G, B, found no {error}") from error
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(f"{path.name}: damaged OpenEXR file: {str(error).splitlines()[0][:_LONGEST_ECHO]}") from error
    if any(np.shape(channel) != (rows, columns) for channel in found):
        raise InputError(f"{path.name}: expected three channels of {columns} x {rows}, found {[np.shape(c) for c in found]}")
    return np.stack([np.asarray(channel, np.float32) for channel in found], axis=-1)


def decode_hdr(data: bytes, where: str) -> Float32:
    """(rows, columns, 3) of a Radiance picture's bytes; ``where`` names it in errors. Raises InputError.

    Radiance reference manual, "Picture File Format": a text header, a size, then scanlines of shared-exponent RGBE.
    """
    head, blank, rest = data.partition(b"\n\n")
    lines = head.splitlines()
    if not blank or len(head) > _LONGEST_HEADER or not lines or not lines[0].startswith(b"#?"):
        raise InputError(f"{where}: expected a Radiance picture: '#?RADIANCE', variables, an empty line")
    exposure = 1.0
    for line in lines[1:]:
        name, _, value = line.partition(b"=")
        if name == b"FORMAT" and value.strip() != b"32-bit_rle_rgbe":
            raise InputError(f"{where}: FORMAT: expected 32-bit_rle_rgbe, found {_shown(value)}")
        if name == b"EXPOSURE":
            exposure *= _exposure(value, where)
    size, newline, pixels = rest.partition(b"\n")
    match = _SIZE.fullmatch(size.strip()) if newline else None
    if match is None:
        raise InputError(f"{where}: expected a size '-Y rows +X columns', found {_shown(size)}")
    rows, columns = int(match[1]), int(match[2])
    _check_size(rows, columns, where)
    coded = columns in _CODED_WIDTHS and pixels[:2] == b"\x02\x02"
    rgbe = _decode_runs(pixels, rows, columns, where) if coded else _flat(pixels, rows, columns, where)
    # Radiance takes the middle of each step; an exponent of 0 is black.
    scale = np.where(rgbe[..., 3] > 0, np.ldexp(np.float32(1), rgbe[..., 3].astype(np.int32) - 136), np.float32(0))
    with np.errstate(over="ignore"):  # an absurd exposure makes infinities, which the sky refuses
        return np.asarray((rgbe[..., :3] + np.float32(0.5)) * (scale / np.float32(exposure))[..., None], np.float32)


Rgbe = np.ndarray[tuple[int, ...], np.dtype[np.uint8]]


def _exposure(value: bytes, where: str) -> float:
    try:
        exposure = float(value)
    except ValueError:
        exposure = math.nan
    if not 1e-30 < exposure < 1e30:
        raise InputError(f"{where}: EXPOSURE: expected a number above 0, found {_shown(value)}")
    return exposure


def _flat(pixels: bytes, rows: int, columns: int, where: str) -> Rgbe:
    if len(pixels) != 4 * rows * columns:
        raise InputError(f"{where}: expected {4 * rows * columns} bytes of {columns} x {rows} flat pixels, found {len(pixels)}")
    return np.frombuffer(pixels, np.uint8).reshape(rows, columns, 4)


def _decode_runs(pixels: bytes, rows: int, columns: int, where: str) -> Rgbe:
    """(rows, columns, 4): each scanline holds its four components one after the other, in runs (> 128) and literals."""
    out = np.zeros((rows, 4, columns), np.uint8)
    start = bytes((2, 2, columns >> 8, columns & 255))
    at = 0
    for row in range(rows):
        if pixels[at : at + 4] != start:
            raise InputError(
                f"{where}: scanline {row}: expected a run-length code for {columns} columns, found {_shown(pixels[at : at + 4])}"
            )
        at += 4
        for component in range(4):
            line, done = out[row, component], 0
            while done < columns:
                count = pixels[at] if at < len(pixels) else 0
                run = count > 128
                count -= 128 * run
                values = pixels[at + 1 : at + 2] if run else pixels[at + 1 : at + 1 + count]
                if not 0 < count <= columns - done or len(values) != (1 if run else count):
                    raise InputError(f"{where}: scanline {row}: cut off or damaged at byte {at} of its pixels")
                line[done : done + count] = values[0] if run else np.frombuffer(values, np.uint8)
                done += count
                at += 1 + len(values)
    return out.transpose(0, 2, 1)


def _check_size(rows: int, columns: int, where: str) -> None:
    if not (rows >= 2 and columns == 2 * rows and rows * columns <= MOST_PIXELS):
        raise InputError(
            f"{where}: expected a whole sky, equirectangular: twice as wide as high, at most {MOST_PIXELS} pixels; found {columns} x {rows}"
        )


def _shown(value: bytes) -> str:
    return ascii(value[:_LONGEST_ECHO].decode("latin-1"))
