"""Keypoint extraction for one photo: locations, shapes, descriptors and colours."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap

from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.photos.files.photo_list import Photo, decode, decode_mask
from splatpipe.pipeline.photos.pixels.images import reduced
from splatpipe.pipeline.sfm.options import FeaturesConfig

Floats = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]

DESCRIPTOR_NORM = 512.0  # COLMAP's: 8-bit descriptors are 512 times the unit vector


EXTRACTION_BYTES = {"opencv-sift": 250, "sift": 370}
"""Memory per pixel of the image that keypoints are found in: its scale space. Measured: 239 to 242 from 0.5 to 1.9
megapixels (OpenCV), 360 at 4.3 (COLMAP)."""
CONTRAST = 0.04  # OpenCV's default
DECODING_BYTES = 8  # per pixel of the photo: Pillow's four, and ours as RGB with a strip being converted


def extraction_bytes(config: FeaturesConfig, photo_pixels: int, longest: int) -> int:
    """Memory for the keypoints of one photo, an upper bound.

    Args:
        config: Extraction options.
        photo_pixels: Number of pixels of the photo.
        longest: Its longer side, pixels.
    """
    share = min(1.0, config.max_image_size / longest)
    return round(DECODING_BYTES * photo_pixels + EXTRACTION_BYTES[config.extractor] * share * share * photo_pixels)


@dataclass(frozen=True)
class Features:
    """Keypoints of a photo.

    Attributes:
        keypoints: (n, 6) x, y in pixels of the photo's stored grid, and the 2x2 shape matrix, row by row.
        descriptors: (n, 128) square-rooted SIFT times 512.
        colours: (n, 3) RGB.
    """

    keypoints: Floats
    descriptors: Bytes
    colours: Bytes


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """Turn off OpenCV's threads in a context: photos are processed in parallel, so they would only add overhead."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def extract(
    photo: Photo, config: FeaturesConfig, part: Path, photos_dir: Path, scratch: Path, contrast: float = CONTRAST
) -> Features:
    """Extract the keypoints of a photo in its unmasked area.

    Args:
        photo: A photo of the photo list.
        config: Extraction options.
        part: The folder of the artifact ``ingest.photos``.
        photos_dir: The user's folder.
        scratch: An existing folder for temporary files.
        contrast: As for ``opencv_sift``.

    Raises:
        SplatpipeError: If the photo is missing or has changed since it was checked.
    """
    pixels = decode(photo, part, photos_dir)
    mask = decode_mask(photo, part)
    share = 1.0 if mask is None else float(np.count_nonzero(mask)) / mask.size
    if share == 0.0:
        return Features(np.zeros((0, 6), np.float32), np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.uint8))
    small = reduced(pixels, config.max_image_size)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    scale = np.array([pixels.shape[1] / grey.shape[1], pixels.shape[0] / grey.shape[0]])

    def unmasked(keypoints: Floats) -> npt.NDArray[np.int64]:
        rows = np.arange(len(keypoints))
        return rows if mask is None else rows[_pixels_at(mask, keypoints[:, :2] * scale) > 0]

    def kept(keypoints: Floats) -> npt.NDArray[np.int64]:
        rows = unmasked(keypoints)
        return rows[largest(keypoints[rows], config.max_features)]

    if config.extractor == "opencv-sift":
        keypoints, descriptors = opencv_sift(grey, kept, contrast)
    else:
        keypoints, descriptors = colmap_sift(grey, math.ceil(config.max_features / share), scratch)
        rows = unmasked(keypoints)
        keypoints, descriptors = keypoints[rows], np.ascontiguousarray(descriptors[rows])
    full = keypoints.astype(np.float64)
    full[:, :2] *= scale
    full[:, 2:] *= scale.mean()
    return Features(full.astype(np.float32), descriptors, _pixels_at(small, keypoints[:, :2]))


def largest(keypoints: Floats, places: int) -> npt.NDArray[np.int64]:
    """Return rows of the largest, most repeatable keypoints, largest first; ties keep their order.

    Args:
        keypoints: (n, 6) as in ``Features``.
        places: Number of distinct locations; a location with several orientations counts once.
    """
    sizes = np.hypot(keypoints[:, 2], keypoints[:, 4])
    order = np.argsort(-sizes, kind="stable")
    _, first, index = np.unique(keypoints[order, :2], axis=0, return_index=True, return_inverse=True)
    ranks = np.argsort(np.argsort(first))  # rank of each location by its largest keypoint
    return np.asarray(order[ranks[index.ravel()] < places], np.int64)


