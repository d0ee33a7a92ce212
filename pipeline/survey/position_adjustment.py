"""Adjust a model to its photos' positions: positions, tie points and lens in one block adjustment.

Photos straight down, mapped without their positions, leave a bowl in the model and a wrong focal length: a similarity
fitted to positions keeps both. Accurate positions (RTK, PPK) remove the bowl, and let the lens be calibrated with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.sfm.lens_model import NAMES, WIDE, is_known, narrow, set_lens
from splatpipe.pipeline.sfm.retriangulation import MAX_ERROR_PX
from splatpipe.pipeline.survey.block import Block, Lens, free_lens, settle_points
from splatpipe.pipeline.survey.block_accuracy import BlockAccuracy, accuracy_of
from splatpipe.pipeline.survey.block_adjustment import AdjustedBlock, PositionObservations, adjust_block
from splatpipe.pipeline.survey.position_noise import (
    PositionNoise,
    StatedPositions,
    as_stated,
    centre_system,
    estimate_noise,
    find_blunders,
    predicted_errors,
    strip_pieces,
)
from splatpipe.pipeline.survey.tie_points import TieTable, block_of, image_errors, intersected, spread_points, tie_table

MAX_PHOTOS = 1000  # more are adjusted in a part: the system is dense
MIN_SIGMA_PX = 1.0  # of tie points: the errors of a lens and of matching are shared by neighbours
CELLS = 5  # a side, of the grid in which a photo's errors are averaged
SIMPLE = ("f", "k1")
ALL = ("f", "aspect", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
ALL_FISHEYE = ("f", "aspect", "cx", "cy", "k1", "k2", "k3", "k4")
WEAK = {"k1": 0.3, "k2": 0.3, "k3": 0.3, "k4": 0.3, "p1": 0.01, "p2": 0.01, "aspect": 0.005}
CENTRE_SHARE = 0.02  # of the width: standard deviation of a principal point
MIN_PHOTOS = 8  # of a camera whose lens is freed
ROUNDS = 4  # of adjustment, noise and blunders
HELD_OUT = 600  # tie points that judge the lens
CAP = 4.0  # times the median error of such a point: a wrong match must not decide
WORSE = 0.01  # relative, of predictions by a lens that is refused
SETTLED = 0.03  # relative change of the noise


@dataclass(frozen=True)
class LensKnowledge:
    """What is known of a camera before its photos are looked at.

    Attributes:
        focal_px: Focal length in the model's pixels; None if it was guessed.
        focal_share: Its relative standard deviation.
        centre: Stated principal point in the model's pixels; None for the middle of the photo.
    """

    focal_px: float | None
    focal_share: float
    centre: tuple[float, float] | None = None


@dataclass(frozen=True)
class LensJudgement:
    """How two lenses predict what their adjustment did not use.

    Attributes:
        simple_px: Error of tie points with focal length and one coefficient free.
        whole_px: The same with the whole lens free.
        simple_m: Error of positions left out, horizontally and in height.
        whole_m: The same.
        taken: Whether the whole lens is used.
    """

    simple_px: float
    whole_px: float
    simple_m: tuple[float, float]
    whole_m: tuple[float, float]
    taken: bool


@dataclass(frozen=True)
class PositionAdjustment:
    """A model adjusted to positions.

    Attributes:
        adjusted: The block of some tie points.
        positions: The positions used.
        names: Of their photos.
        left_out: Photos whose position contradicts the others.
        noise: Of the positions.
        predicted: Errors of the positions predicted by fits without them, metres; NaN where a piece was too small.
        accuracy: By propagation.
        judgement: Of the lens; None where it is held.
        reconstruction: The whole model, in its own frame as before.
        feature_sigma_px: Standard deviation of a tie point's observation.
    """

    adjusted: AdjustedBlock
    positions: StatedPositions
    names: tuple[str, ...]
    left_out: tuple[str, ...]
    noise: PositionNoise
    predicted: Float64[np.ndarray, "k 3"]
    accuracy: BlockAccuracy
    judgement: LensJudgement | None
    reconstruction: pycolmap.Reconstruction
    feature_sigma_px: float

    @property
    def errors(self) -> Float64[np.ndarray, "k 3"]:
        """Adjusted less stated position, the flights' offsets removed, metres."""
        return self.noise.observations(self.positions).errors(self.adjusted.block, self.adjusted.offsets)


