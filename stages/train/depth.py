"""Supervision by the sparse points: where a photo shows one, the render shall be as deep as it is.

The idea of Deng, Liu, Zhu, Ramanan: "Depth-supervised NeRF: Fewer Views and Faster Training for Free", CVPR 2022,
compared by inverse depth, in which a triangulated point's error is about the same near and far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from splatpipe.pipeline.raster import Render
from splatpipe.pipeline.scene.dataset import PointDepths, View, load_model
from splatpipe.stages.options import TrainConfig
from splatpipe.stages.train.stream import TrainingPhoto

LAST_WEIGHT = 0.1  # of the first: towards the end the photos know the surface better than a keypoint's pixel does
LEAST_ALPHA = 0.5  # below it a pixel shows more of the background than of a depth
LEAST_DEPTH_PER_MEDIAN = 1e-3  # a point nearer than that is none: its inverse depth would outweigh the photo


def supervised(views: Sequence[View], dataset: Path, options: TrainConfig) -> list[View]:
    """The views with the depths of their sparse points; as they are where `depth_weight` is 0.

    Args:
        views: Of the dataset.
        dataset: The folder that `undistort` left.
        options: The training's.

    Raises:
        StageError: if the model is broken.
    """
    if options.depth_weight == 0.0:
        return list(views)
    model = load_model(dataset)
    points = model.points3D
    numbers = np.array(sorted(points), np.int64)
    xyz = np.array([points[number].xyz for number in numbers], np.float64).reshape(-1, 3)
    tracks = np.array([points[number].track.length() for number in numbers], np.int64)
    errors = np.array([points[number].error for number in numbers], np.float64)
    weights = point_weights(tracks, errors)
    found = []
    observed = {image.name: image.get_observation_points2D() for image in model.images.values() if image.has_pose}
    for view in views:
        seen = observed.get(view.camera.name, [])
        rows = np.searchsorted(numbers, np.array([point.point3D_id for point in seen], np.int64))
        places = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
        found.append(replace(view, depths=_depths(view, places, xyz[rows], weights[rows])))
    return found


def point_weights(track_lengths: Int64[np.ndarray, " n"], errors_px: Float64[np.ndarray, " n"]) -> np.ndarray:
    """How far each sparse point's depth is to be believed, in [0, 1).

    The redundancy of its triangulation, (2 L - 3) / 2 L for L photos and three unknowns: the share of an error in a
    photo that shows in the residuals, a quarter for two photos. Times exp(-(e / mean e)²) of its reprojection error e
    (Deng et al., CVPR 2022).

    Args:
        track_lengths: Photos that each was seen in.
        errors_px: Mean reprojection errors; -1 where not known, which counts as the mean's.
    """
    lengths = np.maximum(track_lengths, 2)
    redundancy = (2.0 * lengths - 3.0) / (2.0 * lengths)
    known = np.isfinite(errors_px) & (errors_px >= 0.0)
    mean = float(errors_px[known].mean()) if known.any() else 0.0
    relative = np.where(known, errors_px, mean) / mean if mean > 0.0 else np.ones(len(lengths))
    return np.asarray(redundancy * np.exp(-np.square(relative)))


def _depths(
    view: View,
    places_px: Float64[np.ndarray, "n 2"],
    xyz: Float64[np.ndarray, "n 3"],
    weights: Float64[np.ndarray, " n"],
) -> PointDepths:
    """Those of a photo's points that lie in it and in front of its camera."""
    pose = view.camera.cam_from_world
    depth = xyz @ pose[2, :3] + pose[2, 3]
    share = places_px / [view.camera.width, view.camera.height]
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(depth) & (depth > 0.0) & ((share >= 0.0) & (share < 1.0)).all(axis=1) & (weights > 0.0)
    if usable.any():
        usable &= depth >= LEAST_DEPTH_PER_MEDIAN * np.median(depth[usable])
    return PointDepths(share[usable], depth[usable], weights[usable])


def depth_weight_at(options: TrainConfig, iteration: int) -> float:
    """The weight at an iteration: exponential from `depth_weight` to a tenth of it at the schedule's end."""
    return float(options.depth_weight * LAST_WEIGHT ** min(1.0, iteration / options.iterations))


def with_depth(
    loss: Float[Tensor, ""], rendered: Render, photo: TrainingPhoto, options: TrainConfig, iteration: int
) -> Float[Tensor, ""]:
    """The loss plus the weighted disagreement with the sparse points; the loss itself where `depth_weight` is 0.

    weight · median z · Σ w |1 / d - 1 / z| / Σ w, d the expected depth at the pixel of a point of depth z, over the
    points whose pixel is neither masked nor transparent: a relative depth, whatever the world's unit.

    Args:
        loss: Of the photo's colours.
        rendered: With depths.
        photo: With the depths of its points.
        options: The training's.
        iteration: From 1.
    """
    if options.depth_weight == 0.0 or photo.depths is None or len(photo.depths) == 0:
        return loss
    height, width = rendered.alpha.shape
    share, z = torch.from_numpy(photo.depths.share), torch.from_numpy(photo.depths.z).float()
    column, row = (share[:, 0] * width).long(), (share[:, 1] * height).long()
    alpha = rendered.alpha[row, column]
    counted = alpha.detach() >= LEAST_ALPHA
    if photo.mask is not None:
        counted &= photo.mask[row, column]
    weights = torch.from_numpy(photo.depths.weights).float() * counted
    total = float(weights.sum())
    if total <= 0.0:
        return loss
    depth_sum = rendered.depth_sum[row, column]
    inverse = torch.where(counted, alpha, 0.0) / torch.where(counted, depth_sum, 1.0)
    disagreement = (weights * (inverse - 1.0 / z).abs()).sum() / total
    scale: float = depth_weight_at(options, iteration) * float(np.median(photo.depths.z))
    return loss + scale * disagreement