def _pixels_at(image: Bytes, points: npt.NDArray[np.floating]) -> Bytes:
    """Return the pixel values at points (n, 2; the centre of the first pixel is (0.5, 0.5))."""
    x = np.clip(np.floor(points[:, 0]).astype(int), 0, image.shape[1] - 1)
    y = np.clip(np.floor(points[:, 1]).astype(int), 0, image.shape[0] - 1)
    return np.asarray(image[y, x])


def colmap_sift(grey: Bytes, limit: int, scratch: Path) -> tuple[Floats, Bytes]:
    """Run COLMAP's SIFT.

    Called through ``extract_features``: pycolmap's direct extractor holds the GIL, so only one photo at a time could
    be processed.

    Args:
        grey: (h, w).
        limit: Target number of keypoints, coarse scales first. All keypoints of the scale that reaches it are kept.
        scratch: An existing folder for temporary files.

    Returns:
        (n, 6) keypoints as in ``Features`` but in pixels of ``grey``, and (n, 128) descriptors.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = 1
    options.max_image_size = max(grey.shape)
    options.sift.max_num_features = limit
    with tempfile.TemporaryDirectory(dir=scratch, ignore_cleanup_errors=True) as folder:
        path = Path(folder) / "database.db"
        write_file(Path(folder) / "photo.pgm", b"P5 %d %d 255\n" % grey.shape[::-1] + grey.tobytes())
        pycolmap.Database.open(path).close()
        pycolmap.extract_features(
            path, folder, image_names=["photo.pgm"], extraction_options=options, device=pycolmap.Device.cpu
        )
        with pycolmap.Database.open(path) as database:
            keypoints = np.asarray(database.read_keypoints(1), np.float32).reshape(-1, 6)
            descriptors = np.asarray(database.read_descriptors(1).data, np.uint8).reshape(-1, 128)
    return keypoints, descriptors


def opencv_sift(
    grey: Bytes, kept: Callable[[Floats], npt.NDArray[np.int64]], contrast: float = CONTRAST
) -> tuple[Floats, Bytes]:
    """Run OpenCV's SIFT with square-rooted descriptors (RootSIFT; Arandjelović and Zisserman, CVPR 2012).

    OpenCV's own limit keeps the strongest responses, which costs half the matches.

    Args:
        grey: (h, w).
        kept: Chooses rows of the (n, 6) keypoints.
        contrast: The least contrast of a keypoint; fainter ones are noise, or the texture of what has little.

    Returns:
        As ``colmap_sift``, of the chosen keypoints.
    """
    # Without precise upscaling every keypoint is a quarter of a pixel off.
    detector = cv2.SIFT_create(contrastThreshold=contrast, enable_precise_upscale=True)
    # Of faint keypoints most are left out: describing them all costs more than the scale space once more.
    at_once = contrast >= CONTRAST
    found, values = detector.detectAndCompute(grey, None) if at_once else (detector.detect(grey, None), None)
    keypoints = _keypoints_of(found)
    rows = kept(keypoints)
    if not at_once and len(rows):
        _, values = detector.compute(grey, [found[row] for row in rows.tolist()])
    elif values is not None:
        values = values[rows]
    if values is None or len(rows) == 0:
        return np.zeros((0, 6), np.float32), np.zeros((0, 128), np.uint8)
    sums = np.maximum(values.sum(axis=1, keepdims=True, dtype=np.float64), 1e-12)
    rooted = np.rint(DESCRIPTOR_NORM * np.sqrt(values / sums))
    return keypoints[rows], np.minimum(rooted, 255).astype(np.uint8)


def _keypoints_of(found: Sequence[cv2.KeyPoint]) -> Floats:
    """OpenCV's keypoints as in ``Features``, in pixels of the image."""
    place = np.array([keypoint.pt for keypoint in found], np.float64).reshape(-1, 2) + 0.5
    radius = np.array([keypoint.size / 2 for keypoint in found])
    angle = np.radians([keypoint.angle for keypoint in found])
    cos, sin = radius * np.cos(angle), radius * np.sin(angle)
    return np.column_stack([place, cos, -sin, sin, cos]).astype(np.float32)