def adjust_to_positions(
    reconstruction: pycolmap.Reconstruction,
    world_from_model: Similarity,
    numbers: Sequence[int],
    positions: StatedPositions,
    names: Sequence[str],
    suspects: Bool[np.ndarray, " k"],
    lenses: Mapping[int, LensKnowledge],
    *,
    lenses_held: bool = False,
    poll: Callable[[int, int], None] = lambda done, total: None,
) -> PositionAdjustment:
    """Adjust photos, lenses and tie points to positions.

    Args:
        reconstruction: The model; not modified.
        world_from_model: Its approximate similarity to the world.
        numbers: COLMAP ids of all its photos; positions refer to them by index.
        positions: In the order of capture.
        names: Of the photos with a position, in that order.
        suspects: Positions that a similarity misses by far: used only if the adjusted model agrees with them.
        lenses: By COLMAP camera id.
        lenses_held: Keep the interior orientation fixed.
        poll: Called with what is done and the total of steps.
    """
    table = tie_table(reconstruction, numbers)
    sizes = [(reconstruction.cameras[c].width, reconstruction.cameras[c].height) for c in table.cameras]
    chosen = spread_points(table, sizes)
    counts = {c: table.cameras.count(c) for c in set(table.cameras)}
    poll(1, 6)

    def block_with(which: Bool[np.ndarray, " p"], whole: bool) -> Block:
        def lens_of(camera: pycolmap.Camera) -> Lens:
            known = lenses.get(camera.camera_id, LensKnowledge(None, 0.3))
            few = counts[camera.camera_id] < MIN_PHOTOS
            return prior_lens(camera, known, () if lenses_held else SIMPLE if few or not whole else None)

        return block_of(table.only(which), reconstruction, world_from_model, lens_of, MIN_SIGMA_PX)

    fit = converge(block_with(chosen, True), positions, ~suspects, poll)
    sigma = tie_sigma(fit.adjusted.block)
    if sigma > MIN_SIGMA_PX:
        block = replace(fit.adjusted.block, sigmas=np.full_like(fit.adjusted.block.sigmas, sigma))
        fit = converge(block, positions, fit.kept, poll)
    poll(4, 6)
    judgement = None
    if not lenses_held and any(len(lens.names) > len(SIMPLE) for lens in fit.adjusted.block.lenses):
        simple_block = block_with(chosen, False)
        simple_block = replace(simple_block, sigmas=np.full_like(simple_block.sigmas, sigma))
        simple = BlockFit(adjust_block(simple_block, fit.observed), positions, fit.kept, fit.noise)
        judgement = _judged(simple, fit, table, chosen, reconstruction, world_from_model)
        if not judgement.taken:
            fit = converge(simple.adjusted.block, positions, fit.kept, poll)
    poll(5, 6)
    kept = positions.only(fit.kept)
    whole = _whole_model(reconstruction, table, fit.adjusted.block, world_from_model)
    left_out = tuple(sorted(name for name, used in zip(names, fit.kept.tolist(), strict=True) if not used))
    return PositionAdjustment(
        fit.adjusted,
        kept,
        tuple(name for name, used in zip(names, fit.kept.tolist(), strict=True) if used),
        left_out,
        fit.noise,
        fit.predicted(),
        accuracy_of(fit.adjusted, fit.observed),
        judgement,
        whole,
        sigma,
    )


