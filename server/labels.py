"""Text on pictures."""

from collections.abc import Mapping

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gi_core.arrays import UInt8

LABEL_PIXELS = 15
LABEL_GRAY, PAPER_GRAY = 225, 20
MARGIN = 4
# On a smaller picture a key would hide what it explains.
MIN_KEY_WIDTH = 320


def labelled(picture: UInt8, text: str) -> UInt8:
    """A picture (rows, columns, 3) above a line of text."""
    rows, columns = picture.shape[:2]
    image = Image.new("RGB", (columns, rows + LABEL_PIXELS), (PAPER_GRAY,) * 3)
    image.paste(Image.fromarray(picture), (0, 0))
    ImageDraw.Draw(image).text((4, rows + 1), text, fill=(LABEL_GRAY,) * 3, font=ImageFont.load_default())
    return np.asarray(image)


def with_key(picture: UInt8, colours: Mapping[str, tuple[int, int, int]]) -> UInt8:
    """A picture (rows, columns, 3) with a line in its lower left corner that names colours; as it is where that has no room."""
    rows, columns = picture.shape[:2]
    if columns < MIN_KEY_WIDTH or rows < 4 * LABEL_PIXELS:
        return picture
    image = Image.fromarray(picture)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default()
    patch, top, x = LABEL_PIXELS - 2 * MARGIN, rows - LABEL_PIXELS, 0
    for word, colour in colours.items():
        width = patch + 3 * MARGIN + int(draw.textlength(word, font=font))
        draw.rectangle((x, top, x + width - 1, rows - 1), fill=(PAPER_GRAY,) * 3)
        draw.rectangle((x + MARGIN, top + MARGIN, x + MARGIN + patch - 1, top + MARGIN + patch - 1), fill=colour)
        draw.text((x + patch + 2 * MARGIN, top + 1), word, fill=(LABEL_GRAY,) * 3, font=font)
        x += width
    return np.asarray(image)
