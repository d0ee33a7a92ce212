"""Render targets into photos with exactly known centres: perspective, blur, exposure, noise, JPEG.

A target is a square with a pattern, seen through a homography: a plane tilted against the view, with its own
perspective. It is drawn with eight by eight samples per pixel, blurred by defocus and camera motion, and composited
into the photo; the whole photo is then exposed, gets noise, and is compressed. A target's size is the square root of
its area in the photo, pixels; for a coded one, that of its black square.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]
Pattern = Callable[[Floats, Floats], tuple[Floats, Floats]]  # from a plane's x and y to whiteness and coverage
SAMPLES = 8  # along a pixel's side
WHITE_MARGIN = 1.0  # around a coded target, cells


@dataclass(frozen=True)
class TargetAppearance:
    """How targets look in a photo.

    Attributes:
        sizes_px: Least and largest size.
        tilt_deg: Largest angle between the plane and the view.
        defocus_px: Least and largest standard deviation of the lens's blur.
        motion_px: Largest length of the motion blur.
        exposures_ev: Least and largest exposure of the photo.
        noise: Largest standard deviation, of 255.
        quality: Least and largest JPEG quality.
    """

    sizes_px: tuple[float, float]
    tilt_deg: float = 60.0
    defocus_px: tuple[float, float] = (0.4, 1.0)
    motion_px: float = 2.0
    exposures_ev: tuple[float, float] = (-1.0, 0.5)
    noise: float = 4.0
    quality: tuple[int, int] = (80, 95)


@dataclass(frozen=True)
class RenderedTarget:
    """A target as rendered into a photo.

    Attributes:
        centre: Pixels; (0, 0) is the top-left corner of the first pixel.
        size_px: Square root of its area.
        thin_px: Its smaller extent: the shortest that foreshortening makes its side.
        name: Kind; for a coded target its ID.
    """

    centre: tuple[float, float]
    size_px: float
    thin_px: float
    name: str = ""


def quadrants(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Pattern of four black and white squares; the target is the plane's [-1, 1]²."""
    inside = (np.abs(x) <= 1.0) & (np.abs(y) <= 1.0)
    return (x * y > 0.0).astype(np.float64), inside.astype(np.float64)


def disc(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Pattern of a disc of four sectors in a square of the same extent."""
    return (x * y > 0.0).astype(np.float64), (x * x + y * y <= 1.0).astype(np.float64)


def bow_tie(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Pattern of a square cut into four triangles by its diagonals."""
    white, _ = quadrants(x + y, x - y)
    return white, (np.abs(x) <= 1.0).astype(np.float64) * (np.abs(y) <= 1.0)


def coded(cells: npt.NDArray[np.uint8]) -> Pattern:
    """Pattern of a coded target: its black square is [-1, 1]², with a white margin around it.

    Args:
        cells: Cells of the square, 0 black and 1 white, including the black border.
    """
    count = len(cells)
    reach = 1.0 + 2.0 * WHITE_MARGIN / count

    def pattern(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        column, row = (np.floor((v + 1.0) / 2.0 * count).astype(int) for v in (x, y))
        within = (column >= 0) & (column < count) & (row >= 0) & (row < count)
        value = np.ones_like(x)
        value[within] = cells[row[within], column[within]]
        return value, ((np.abs(x) <= reach) & (np.abs(y) <= reach)).astype(np.float64)

    return pattern


def plane_to_photo(centre: Floats, size_px: float, tilt_deg: float, rng: np.random.Generator) -> Floats:
    """Return a homography from a plane's [-1, 1]² to a target of a given size, tilted by up to an angle."""
    spin, axis, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(0, tilt_deg))
    turn = cv2.Rodrigues(np.array([0.0, 0.0, spin]))[0]
    lean = cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))[0]
    rotation = lean @ turn
    distance = rng.uniform(20.0, 60.0)  # in half sides: near targets show perspective
    columns = np.stack([rotation[:, 0], rotation[:, 1], np.array([0.0, 0.0, distance])], axis=1)
    unit = np.diag([1.0, 1.0, 1.0]) @ columns
    corners = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) @ unit.T
    corners = corners[:, :2] / corners[:, 2:]
    focal = size_px / np.sqrt(_area(corners))
    return np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]]) @ unit


