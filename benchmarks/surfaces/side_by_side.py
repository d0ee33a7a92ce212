"""Draw parts of held-out views side by side: ``side_by_side FOLDER OUT.jpg PART …``.

FOLDER has the pictures by ``mesh_views``. A PART is ``title=VIEW:left,top,width,height`` in pixels of the view; it
becomes a row: the photo, the splat, and the mesh with textures and with colours of its vertices.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

COLUMNS = {"photo": "photo", "splat": "splat", "textured": "mesh, photos on it", "vertices": "mesh, vertex colours"}
WIDTH, GAP, HEAD = 300, 6, 24  # pixels: width of a part, space around it, height of a title
PART = re.compile(r"(?P<title>[^=]+)=(?P<view>[^:]+):(?P<box>\d+,\d+,\d+,\d+)")
TEXT, PAPER = (20, 20, 20), (255, 255, 255)


def parse_part(text: str) -> tuple[str, str, tuple[int, int, int, int]]:
    """Return title, view and box (left, top, width, height) of a part.

    Raises:
        ValueError: if it has another form.
    """
    found = PART.fullmatch(text)
    if found is None:
        raise ValueError(f"{text} is not title=VIEW:left,top,width,height")
    left, top, width, height = (int(each) for each in found["box"].split(","))
    return found["title"], found["view"], (left, top, width, height)


def draw(folder: Path, parts: Sequence[str]) -> UInt8[np.ndarray, "h w 3"]:
    """Draw parts, a row for each."""
    rows = []
    for title, view, (left, top, width, height) in map(parse_part, parts):
        tall = round(WIDTH * height / width)
        row = Image.new("RGB", ((WIDTH + GAP) * len(COLUMNS), tall + HEAD + GAP), PAPER)
        pen = ImageDraw.Draw(row)
        for number, (kind, what) in enumerate(COLUMNS.items()):
            picture = Image.open(folder / f"{view}.{kind}.png").convert("RGB")
            part = picture.crop((left, top, left + width, top + height))
            at = number * (WIDTH + GAP)
            row.paste(part.resize((WIDTH, tall), Image.Resampling.LANCZOS), (at, HEAD))
            pen.text((at + 2, 4), f"{title}: {what}", TEXT, ImageFont.load_default(14))
        rows.append(np.asarray(row))
    return np.concatenate(rows)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("folder", type=Path)
    options.add_argument("out", type=Path)
    options.add_argument("parts", nargs="+")
    arguments = options.parse_args()
    Image.fromarray(draw(arguments.folder, arguments.parts)).save(arguments.out, quality=88)


if __name__ == "__main__":
    main()
