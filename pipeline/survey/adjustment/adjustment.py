"""Bundle adjustment with control: marks, surveyed points and scale bars enter the block beside tie points and camera
positions.

Everything is in world metres, in a fixed order and on one thread, so that results are bit-identical. Each flight's
common position error is an unknown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.geometry.robust import cauchy_weights, robust_similarity
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.sfm.lenses.focal import UNOBSERVED
from splatpipe.pipeline.survey.adjustment.block import Block
from splatpipe.pipeline.survey.adjustment.block_adjustment import (
    ROUNDS,
    AdjustedBlock,
    PositionObservations,
    adjust_block,
    joint_system,
    solve,
)
from splatpipe.pipeline.survey.adjustment.block_distances import Distances
from splatpipe.pipeline.survey.adjustment.block_lens import Lens
from splatpipe.pipeline.survey.adjustment.tie_points import TieTable, whole_model

UNBOUND_M = 1e4  # sigma of a height that was not measured
HELD_FOCAL_SIGMA = 0.01  # sigma of a focal length that nothing determines, relative to its prior
ROBUST_ROUNDS = 10  # rounds of reweighting of the similarity


@dataclass(frozen=True)
class Target:
    """A control point in the adjustment.

    Attributes:
        place: Surveyed position, world frame; the height is arbitrary if unknown.
        sigmas: Standard deviations, metres; infinite for unknown coordinates.
        start: Initial position, triangulated from the marks, world frame.
        marks: COLMAP image ids and pixels in the model's camera.
        mark_sigmas_px: Standard deviations of the marks, in the model's pixels.
    """

    place: Float64[np.ndarray, " 3"]
    sigmas: Float64[np.ndarray, " 3"]
    start: Float64[np.ndarray, " 3"]
    marks: Sequence[tuple[int, Float64[np.ndarray, " 2"]]]
    mark_sigmas_px: Float64[np.ndarray, " m"]


@dataclass(frozen=True)
class TargetDistances:
    """Scale bars in the adjustment.

    Attributes:
        ends: Targets without coordinates that bars need beside the control points.
        pairs: Indices of each bar's two targets: control points first, then ``ends``.
        lengths: Metres.
        sigmas: Their standard deviations.
    """

    ends: tuple[Target, ...]
    pairs: Int64[np.ndarray, "b 2"]
    lengths: Float64[np.ndarray, " b"]
    sigmas: Float64[np.ndarray, " b"]


NO_BARS = TargetDistances((), np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class ControlAdjustment:
    """The result of an adjustment.

    Attributes:
        adjusted: The block with the targets.
        observed: The positions in it.
        table: The observations of the whole model.
        source: The model before, in its own frame.
        world_from_model: Its approximate similarity.
        places: Adjusted positions of the targets, world frame.
        bar_ends: Adjusted positions of the scale bars' further ends, world frame.
        normed: Root mean square of each target's distance to its surveyed position, over its sigmas.
        held: Cameras whose focal length cannot be determined, so that it is held near its prior.
        focal_sigmas: Relative standard deviation of each camera's focal length, by COLMAP camera id.
    """

    adjusted: AdjustedBlock
    observed: PositionObservations
    table: TieTable
    source: pycolmap.Reconstruction
    world_from_model: Similarity
    places: Float64[np.ndarray, "n 3"]
    bar_ends: Float64[np.ndarray, "e 3"]
    normed: Float64[np.ndarray, " n"]
    held: tuple[int, ...]
    focal_sigmas: Mapping[int, float]

    @property
    def offsets(self) -> Float64[np.ndarray, "k 3"]:
        """Offset of each flight's positions, stated minus true, metres."""
        return self.adjusted.offsets

    @property
    def usable(self) -> bool:
        """Whether the adjustment found a solution."""
        return bool(np.isfinite(self.places).all()) and math.isfinite(self.adjusted.cost)

    @cached_property
    def reconstruction(self) -> pycolmap.Reconstruction:
        """The adjusted model, in the frame that it had."""
        return whole_model(self.source, self.table, self.adjusted.block, self.world_from_model)


@dataclass(frozen=True)
class ControlStart:
    """A model, its block, and the positions, before control enters.

    Attributes:
        source: The model, in its own frame.
        world_from_model: Its approximate similarity.
        table: All observations of its points.
        block: Of well-spread tie points, world frame.
        observed: The photos' positions.
        focal_priors: Focal lengths from the metadata, in the model's pixels, by COLMAP camera id: where neither photos
            nor control determine a focal length, it is held near these.
    """

    source: pycolmap.Reconstruction
    world_from_model: Similarity
    table: TieTable
    block: Block
    observed: PositionObservations
    focal_priors: Mapping[int, float]


def can_adjust(reconstruction: pycolmap.Reconstruction) -> bool:
    """Return whether every photo has its own pose (no rigs) and there are points to adjust."""
    images = [reconstruction.images[number] for number in reconstruction.reg_image_ids()]
    return reconstruction.num_points3D() > 0 and all(image.is_ref_in_frame() for image in images)