def prior_lens(camera: pycolmap.Camera, known: LensKnowledge, names: tuple[str, ...] | None) -> Lens:
    """A camera's lens with the priors of what is known.

    Args:
        camera: Of a wide model, or of one that calibration does not know, whose lens is held.
        known: Before its photos were looked at.
        names: The free parameters; None for all.
    """
    if not is_known(camera.model_name):
        return free_lens(camera, (), {}, {})
    if names is None:
        names = ALL if camera.model_name == WIDE else ALL_FISHEYE
    mean = dict.fromkeys(("k2", "k3", "k4", "p1", "p2", "aspect"), 0.0)
    mean |= {"cx": 0.5 * camera.width, "cy": 0.5 * camera.height, "k1": float(camera.params[4])}
    if known.centre is not None:
        mean |= {"cx": known.centre[0], "cy": known.centre[1]}
    share = CENTRE_SHARE * camera.width
    sigmas = {**WEAK, "cx": share, "cy": share}
    if known.focal_px is not None:
        mean["f"] = known.focal_px
        sigmas["f"] = known.focal_share * known.focal_px
    else:
        sigmas["f"] = known.focal_share * float(camera.params[0])
    return free_lens(camera, names, mean, sigmas)


def tie_sigma(block: Block) -> float:
    """Standard deviation of a tie point's observation, pixels: at least one, wider where neighbours share errors.

    Where the errors of a photo's cells do not average out as independent ones would, each observation is worth less.
    """
    errors = image_errors(block)
    sound = np.isfinite(errors).all(axis=1)
    unknowns = 3 * len(block.points) + block.unknowns
    degrees = max(2 * int(sound.sum()) - unknowns, 1)
    own = float((errors[sound] ** 2).sum()) / degrees
    size = np.array([[lens.camera.width, lens.camera.height] for lens in block.lenses])[block.lens_of[block.photo]]
    cell = np.clip((CELLS * block.pixels / size).astype(np.int64), 0, CELLS - 1)
    place = ((block.photo * CELLS + cell[:, 1]) * CELLS + cell[:, 0])[sound]
    count = np.bincount(place)
    sums = np.stack([np.bincount(place, weights=errors[sound, axis]) for axis in range(2)])
    full = count >= 2
    shared = float((sums[:, full] ** 2 / count[full]).sum()) / max(2 * int(full.sum()), 1)
    return max(MIN_SIGMA_PX, max(own, shared) ** 0.5)


@dataclass(frozen=True)
class BlockFit:
    """A block, the positions it uses, and their noise."""

    adjusted: AdjustedBlock
    positions: StatedPositions
    kept: Bool[np.ndarray, " k"]
    noise: PositionNoise

    @property
    def observed(self) -> PositionObservations:
        """The positions used, with their noise."""
        return self.noise.observations(self.positions.only(self.kept))

    def predicted(self) -> Float64[np.ndarray, "k 3"]:
        """Errors of the positions used, each predicted without the pieces of strips that it belongs to."""
        used = self.positions.only(self.kept)
        system = centre_system(self.adjusted.reduced, len(self.adjusted.block))
        return predicted_errors(system, self.adjusted.block, used, self.noise, strip_pieces(used))


def converge(
    block: Block,
    positions: StatedPositions,
    kept: Bool[np.ndarray, " k"],
    poll: Callable[[int, int], None] = lambda done, total: None,
) -> BlockFit:
    """Adjust, look for blunders and estimate the noise until nothing changes.

    Args:
        block: Near the solution.
        positions: All positions.
        kept: Those used at first.
        poll: As for ``adjust_to_positions``.
    """
    noise = as_stated(positions.only(kept))
    offsets = None
    adjusted = adjust_block(block, noise.observations(positions.only(kept)), offsets)
    for done in range(ROUNDS):
        poll(min(2 + done, 4), 6)
        system = centre_system(adjusted.reduced, len(adjusted.block))
        plain = as_stated(positions)
        found = ~find_blunders(system, adjusted.block, positions, plain)
        if found.sum() >= 3:
            kept = found
        used = positions.only(kept)
        before, noise = noise, estimate_noise(system, adjusted.block, adjusted.offsets, used)
        adjusted = adjust_block(adjusted.block, noise.observations(used), adjusted.offsets)
        same = before.factors.shape == noise.factors.shape and len(before.of) == len(noise.of)
        if same and np.abs(before.factors / noise.factors - 1.0).max() < SETTLED:
            break
    return BlockFit(adjusted, positions, kept, noise)


