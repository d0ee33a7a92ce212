"""The small input on which two states of the code are compared: a little of everything that stages handle."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

from PIL import Image

# An orbit of a house, and some nadir photos: more photos than are matched with each one, so that the choice of pairs
# matters.
NUMBERS = (*range(1, 17), 20, 24, 28, 32, 36, 40)
OTHER_CAMERA = (13, 14, 15, 16, 20, 24)  # marked as from an unknown camera, so that cameras are distinguished
MODEL, OTHER_MODEL = b"M3E\0", b"M3X\0"  # in EXIF
ZOOMED = (24, 36, 40)  # marked with a focal length 3 % longer, a different zoom setting
FOCAL, LONGER_FOCAL = struct.pack(">II", 1229, 100), struct.pack(">II", 1266, 100)  # millimetres, in EXIF
MASKED = 5
CONTROL = "gcp_list.txt"

# Small but complete: the whole takes some ten seconds on one core.
CONFIG = """
[features]
extractor = "opencv-sift"
max_image_size = 600
max_features = 1500

[matches]
neighbours = 5

[undistort]
max_megapixels = 0.03

[train]
iterations = 60

[flythrough]
seconds = 0.4

[depths]
max_megapixels = 0.01

[dsm]
cell_m = 0.3

[ortho]
gsd_m = 0.3
"""


def write_capture(demo: Path, folder: Path) -> Path:
    """Copy photos of the demo capture with their control points, a mask and a second camera.

    Args:
        demo: The demo capture.
        folder: Output folder.

    Returns:
        The folder of the photos.
    """
    photos = folder / "photos"
    photos.mkdir(parents=True)
    for number in NUMBERS:
        name = f"DJI_{number:04d}.JPG"
        content = (demo / "photos" / name).read_bytes()
        for said, instead, numbers in ((MODEL, OTHER_MODEL, OTHER_CAMERA), (FOCAL, LONGER_FOCAL, ZOOMED)):
            assert said in content, name
            content = content.replace(said, instead) if number in numbers else content
        (photos / name).write_bytes(content)
    with Image.open(photos / f"DJI_{MASKED:04d}.JPG") as photo:
        mask = Image.new("L", photo.size, 255)
        mask.paste(0, (0, 0, photo.width // 4, photo.height // 4))
    (photos / "masks").mkdir()
    mask.save(photos / "masks" / f"DJI_{MASKED:04d}.png")
    shutil.copy(demo / CONTROL, folder)
    return photos
