"""Held-out views: similarity metrics of render and photo, and the images that are kept."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels
from splatpipe.pipeline.splat.quality import metrics

ERROR_FULL_SCALE = 0.25  # mean absolute error over the channels shown as the brightest colour, in every image
EQUAL_DB = 100.0  # stands for the infinite PSNR of identical images: JSON has no infinity
MASKED_GREY = 128
MIN_INSIDE_SHARE = 0.01  # share of a photo inside the boundary below which it is not measured
LEVELS = np.arange(256, dtype=np.float32) / np.float32(255.0)  # of 8 bits, as the metrics take them
MAX_STEM_CHARACTERS = 100  # characters; file systems allow 255 bytes, and a letter may take four


def evaluate_view(
    view: tuple[Camera, Pixels, Mask | None], render: Pixels, stem: Path, inside: Mask | None = None
) -> dict[str, Any]:
    """Measure one view and write its images.

    Args:
        view: The held-out photo at evaluation size: camera, photo and mask.
        render: The model's render of the view.
        stem: Path of the images without suffixes.
        inside: Pixels that show the area inside the boundary, the only ones that count then; None without a boundary.

    Returns:
        Its name, the images' common stem, its size and the value of each metric; with a boundary also those of the
        ``whole`` image.
    """
    camera, photo, mask = view
    whole = {} if inside is None else {"whole": measure(render, photo, mask)}
    mask = mask if inside is None else inside if mask is None else inside & mask
    _write_png(stem, "photo", photo)
    _write_png(stem, "render", render)
    _write_png(stem, "error", error_picture(render, photo, mask))
    if mask is not None:
        _write_png(stem, "mask", np.where(mask, np.uint8(255), np.uint8(0)))
    valid_share = 1.0 if mask is None else round(float(mask.mean()), 6)
    facts = {"name": camera.name, "file": stem.name, "width": photo.shape[1], "height": photo.shape[0]}
    figures = measure(render, photo, mask)
    if inside is not None and valid_share < MIN_INSIDE_SHARE:
        figures = dict.fromkeys(figures)
    return facts | {"counted": valid_share} | figures | whole


def shows_inside(area: PlanArea, camera: Camera, depth: Float[np.ndarray, "h w"]) -> Mask:
    """Which pixels show the area inside a boundary, according to the model's own depth.

    Args:
        area: The boundary's area, in the model's frame.
        camera: The view's camera.
        depth: Its median depth along the view axis; 0 where there is none.
    """
    rows, columns = np.nonzero(depth > 0.0)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    inside = np.zeros(depth.shape, np.bool_)
    inside[rows, columns] = area.contains(camera.unproject(pixels, depth[rows, columns].astype(np.float64)))
    return inside


def measure(render: Pixels, photo: Pixels, mask: Mask | None) -> dict[str, float | None]:
    """All metrics of an 8-bit render against an 8-bit photo; None where one is undefined (too few pixels).

    Args:
        render: (h, w, 3).
        photo: (h, w, 3).
        mask: (h, w), True where pixels count.
    """
    x, y = (torch.from_numpy(cv2.LUT(pixels, LEVELS)) for pixels in (render, photo))
    mask_tensor = None if mask is None else torch.from_numpy(mask)
    try:
        pair = metrics.pair_of(x, y, mask_tensor)
    except ValueError:  # no pixel counts
        return dict.fromkeys(metrics.METRICS)
    try:
        return {name: _measured(metric, pair) for name, metric in metrics.METRICS.items()}
    finally:
        return_free_heap()  # metrics free hundreds of megabytes, which the heaps of several threads would keep


def _measured(metric: metrics.Metric, pair: metrics.ImagePair) -> float | None:
    try:
        value = float(metric.of_pair(pair))
    except ValueError:  # too few pixels for this metric
        return None
    value = min(value, EQUAL_DB) if metric in (metrics.psnr, metrics.psnr_cc) else value
    return round(value, 6) if math.isfinite(value) else None


def judged_views(held_out: Sequence[str], most: int) -> list[str]:
    """The held-out photos that are judged: at most ``most`` (0: all), the middle one of as many equal stretches.

    In order of name photos follow the capture's path, so these are spread in space and time.

    Args:
        held_out: Names of the held-out photos, in order.
        most: Largest number of them.
    """
    if most == 0 or len(held_out) <= most:
        return list(held_out)
    return [held_out[(2 * stretch + 1) * len(held_out) // (2 * most)] for stretch in range(most)]


def mean_measures(per_view: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Each metric's mean over the views in which it is defined; None without any."""
    means: dict[str, float | None] = {}
    for name in metrics.METRICS:
        values = [view[name] for view in per_view if view[name] is not None]
        means[name] = round(math.fsum(values) / len(values), 6) if values else None
    return means


def mean_megapixels(per_view: Sequence[dict[str, Any]]) -> float | None:
    """Mean size at which the views were measured; None without any."""
    sizes = [view["width"] * view["height"] / 1e6 for view in per_view]
    return round(math.fsum(sizes) / len(sizes), 3) if sizes else None


def error_picture(render: Pixels, photo: Pixels, mask: Mask | None) -> Pixels:
    """Mean absolute error over the channels as a heat map of fixed scale, masked pixels grey; (h, w, 3) RGB."""
    red, green, blue = cv2.split(cv2.absdiff(render, photo))
    sums = np.asarray(cv2.add(cv2.add(red, green), blue), np.uint8)  # ends at 255, which is beyond the scale
    brightness = np.clip(np.arange(256) / 3 / 255.0 / ERROR_FULL_SCALE * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
    colours = np.ascontiguousarray(cv2.applyColorMap(brightness, cv2.COLORMAP_INFERNO)[:, :, ::-1])
    picture = np.asarray(cv2.LUT(cv2.merge([sums] * 3), colours), np.uint8)
    if mask is not None:
        picture[~mask] = MASKED_GREY
    return picture


def flat_stems(names: Sequence[str]) -> list[str]:
    """File stems for photos whose names may contain folders: safe, and unique even ignoring case.

    Args:
        names: Photo names, in POSIX form.
    """
    taken: set[str] = set()
    stems = []
    for name in names:
        flat = name.rpartition(".")[0] or name
        flat = "".join("_" if letter in '/\\:*?"<>|' or ord(letter) < 32 else letter for letter in flat)
        flat = flat.strip(". ")[-MAX_STEM_CHARACTERS:] or "photo"
        stem, copies = flat, 1
        while stem.casefold() in taken:
            copies += 1
            stem = f"{flat}~{copies}"
        taken.add(stem.casefold())
        stems.append(stem)
    return stems


def _write_png(stem: Path, kind: str, pixels: Pixels) -> None:
    ordered = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".png", ordered)
    if not done:
        raise StageError(f"The {kind} of {stem.name} could not be coded as PNG.")
    write_file(stem.with_name(f"{stem.name}.{kind}.png"), data.tobytes())
