"""How much the exposures of a capture's photos differ, estimated from their colours at common points.

The surface's colour and the photo's gain are separated as in Goldman, "Vignette and Exposure Calibration and
Compensation" (PAMI 2010), without its vignetting: each observation is their product, and both are fitted alternately,
the gains as medians, so that highlights and moving objects have no influence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.pixels.dataset import View, load_points_and_tracks
from splatpipe.pipeline.photos.pixels.small_views import small_view
from splatpipe.pipeline.train.options import TrainConfig

MEGAPIXELS = 0.3  # photo size at which colours are sampled: each pixel averages many, which removes noise
WINDOW_PX = 5  # side of the mean around a point: points are off by a fraction of it
DARKEST, BRIGHTEST = 8.0, 247.0  # bounds of a channel that is not clipped, of 255
ROUNDS = 10  # rounds of fitting gains; they change by less than a thousandth in the last
MIN_SEEN = 20  # minimum number of points to estimate a photo's gain
DIFFERING = 0.06  # spread above which exposures differ. Measured: 0.027 to 0.034 in three captures whose light or
# exposure hardly changes (0.1 stops, known, are 0.034), 0.097 to 0.18 in five with automatic exposure


def exposure_spread(views: Sequence[View], dataset: Path, threads: int) -> float:
    """RMS of the photos' log gains about their mean, over the channels: 0.1 is a tenth of the colour values.

    Args:
        views: The photos.
        dataset: The photos' dataset, for its sparse points.
        threads: Number of threads that read photos.

    Raises:
        StageError: if a photo or the model is broken.
    """
    points, tracks = load_points_and_tracks(dataset)
    sample_colours = partial(_colours, xyz=points.xyz, tracks=tracks)
    seen = list(ordered_map(sample_colours, views, threads))
    rows = np.concatenate([np.zeros(0, np.int64), *(rows for rows, _ in seen)])
    logs = np.concatenate([np.zeros((0, 3)), *(logs for _, logs in seen)])
    photo = np.repeat(np.arange(len(seen)), [len(rows) for rows, _ in seen])
    gains = log_gains(photo, rows, logs, len(seen))
    return float(np.sqrt(np.square(gains).mean())) if len(gains) else 0.0


def decided_exposure(
    config: TrainConfig, views: Sequence[View], dataset: Path, threads: int, report: Reporter
) -> TrainConfig:
    """The options with ``exposure`` decided if it is `auto`: modelled if the photos' exposures differ.

    Args:
        config: The training options.
        views: Views to train on.
        dataset: As for ``exposure_spread``.
        threads: Number of threads that read photos.
        report: Receives the result.
    """
    if config.exposure != "auto":
        return config
    spread = exposure_spread(views, dataset, threads)
    differ = spread >= DIFFERING
    if differ:
        report.note(f"exposures differ by {spread:.0%}, so exposure is modelled")
    return config.model_copy(update={"exposure": "affine" if differ else "off"})


def log_gains(
    photo: Int64[np.ndarray, " n"], point: Int64[np.ndarray, " n"], logs: Float64[np.ndarray, "n 3"], photos: int
) -> Float64[np.ndarray, "k 3"]:
    """Log gains of the photos, with mean 0; only of photos that share enough points with others.

    Args:
        photo: Photo index of each observation.
        point: Point index of each observation.
        logs: Logarithms of the observed colours.
        photos: Number of photos.
    """
    _, number, count = np.unique(point, return_inverse=True, return_counts=True)
    shared = count[number] > 1
    photo, number, logs = photo[shared], number[shared], logs[shared]
    rows = [np.flatnonzero(photo == each) for each in range(photos)]
    rows = [own for own in rows if len(own) >= MIN_SEEN]
    gains, applied = np.zeros((len(rows), 3)), np.zeros_like(logs)  # by photo, and by observation
    for _ in range(ROUNDS):
        surface = np.stack([np.bincount(number, channel, len(count)) for channel in (logs - applied).T], axis=1)
        apart = logs - surface[number] / count[number, None]
        gains = np.array([np.median(apart[own], axis=0) for own in rows]).reshape(-1, 3)
        gains -= gains.mean(axis=0) if len(rows) else 0.0
        for own, gain in zip(rows, gains, strict=True):
            applied[own] = gain
    return gains


def _colours(
    view: View, xyz: Float64[np.ndarray, "m 3"], tracks: Mapping[str, Int64[np.ndarray, " _"]]
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """The points that a photo observes unclipped, and the logarithms of its colours there."""
    camera, pixels, mask = small_view(view, MEGAPIXELS)
    tracked = tracks[view.camera.name]
    inside, places, _ = camera.in_view(xyz[tracked])
    rows, (x, y) = tracked[inside], places.astype(np.int64).T
    colour = cv2.blur(pixels, (WINDOW_PX, WINDOW_PX))[y, x].astype(np.float64)
    counts = ((colour > DARKEST) & (colour < BRIGHTEST)).all(axis=1)
    if mask is not None:
        counts &= mask[y, x]
    return rows[counts], np.log(colour[counts])
