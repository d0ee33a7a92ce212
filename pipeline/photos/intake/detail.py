"""Measure a photo's sharpness and brightness, fast and at places that other photos also show.

How much fine detail a photo has depends on its subject: a lawn has more than a wall, whatever the focus. So detail is
measured in small patches, in four directions (motion blur removes it in one), as the energy of the finest scales over
that of coarser ones in the same patch. Patches of other photos at the same place show what is normal there.
"""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from PIL import Image

from splatpipe.pipeline.photos.files.photo_list import read_checked
from splatpipe.pipeline.photos.files.picture_file import LARGE_PIXELS, open_picture, strips_of, turn_to_decode
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.intake.convert import read_8bit

MIN_SIDE_PX = 2000  # a JPEG is decoded at the smallest of 1/2, 1/4 and 1/8 that still has as many
PATCH = 32  # pixels: the coarse band includes its three longest waves
DIRECTIONS = 4  # sectors of wave directions, 45° each
COARSE, FINE = (0.05, 0.14), (0.2, 0.42)  # cycles per pixel; JPEG keeps little beyond
QUIET = 0.35  # grey levels: standard deviation of rounding and of JPEG's own noise, in a band
WHITE, BLACK = 250, 5  # grey levels: no detail is left at or above the first, and at or below the second
PATCH_LEVEL_PX = 9  # side of the square whose mean is a place's brightness
DARKEST = 1.0 / 4096.0  # linear; below it, the ratio of two levels is meaningless
SIGNATURE = 48  # side of the thumbnail by which a re-saved photo is recognized


@dataclass(frozen=True)
class Brightness:
    """Overall brightness of a photo.

    Attributes:
        mean_level: Mean grey level, 0 to 255.
        white: Share of pixels without detail in the highlights.
        black: Share of pixels without detail in the shadows.
    """

    mean_level: float
    white: float
    black: float


def read_grey(photo: CheckedPhoto) -> UInt8[np.ndarray, "h w"]:
    """Read a photo's grey levels in the stored grid, at full size or, for a large one, at 1/2, 1/4 or 1/8 of it.

    Raises:
        SplatpipeError: if the file is gone or is no longer the one that was checked.
    """
    with turn_to_decode(photo.width * photo.height):
        if not photo.plain:
            pixels, _ = read_8bit(photo, photo.deep_range)
            grey = pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)
            return _reduced_grey(Image.fromarray(grey)) if grey.size > LARGE_PIXELS else grey
        data = read_checked(photo.path, photo.name, photo.sha256)
        with open_picture(BytesIO(data)) as picture:
            share = min(1.0, MIN_SIDE_PX / max(picture.size))
            picture.draft("L", (max(1, int(picture.width * share)), max(1, int(picture.height * share))))
            if picture.width * picture.height > LARGE_PIXELS:
                return _reduced_grey(picture)
            return np.array(picture.convert("L"))


def _reduced_grey(picture: Image.Image) -> UInt8[np.ndarray, "h w"]:
    """The grey levels of a large picture that cannot be reduced while it is decoded: then, strip by strip."""
    room = max(picture.size) // MIN_SIDE_PX
    factor = next((by for by in (8, 4, 2) if room >= by), 1)
    picture.load()
    return np.concatenate([np.asarray(strip.convert("L").reduce(factor)) for strip in strips_of(picture)])


def brightness_of(grey: UInt8[np.ndarray, "h w"]) -> Brightness:
    """Measure the overall brightness of an image."""
    counts = np.bincount(grey[::2, ::2].ravel(), minlength=256).astype(np.float64)
    total = counts.sum()
    mean = float((counts * np.arange(256)).sum() / total)
    return Brightness(mean, float(counts[WHITE:].sum() / total), float(counts[: BLACK + 1].sum() / total))


def signature_of(grey: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "side side"]:
    """Reduce an image to a thumbnail of ``SIGNATURE`` pixels a side, whatever its aspect ratio."""
    small = cv2.resize(grey, (SIGNATURE, SIGNATURE), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def detail_at(
    grey: UInt8[np.ndarray, "h w"], places: Float64[np.ndarray, "n 2"]
) -> Float32[np.ndarray, "n directions"]:
    """Natural logarithm of the energy of fine waves over that of coarse ones around places, by direction.

    Args:
        grey: The image.
        places: x, y in its pixels. Direction 0 is of waves along x; the others turn from x towards y.

    Returns:
        The logarithms; NaN for places whose patch does not lie inside the image.
    """
    values = np.full((len(places), DIRECTIONS), np.nan, np.float32)
    inside, patches = _patches(grey, places, PATCH)
    if not len(inside):
        return values
    window = np.hanning(PATCH).astype(np.float32)
    patches = (patches - patches.mean(axis=(1, 2), keepdims=True)) * (window[:, None] * window)
    power = np.abs(np.fft.rfft2(patches)).astype(np.float32) ** 2
    coarse, fine = _bands()
    flat = power.reshape(len(patches), -1)
    noise = QUIET**2 * float((window**2).sum()) ** 2
    values[inside] = np.log((flat @ fine + noise * fine.sum(axis=0)) / (flat @ coarse + noise * coarse.sum(axis=0)))
    return values


def levels_at(grey: UInt8[np.ndarray, "h w"], places: Float64[np.ndarray, "n 2"]) -> Float32[np.ndarray, " n"]:
    """Brightness of places as binary logarithm of linear light; NaN at the border.

    Linearized with the transfer function of sRGB (IEC 61966-2-1), which most cameras roughly use.
    """
    values = np.full(len(places), np.nan, np.float32)
    inside, patches = _patches(grey, places, PATCH_LEVEL_PX)
    if len(inside):
        encoded = patches.mean(axis=(1, 2)) / 255.0
        linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        values[inside] = np.log2(np.maximum(linear, DARKEST))
    return values


def _patches(
    grey: UInt8[np.ndarray, "h w"], places: Float64[np.ndarray, "n 2"], side: int
) -> tuple[Int64[np.ndarray, " m"], Float32[np.ndarray, "m side side"]]:
    """Rows of the places whose square lies inside the image, and these squares."""
    corner = np.floor(places).astype(np.int64) - side // 2
    height, width = grey.shape
    fits = (corner >= 0).all(axis=1) & (corner + side <= (width, height)).all(axis=1)
    inside = np.flatnonzero(fits)
    steps = np.arange(side)
    rows = corner[inside, 1, None, None] + steps[:, None]
    return inside, grey[rows, corner[inside, 0, None, None] + steps].astype(np.float32)


def _bands() -> tuple[Float32[np.ndarray, "waves directions"], Float32[np.ndarray, "waves directions"]]:
    """Weights of a patch's half spectrum in each direction's coarse and fine band, coarse first."""
    y, x = np.meshgrid(np.fft.fftfreq(PATCH), np.fft.rfftfreq(PATCH), indexing="ij")
    length = np.hypot(x, y)
    sector = np.rint(np.arctan2(y, x) / (np.pi / DIRECTIONS)).astype(np.int64) % DIRECTIONS
    own = sector[..., None] == np.arange(DIRECTIONS)
    bands = [
        (own & ((length >= low) & (length < high))[..., None]).reshape(-1, DIRECTIONS).astype(np.float32)
        for low, high in (COARSE, FINE)
    ]
    return bands[0], bands[1]
