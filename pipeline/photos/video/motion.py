"""Measure a film, frame by frame: how sharp each is, and how the picture moves from one to the next.

Only two small grey pictures are held at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from splatpipe.pipeline.photos.pixels.images import reduced

SHARP_SIDE, TRACKED_SIDE = 1920, 480  # pixels: the longer sides at which sharpness and motion are measured
# corners that are followed: at most, of the best one's strength, pixels
POINTS, MIN_CORNER_QUALITY, CORNER_SPACING_PX = 300, 0.01, 8
WINDOW, LEVELS = (15, 15), 3  # search window (pixels) and pyramid levels of the corner tracker: 60 pixels far
TOLERANCE_PX = 1.5  # off the common motion: nearer and farther ground moves differently
MIN_FOLLOWED, MIN_SHARE = 12, 0.25  # corners, and their share that agrees
AREA_RATIO_BOUNDS = (0.5, 2.0)  # bounds on the ratio of areas from frame to frame
ROW = 12  # numbers that are measured of a frame
MAX_LOST_FRAMES = 15  # frames without motion, such as a flash, before it counts as a cut


@dataclass(frozen=True, eq=False)
class Measures:
    """What was measured of a film.

    Attributes:
        frames: The number of each measured frame, from 0.
        times_s: When it is shown, from the film's start.
        sharpness: Contrast of its finest details, grey levels; comparable where frames show about the same.
        steps: Affine maps from the measured frame before to this one, coordinates as shares of width and height; NaN
            where the picture is another one (a cut), as for the first.
    """

    frames: Int64[np.ndarray, " n"]
    times_s: Float64[np.ndarray, " n"]
    sharpness: Float64[np.ndarray, " n"]
    steps: Float64[np.ndarray, "n 3 3"]

    def __len__(self) -> int:
        return len(self.frames)


@dataclass(eq=False)
class FilmMeter:
    """Measures frames one after the other.

    Attributes:
        rows: What was measured of each frame so far: number, time, sharpness, and the nine numbers of the step.
        last: The small grey picture that motion is measured from; None before the first frame.
        waited: Frames since then that show something else.
    """

    rows: list[Float64[np.ndarray, " 12"]] = field(default_factory=list)
    last: UInt8[np.ndarray, "h w"] | None = None
    waited: int = 0

    @property
    def begun(self) -> int:
        """The number of the first frame that is not measured yet."""
        return int(self.rows[-1][0]) + 1 if self.rows else 0

    def add(self, number: int, time_s: float, pixels: UInt8[np.ndarray, "h w 3"]) -> None:
        """Measure the next frame: its number, time in seconds, and pixels (BGR)."""
        grey = reduced(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), SHARP_SIDE)
        small = reduced(grey, TRACKED_SIDE)
        step = None if self.last is None else motion(self.last, small)
        if step is not None or self.last is None or self.waited >= MAX_LOST_FRAMES:
            self.last, self.waited = small, 0
        else:
            self.waited += 1  # compared again with the last good frame; this one is not chosen
        sharp = 0.0 if self.waited else sharpness(grey)
        step = np.eye(3) if self.waited else step
        self.rows.append(np.array([number, time_s, sharp, *(np.full(9, np.nan) if step is None else step.ravel())]))

    def measures(self) -> Measures:
        """What was measured so far."""
        table = np.array(self.rows).reshape(-1, ROW)
        return Measures(table[:, 0].astype(np.int64), table[:, 1], table[:, 2], table[:, 3:].reshape(-1, 3, 3))


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Contrast of the finest details: geometric mean of that across and that down, as motion blurs in one direction."""
    across, down = (cv2.meanStdDev(cv2.Sobel(grey, cv2.CV_16S, *order))[1][0, 0] for order in ((2, 0), (0, 2)))
    return float(np.sqrt(across * down))


def motion(first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]) -> Float64[np.ndarray, "3 3"] | None:
    """The affine map from one frame to the next, in shares of width and height; None if they show different things."""
    corners = cv2.goodFeaturesToTrack(first, POINTS, MIN_CORNER_QUALITY, CORNER_SPACING_PX)
    if corners is None or len(corners) < MIN_FOLLOWED:
        return None
    moved, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=WINDOW, maxLevel=LEVELS)
    kept = found[:, 0] == 1
    if kept.sum() < MIN_FOLLOWED:
        return None
    affine, agree = cv2.estimateAffine2D(corners[kept], moved[kept], ransacReprojThreshold=TOLERANCE_PX)
    if affine is None or agree.sum() < max(MIN_FOLLOWED, MIN_SHARE * len(corners)):
        return None
    if not AREA_RATIO_BOUNDS[0] <= np.linalg.det(affine[:, :2]) <= AREA_RATIO_BOUNDS[1]:
        return None
    height, width = first.shape
    shares = np.diag([1.0 / width, 1.0 / height, 1.0])
    return np.asarray(shares @ np.vstack([affine, [0.0, 0.0, 1.0]]) @ np.linalg.inv(shares))