def draw(photo: Floats, pattern: Pattern, homography: Floats, levels: tuple[Floats, Floats], kernel: Floats) -> Floats:
    """Composite a target into a photo (RGB, 0 to 255), antialiased and blurred by a kernel."""
    height, width = photo.shape[:2]
    reach = np.array([[-2, -2, 1], [2, -2, 1], [2, 2, 1], [-2, 2, 1]]) @ homography.T
    reach = reach[:, :2] / reach[:, 2:]
    pad = len(kernel) + 2
    left, top = np.maximum(np.floor(reach.min(axis=0)).astype(int) - pad, 0)
    right, bottom = np.minimum(np.ceil(reach.max(axis=0)).astype(int) + pad, [width, height])
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x = (np.arange(left, right)[:, None] + steps).ravel()
    y = (np.arange(top, bottom)[:, None] + steps).ravel()
    px, py = np.meshgrid(x, y)
    back = np.linalg.inv(homography)
    plane = np.stack([px, py, np.ones_like(px)], axis=-1) @ back.T
    value, there = pattern(plane[..., 0] / plane[..., 2], plane[..., 1] / plane[..., 2])
    shape = (bottom - top, SAMPLES, right - left, SAMPLES)
    alpha = there.reshape(shape).mean(axis=(1, 3))
    white = (value * there).reshape(shape).mean(axis=(1, 3))
    alpha, white = (cv2.filter2D(v, -1, kernel, borderType=cv2.BORDER_REPLICATE)[..., None] for v in (alpha, white))
    result = photo.copy()
    part = result[top:bottom, left:right]
    result[top:bottom, left:right] = part * (1.0 - alpha) + levels[1] * white + levels[0] * (alpha - white)
    return result


def blur_kernel(appearance: TargetAppearance, rng: np.random.Generator) -> Floats:
    """Return a kernel of defocus and motion, one sample per pixel."""
    size = int(2 * np.ceil(3 * appearance.defocus_px[1] + appearance.motion_px) + 1)
    fine = np.zeros((size * SAMPLES, size * SAMPLES))
    middle, length, angle = size * SAMPLES / 2, rng.uniform(0, appearance.motion_px) * SAMPLES, rng.uniform(0, np.pi)
    along = np.linspace(-length / 2, length / 2, 41)
    # The bilinear weights keep the mean at the centre: the blur does not shift the image.
    for at_x, at_y in zip(middle - 0.5 + along * np.cos(angle), middle - 0.5 + along * np.sin(angle), strict=True):
        ix, iy = int(np.floor(at_x)), int(np.floor(at_y))
        fx, fy = at_x - ix, at_y - iy
        fine[iy : iy + 2, ix : ix + 2] += np.outer([1 - fy, fy], [1 - fx, fx])
    fine = cv2.GaussianBlur(fine, (0, 0), rng.uniform(*appearance.defocus_px) * SAMPLES)
    kernel = fine.reshape(size, SAMPLES, size, SAMPLES).sum(axis=(1, 3))
    return np.asarray(kernel / kernel.sum())


def render(
    photo: Bytes,
    kinds: list[tuple[str, Pattern]],
    appearance: TargetAppearance,
    rng: np.random.Generator,
    apart_px: float,
) -> tuple[Bytes, list[RenderedTarget]]:
    """Return a photo with one target of each kind at random places, and the targets."""
    height, width = photo.shape[:2]
    canvas, placed = photo.astype(np.float64), []
    border = 2.0 * appearance.sizes_px[1] + 4.0
    for name, pattern in kinds:
        centre = _place(placed, (width, height), border, apart_px, rng)
        size = float(np.exp(rng.uniform(*np.log(appearance.sizes_px))))
        homography = plane_to_photo(centre, size, appearance.tilt_deg, rng)
        light = rng.uniform(0.5, 1.0)  # in sunlight or in shade
        levels = (light * rng.uniform(15, 60) * _tint(rng), light * rng.uniform(180, 245) * _tint(rng))
        canvas = draw(canvas, pattern, homography, levels, blur_kernel(appearance, rng))
        corners = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) @ homography.T
        corners = corners[:, :2] / corners[:, 2:]
        where = homography[:, 2] / homography[2, 2]
        thin = _area(corners) / max(np.linalg.norm(corners[2] - corners[0]), np.linalg.norm(corners[3] - corners[1]))
        placed.append(
            RenderedTarget((float(where[0]), float(where[1])), float(np.sqrt(_area(corners))), float(thin), name)
        )
    canvas = 255.0 * np.clip(canvas / 255.0 * 2.0 ** (rng.uniform(*appearance.exposures_ev) / 2.2), 0, 1)
    canvas += rng.normal(0.0, rng.uniform(0, appearance.noise), canvas.shape)
    done = np.clip(np.rint(canvas), 0, 255).astype(np.uint8)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(*appearance.quality))]
    data = cv2.imencode(".jpg", np.ascontiguousarray(done[:, :, ::-1]), quality)[1]
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[:, :, ::-1]), placed


def _place(
    placed: list[RenderedTarget], size: tuple[int, int], border: float, apart_px: float, rng: np.random.Generator
) -> Floats:
    for _ in range(1000):
        centre = np.array([rng.uniform(border, size[0] - border), rng.uniform(border, size[1] - border)])
        if all(np.hypot(*(centre - other.centre)) > apart_px for other in placed):
            return centre
    raise ValueError("no room for another target")


def _tint(rng: np.random.Generator) -> Floats:
    return 1.0 + rng.uniform(-0.06, 0.06, 3)


def _area(corners: Floats) -> float:
    x, y = corners[:, 0], corners[:, 1]
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))
