"""Detect coded square targets (ArUco and AprilTag) in a photo: their ids and centres.

OpenCV's detector finds dark squares and decodes them (Garrido-Jurado et al., "Automatic generation and detection of
highly reliable fiducial markers under occlusion", Pattern Recognition 2014; Olson, "AprilTag", ICRA 2011). Small ones
are decoded in an enlarged image: otherwise a cell of two pixels blurs into its neighbours.

Dictionaries with few bits find codes in noise: for those with 16 bits, no bit error is corrected. A square that two
dictionaries decode is reported for both: the names of the ground control points say which one is meant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

# In OpenCV, a family's smaller dictionaries are the first ids of its largest, except 4X4_1000 and others with a
# different Hamming distance.
DICTIONARIES = (
    "DICT_APRILTAG_36h11",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_16h5",
    "DICT_4X4_250",
    "DICT_5X5_250",
    "DICT_6X6_250",
    "DICT_7X7_250",
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12",
)
ENLARGED = 2
SMALLEST_PX = 12.0  # side of a black square
LARGEST_SHARE = 0.9  # largest side of a black square over the image's longer side
TILE_PX, OVERLAP_PX = 1536, 160  # enlarged images are searched in tiles, to save memory; larger squares at full size
SAMPLES = 3  # along a cell's side
MIN_CORRELATION = 0.7  # correlation of a square's pixels with the dictionary's pattern
# One square in 66 is a code of this dictionary by chance (250 codes, four rotations, 16 bits): eight times as many as
# for any other. Windows of a façade reach 0.79; rendered targets of 20 px or more have at least 0.86.
DENSEST, MIN_OF_DENSEST = "DICT_4X4_250", 0.83
MIN_CONTRAST = 25.0  # white minus black, grey levels of 255
# Grey levels by which black is darker than its surroundings' mean, which lies halfway to white. OpenCV's 7 finds no
# more targets, but many squares of less than MIN_CONTRAST in sand and grass, which take most of the time to read.
DARKER_THAN_MEAN = 10.0
CENTRE_SIGMA_PX = 0.1


@dataclass(frozen=True)
class CodedTarget:
    """A detected target.

    Attributes:
        dictionary: OpenCV's name without ``DICT_``, in lower case.
        number: Its id.
        x: Of its centre, pixels; (0, 0) is the top-left corner of the first pixel.
        y: Likewise.
        size_px: Square root of its black square's area, pixels.
        sigma_px: Standard deviation of x and y, pixels.
        score: Correlation of the pixels with the pattern.
    """

    dictionary: str
    number: int
    x: float
    y: float
    size_px: float
    sigma_px: float
    score: float


def find_coded_targets(pixels: UInt8[np.ndarray, "h w 3"]) -> list[CodedTarget]:
    """Find coded targets in an image.

    Args:
        pixels: RGB.

    Returns:
        The targets, sorted by dictionary, id and position.
    """
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    found: list[CodedTarget] = []
    if max(height, width) > TILE_PX:
        found = _search_scale(grey, 1, SMALLEST_PX * ENLARGED)
    for top in _starts(height):
        for left in _starts(width):
            tile = np.ascontiguousarray(grey[top : top + TILE_PX, left : left + TILE_PX])
            for target in _search_scale(tile, ENLARGED, SMALLEST_PX):
                there = replace(target, x=target.x + left, y=target.y + top)
                found = [other for other in found if not _same(other, there)] + [there]
    return sorted(found, key=lambda target: (target.dictionary, target.number, target.y, target.x))


def _starts(length: int) -> list[int]:
    """Start positions of the tiles that cover a side."""
    return list(range(0, max(length - OVERLAP_PX, 1), TILE_PX - OVERLAP_PX))


def _same(a: CodedTarget, b: CodedTarget) -> bool:
    named = (a.dictionary, a.number) == (b.dictionary, b.number)
    return named and np.hypot(a.x - b.x, a.y - b.y) < 0.5 * min(a.size_px, b.size_px)


def _search_scale(grey: UInt8[np.ndarray, "h w"], scale: int, smallest_px: float) -> list[CodedTarget]:
    """Find the targets in an image that is first enlarged by ``scale``; coordinates are those of the original."""
    height, width = grey.shape
    if min(height, width) < smallest_px:
        return []
    large = grey
    if scale > 1:
        large = cv2.resize(grey, (width * scale, height * scale), interpolation=cv2.INTER_CUBIC)
    names = list(DICTIONARIES)
    dictionaries = [cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)) for name in names]
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshConstant = DARKER_THAN_MEAN
    parameters.minMarkerPerimeterRate = 4.0 * smallest_px / max(height, width)
    parameters.maxMarkerPerimeterRate = 4.0 * LARGEST_SHARE
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    detector = cv2.aruco.ArucoDetector(dictionaries, parameters)
    corners, ids, _, which = detector.detectMarkersMultiDict(large)
    found = []
    for quad, number, index in zip(
        corners, [] if ids is None else ids.ravel(), [] if ids is None else which.ravel(), strict=True
    ):
        # In OpenCV, pixel centres are whole numbers, in the enlarged image too.
        square = (quad.reshape(4, 2).astype(np.float64) + 0.5) / scale
        target = _check_pattern(grey, square, dictionaries[int(index)], int(number), names[int(index)])
        if target is not None:
            found.append(target)
    return found


def _check_pattern(
    grey: UInt8[np.ndarray, "h w"],
    square: Float64[np.ndarray, "4 2"],
    dictionary: cv2.aruco.Dictionary,
    number: int,
    name: str,
) -> CodedTarget | None:
    """Return the target if its pixels match the dictionary's pattern, else None."""
    cells = dictionary.markerSize + 2
    ideal = dictionary.generateImageMarker(number, cells * SAMPLES).astype(np.float32)
    plane = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    homography = cv2.getPerspectiveTransform(plane, square.astype(np.float32)).astype(np.float64)
    steps = (np.arange(cells * SAMPLES) + 0.5) / (cells * SAMPLES)
    u, v = np.meshgrid(steps, steps)
    there = np.stack([u, v, np.ones_like(u)], axis=-1) @ homography.T
    x, y = there[..., 0] / there[..., 2] - 0.5, there[..., 1] / there[..., 2] - 0.5
    seen = cv2.remap(grey, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR).astype(np.float32)
    area = 0.5 * abs(
        float(np.dot(square[:, 0], np.roll(square[:, 1], -1)) - np.dot(square[:, 1], np.roll(square[:, 0], -1)))
    )
    score = float(np.corrcoef(seen.ravel(), ideal.ravel())[0, 1]) if seen.std() > 0.0 else 0.0
    contrast = float(seen[ideal > 127].mean() - seen[ideal <= 127].mean())
    least = MIN_OF_DENSEST if name == DENSEST else MIN_CORRELATION
    if score < least or contrast < MIN_CONTRAST:
        return None
    centre = homography @ np.array([0.5, 0.5, 1.0])
    middle = centre[:2] / centre[2]
    family = name.removeprefix("DICT_").lower()
    return CodedTarget(family, number, float(middle[0]), float(middle[1]), float(np.sqrt(area)), CENTRE_SIGMA_PX, score)