def _judged(
    simple: BlockFit,
    whole: BlockFit,
    table: TieTable,
    chosen: Bool[np.ndarray, " p"],
    reconstruction: pycolmap.Reconstruction,
    world_from_model: Similarity,
) -> LensJudgement:
    """Compare two lenses on tie points and positions that their adjustments did not use."""
    views = np.bincount(table.point, minlength=len(table.ids))
    others = np.flatnonzero(~chosen & (views >= 3))
    picked = np.zeros(len(table.ids), dtype=bool)
    picked[others[:: max(1, len(others) // HELD_OUT)]] = True
    errors = []
    for fit in (simple, whole):
        block = _observing(table.only(picked), fit.adjusted.block, reconstruction, world_from_model)
        size = np.linalg.norm(image_errors(intersected(block)), axis=1)
        errors.append(np.where(np.isfinite(size), size, np.inf))
    cap = CAP * float(np.median(np.minimum(*errors))) if picked.any() else 0.0
    px = [float(np.sqrt((np.minimum(each, cap) ** 2).mean())) if picked.any() else 0.0 for each in errors]
    metres = [_two(fit.predicted()) for fit in (simple, whole)]
    worse = px[1] > (1.0 + WORSE) * px[0] and max(metres[1]) > (1.0 + WORSE) * max(metres[0])
    return LensJudgement(px[0], px[1], metres[0], metres[1], not worse)


def _two(errors: Float64[np.ndarray, "k 3"]) -> tuple[float, float]:
    """Root mean square along a horizontal axis and in height."""
    squares = np.nanmean(errors**2, axis=0)
    return float(np.sqrt(squares[:2].mean())), float(np.sqrt(squares[2]))


def _observing(
    table: TieTable, block: Block, reconstruction: pycolmap.Reconstruction, world_from_model: Similarity
) -> Block:
    """A block's photos with other tie points."""
    del reconstruction
    place = world_from_model.apply(table.points)
    return replace(
        block,
        points=place,
        photo=table.photo,
        point=table.point,
        pixels=table.pixels,
        sigmas=np.full(len(table.photo), float(block.sigmas.mean())),
        stated=place,
        weights=np.zeros_like(place),
    )


def _whole_model(
    reconstruction: pycolmap.Reconstruction, table: TieTable, block: Block, world_from_model: Similarity
) -> pycolmap.Reconstruction:
    """Return the whole model with a block's photos and lenses and all points placed anew, in the model's own frame."""
    every = settle_points(intersected(_observing(table, block, reconstruction, world_from_model)))
    back = world_from_model.inverse()
    result = pycolmap.Reconstruction(reconstruction)
    used = sorted(set(table.cameras))
    for number, lens in zip(used, block.lenses, strict=True):
        camera = result.cameras[number]
        if is_known(lens.camera.model_name):
            names = NAMES[lens.camera.model_name]
            set_lens(camera, lens.camera.model_name, dict(zip(names, map(float, lens.camera.params), strict=True)))
            narrow(camera)
    centres = back.apply(block.centres)
    for place, number in enumerate(table.numbers):
        rotation = block.rotations[place] @ world_from_model.rotation
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centres[place])
        result.images[number].frame.set_cam_from_world(result.images[number].camera_id, pose)
    for number, xyz in zip(table.ids.tolist(), back.apply(every.points), strict=True):
        if np.isfinite(xyz).all():
            result.points3D[number].xyz = xyz
    pycolmap.ObservationManager(result).filter_all_points3D(MAX_ERROR_PX, 0.0)
    result.update_point_3d_errors()
    return result
