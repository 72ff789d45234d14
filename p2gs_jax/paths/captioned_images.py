"""Images in rows, each under a line of text, with captions below parts of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float32
from PIL import Image, ImageDraw, ImageFont

from p2gs_jax.formats.png import to_uint8

BACKGROUND, INK, FAINT = (255, 255, 255), (30, 30, 30), (120, 120, 120)
# Sizes as parts of the width, and the smallest font that is still read, pixels.
FONT, SMALLEST_FONT = 1 / 60, 11


@dataclass(frozen=True)
class CaptionedImage:
    """An image with its title.

    Attributes:
        title: above it.
        image: display values.
        captions: (text, first column, end column), written below those columns with a tick at
            each inner edge, and shortened where it is wider than they are.
    """

    title: str
    image: Float32[np.ndarray, "h w 3"]
    captions: Sequence[tuple[str, int, int]] = ()


def _font(width: int) -> ImageFont.FreeTypeFont:
    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(path, max(SMALLEST_FONT, round(FONT * width)))


def _line(width: int) -> int:
    return round(1.7 * _font(width).size)


def _shortened(text: str, width: int, font: ImageFont.FreeTypeFont) -> str:
    """Return the text, or as much of its beginning as fits before an ellipsis."""
    if font.getlength(text) <= width:
        return text
    fits = (n for n in range(len(text) - 1, 0, -1) if font.getlength(f"{text[:n]}…") <= width)
    return next((f"{text[:n]}…" for n in fits), "")


def stacked_size(width: int, heights: Sequence[int], captions: int) -> tuple[int, int]:
    """Return (width, height) of `stacked` for rows of these heights, some of them with captions."""
    return width, sum(heights) + (len(heights) + captions) * _line(width)


def stacked(rows: Sequence[CaptionedImage]) -> Float32[np.ndarray, "h w 3"]:
    """Return images of one width below each other, as display values."""
    width = rows[0].image.shape[1]
    captions = sum(bool(row.captions) for row in rows)
    size = stacked_size(width, [row.image.shape[0] for row in rows], captions)
    font, line = _font(width), _line(width)
    sheet = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    top = 0
    for row in rows:
        draw.text((2, top + line / 2), row.title, INK, font, anchor="lm")
        codes = to_uint8(row.image)
        sheet.paste(Image.fromarray(codes), (0, top + line))
        top += line + codes.shape[0]
        for text, start, end in row.captions:
            if end < width:
                draw.line([(end, top), (end, top + line / 2)], INK, max(1, line // 16))
            place = ((start + end) / 2, top + line / 2)
            draw.text(place, _shortened(text, end - start, font), FAINT, font, anchor="mm")
        top += line if row.captions else 0
    return np.asarray(sheet, np.float32) / 255
