"""Image files: pictures side by side, with captions, and plots."""

import io
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lgrasp.errors import OutputError
from lgrasp.files import write_file
from lgrasp.outputs import check_file

if TYPE_CHECKING:  # slow to import
    from matplotlib.figure import Figure

FORMATS = {".png": "PNG", ".jpg": "JPEG", ".webp": "WEBP", ".gif": "GIF"}
"""Of image files, by suffix."""

_INK = "#3c4650"
_SMALL = 0.75  # least size of captions, of what it is where there is room


def sheet(
    pictures: Sequence[np.ndarray],
    captions: Sequence[str] = (),
    columns: int = 0,
    key: Sequence[tuple[str, str]] = (),
) -> Image.Image:
    """Pictures of one size, shape (h, w, 3), uint8, in rows, each with its caption below.

    Args:
        columns: 0: about as many as rows.
        key: words and what colour stands for them, written in a last line.
    """
    columns = columns or int(np.ceil(np.sqrt(len(pictures))))
    h, w = pictures[0].shape[:2]
    size = max(11, w // 20)
    tall = h + (2 * size if any(captions) else 0)
    wide, high = min(columns, len(pictures)) * w, -(-len(pictures) // columns) * tall
    line = max(11, wide // 56) if key else 0
    out = Image.new("RGB", (wide, high + 2 * line), "#ffffff")
    draw = ImageDraw.Draw(out)
    captions, font = _fitting(captions, size, w - size, draw)
    for i, picture in enumerate(pictures):
        x, y = i % columns * w, i // columns * tall
        out.paste(Image.fromarray(picture), (x, y))
        if i < len(captions):
            draw.text((x + w / 2, y + h + size / 4), captions[i], _INK, font, anchor="ma")
    x, font = line, ImageFont.load_default(line or size)
    for words, colour in key:
        draw.rectangle((x, high + line / 2, x + line, high + 1.5 * line), colour)
        draw.text((x + 1.5 * line, high + line), words, _INK, font, anchor="lm")
        x += int(3 * line + draw.textlength(words, font))
    return out


def _fitting(
    captions: Sequence[str], size: float, width: float, draw: ImageDraw.ImageDraw
) -> tuple[list[str], ImageFont.FreeTypeFont | ImageFont.ImageFont]:
    """Captions as wide as a picture at most, and their font: smaller first, then without their beginning."""
    widest = max((draw.textlength(words, ImageFont.load_default(size)) for words in captions), default=0)
    font, fitting = ImageFont.load_default(size * float(np.clip(width / max(widest, 1), _SMALL, 1))), []
    for words in captions:
        while len(words) > 1 and draw.textlength(words, font) > width:
            words = "…" + words[2:]
        fitting.append(words)
    return fitting, font


def check_image(path: Path, suffixes: Collection[str] = FORMATS.keys()) -> None:
    """Check, before a long job, that an image can be written there.

    Raises:
        OutputError: another suffix, a folder, or a place that cannot be written.
    """
    if path.suffix.lower() not in suffixes or path.is_dir():
        why = "it is a folder; " if path.is_dir() else ""
        raise OutputError(f"picture {path} cannot be written: {why}name a file that ends in {', '.join(suffixes)}")
    check_file(path)


def image_bytes(image: Image.Image, suffix: str = ".png") -> bytes:
    """The contents of an image file."""
    out = io.BytesIO()
    image.save(out, FORMATS[suffix.lower()], optimize=True, quality=90)
    return out.getvalue()


def gif_bytes(images: Sequence[Image.Image], seconds: Sequence[float]) -> bytes:
    """The contents of a GIF that shows images for so long each [s], over and over."""
    out, (first, *others) = io.BytesIO(), images
    first.save(out, "GIF", append_images=others, save_all=True, duration=[1000 * s for s in seconds], loop=0)
    return out.getvalue()


def write_plot(figure: "Figure", path: Path) -> None:
    """Write a figure as a PNG file, without a display.

    Raises:
        OutputError: the file cannot be written.
    """
    data = io.BytesIO()
    figure.savefig(data, format="png")
    write_file(path, data.getvalue())