def adjust(
    start: ControlStart, targets: Sequence[Target], bars: TargetDistances = NO_BARS, rounds: int = ROUNDS
) -> ControlAdjustment:
    """Adjust a block to control, scale bars and positions, in at most so many steps."""
    first = len(start.block.points)
    block = _with_targets(start.block, [*targets, *bars.ends], start.table.numbers)
    block = replace(block, distances=Distances(first + bars.pairs, bars.lengths, bars.sigmas))
    done = adjust_block(block, start.observed, rounds=rounds)
    cameras = sorted(set(start.table.cameras))
    focal_sigmas = _focal_sigmas(done, start.observed, cameras)
    held = [n for n in cameras if n in start.focal_priors and focal_sigmas.get(n, 0.0) > UNOBSERVED]
    if held:
        lenses = list(done.block.lenses)
        for number in held:
            place = cameras.index(number)
            lenses[place] = _near(lenses[place], start.focal_priors[number])
        done = adjust_block(replace(done.block, lenses=tuple(lenses)), start.observed, done.offsets, rounds)
    places, bar_ends = np.split(done.block.points[first:], [len(targets)])
    normed = [
        math.sqrt(float((((p - t.place) / t.sigmas) ** 2).sum()) / np.isfinite(t.sigmas).sum())
        for p, t in zip(places, targets, strict=True)
    ]
    return ControlAdjustment(
        done,
        start.observed,
        start.table,
        start.source,
        start.world_from_model,
        places,
        bar_ends,
        np.array(normed),
        tuple(held),
        focal_sigmas,
    )


def _with_targets(block: Block, targets: Sequence[Target], numbers: Sequence[int]) -> Block:
    """A block with the targets as its last points, their marks as observations."""
    index, first = {number: k for k, number in enumerate(numbers)}, len(block.points)
    marks = [
        (index[number], first + k, *pixel, sigma)
        for k, target in enumerate(targets)
        for (number, pixel), sigma in zip(target.marks, target.mark_sigmas_px.tolist(), strict=True)
        if number in index
    ]
    table = np.array(marks, dtype=np.float64).reshape(-1, 5)
    places = np.array([target.place for target in targets]).reshape(-1, 3)
    sigmas = np.minimum(np.array([target.sigmas for target in targets]).reshape(-1, 3), UNBOUND_M)
    return replace(
        block,
        points=np.concatenate([block.points, np.array([target.start for target in targets]).reshape(-1, 3)]),
        photo=np.concatenate([block.photo, table[:, 0].astype(np.int64)]),
        point=np.concatenate([block.point, table[:, 1].astype(np.int64)]),
        pixels=np.concatenate([block.pixels, table[:, 2:4]]),
        sigmas=np.concatenate([block.sigmas, table[:, 4]]),
        stated=np.concatenate([block.stated, places]),
        weights=np.concatenate([block.weights, 1.0 / sigmas**2]),
    )


def _focal_sigmas(done: AdjustedBlock, observed: PositionObservations, cameras: Sequence[int]) -> dict[int, float]:
    """Relative standard deviation of each free focal length."""
    normal, _ = joint_system(done.reduced, observed, done.block, done.offsets)
    result = {}
    for number, lens, where in zip(cameras, done.block.lenses, done.block.lens_slices, strict=True):
        if "f" in lens.names:
            unit = np.zeros(len(normal))
            unit[where.start + lens.names.index("f")] = 1.0
            result[number] = math.sqrt(max(float(unit @ solve(normal, unit)), 0.0)) / float(lens.camera.params[0])
    return result


def _near(lens: Lens, focal_px: float) -> Lens:
    """A lens that starts at a focal length and stays within three times ``HELD_FOCAL_SIGMA`` of it."""
    at = lens.names.index("f")
    mean, sigmas, step = lens.mean.copy(), lens.sigmas.copy(), np.zeros(len(lens.names))
    mean[at], sigmas[at], step[at] = focal_px, HELD_FOCAL_SIGMA * focal_px, focal_px - lens.values[at]
    return replace(lens.moved(step), mean=mean, sigmas=sigmas)


def moved_px(before: pycolmap.Reconstruction, after: pycolmap.Reconstruction) -> float:
    """Return how far an adjustment deformed the model, pixels: RMS displacement of the points after a best-fit
    similarity, projected into the original cameras.

    Args:
        before: The model.
        after: The adjusted model in any frame, with the same ids of points and photos.
    """
    numbers = sorted(set(before.points3D.keys()) & set(after.points3D.keys()))
    if len(numbers) < 3:
        return 0.0
    old = np.array([before.points3D[number].xyz for number in numbers])
    new = np.array([after.points3D[number].xyz for number in numbers])

    def weigh(distance: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        return cauchy_weights(distance, max(float(np.median(distance)), 1e-300), half_at=1.0)

    # Distant points are seen by few photos, and would rotate the fit.
    back = robust_similarity(new, old, weigh, ROBUST_ROUNDS)[0].apply(new)
    place = {number: k for k, number in enumerate(numbers)}
    squares: list[Float64[np.ndarray, " n"]] = []
    for number in sorted(before.reg_image_ids()):
        image = before.images[number]
        seen = [place[p.point3D_id] for p in image.points2D if p.has_point3D() and p.point3D_id in place]
        if not seen:
            continue
        camera, pose = before.cameras[image.camera_id], image.cam_from_world().matrix()
        projected = [project_through_lens(camera, pose, xyz[seen])[0] for xyz in (old, back)]
        squares.append(((projected[1] - projected[0]) ** 2).sum(axis=1))
    together = np.concatenate(squares)
    return float(np.sqrt(together[np.isfinite(together)].mean()))
