"""Adjust a model to its photos' positions: positions, tie points and lens in one block adjustment.

Photos straight down, mapped without their positions, leave a bowl in the model and a wrong focal length: a similarity
fitted to positions keeps both. Accurate positions (RTK, PPK) remove the bowl, and let the lens be calibrated with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.sfm.lenses.lens_model import PARAMETERS, WIDE, is_known
from splatpipe.pipeline.survey.adjustment.block import Block, part_of, reduce_block
from splatpipe.pipeline.survey.adjustment.block_accuracy import BlockAccuracy, accuracy_of
from splatpipe.pipeline.survey.adjustment.block_adjustment import AdjustedBlock, PositionObservations, adjust_block
from splatpipe.pipeline.survey.adjustment.block_lens import Lens, free_lens
from splatpipe.pipeline.survey.adjustment.position_noise import (
    CentreSystem,
    PositionNoise,
    StatedPositions,
    as_stated,
    centre_system,
    estimate_noise,
    find_blunders,
    noise_with_drift,
    predicted_errors,
    strip_pieces,
    with_drift_of,
)
from splatpipe.pipeline.survey.adjustment.tie_points import (
    MIN_SIGMA_PX,
    TieTable,
    block_of,
    image_errors,
    intersected,
    observing,
    sizes_of,
    spread_points,
    tie_sigma,
    tie_table,
    whole_model,
)

PART_POSITIONS = 200  # positions whose noise is estimated together: the system is dense
SIMPLE = ("f", "k1")
ALL = ("f", "aspect", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
ALL_FISHEYE = ("f", "aspect", "cx", "cy", "k1", "k2", "k3", "k4")
# Standard deviation of a focal length by its source, relative; a guess may be anything.
FOCAL_SHARES = {"lens-file": 0.003, "xmp-dewarp": 0.01, "xmp-calibrated": 0.01, "guess": 0.3}
OTHER_FOCAL_SHARE = 0.03
FOCAL_SHARE = 0.03  # standard deviation of a focal length about its prior, relative, without positions
DISTORTION_SIGMA = 0.2  # standard deviation of a distortion coefficient about its estimate from SfM
FIXED = ("k4", "k5", "k6")  # the denominator of FULL_OPENCV
WEAK = {"k1": 0.3, "k2": 0.3, "k3": 0.3, "k4": 0.3, "p1": 0.01, "p2": 0.01, "aspect": 0.005}
CENTRE_SHARE = 0.02  # standard deviation of a principal point, as a share of the image's width
MIN_PHOTOS = 8  # photos a camera needs for its lens to be freed
MAX_ROUNDS = 4  # rounds of adjustment, noise and blunders
HELD_OUT_POINTS = 600  # tie points that judge the lens
MAX_ERROR_RATIO = 4.0  # error of such a point over the median, at most: a wrong match must not decide
MAX_ERROR_INCREASE = 0.01  # relative increase of prediction errors with which a lens is refused
MIN_RELATIVE_CHANGE = 0.03  # relative change of the noise


def quietly(done: int, total: int) -> None:
    """Report no progress."""


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


UNKNOWN_LENS = LensKnowledge(None, FOCAL_SHARES["guess"])


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
    poll: Callable[[int, int], None] = quietly,
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
    chosen = spread_points(table, sizes_of(table, reconstruction))
    counts = {c: table.cameras.count(c) for c in set(table.cameras)}
    poll(1, 6)

    def block_with(which: Bool[np.ndarray, " p"], whole: bool) -> Block:
        def lens_of(camera: pycolmap.Camera) -> Lens:
            photos = counts[camera.camera_id]
            return lens_with_positions(camera, lenses, photos, held=lenses_held, whole=whole)

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
        judgement = _judged(simple, fit, table, chosen, world_from_model)
        if not judgement.taken:
            fit = converge(simple.adjusted.block, positions, fit.kept, poll)
    poll(5, 6)
    kept = positions.only(fit.kept)
    whole = whole_model(reconstruction, table, fit.adjusted.block, world_from_model)
    left_out = tuple(sorted(name for name, used in zip(names, fit.kept.tolist(), strict=True) if not used))
    return PositionAdjustment(
        fit.adjusted,
        kept,
        tuple(name for name, used in zip(names, fit.kept.tolist(), strict=True) if used),
        left_out,
        fit.noise,
        fit.predicted(),
        accuracy_of(doubted(fit.adjusted, lenses) if lenses_held else fit.adjusted, fit.observed),
        judgement,
        whole,
    )


def lens_with_positions(
    camera: pycolmap.Camera, lenses: Mapping[int, LensKnowledge], photos: int, *, held: bool = False, whole: bool = True
) -> Lens:
    """A camera's lens as accurate positions let it be adjusted: whole, or simple where its photos are few.

    Args:
        camera: Of a wide model.
        lenses: What is known beforehand, by COLMAP camera id.
        photos: Of this camera.
        held: Keep it fixed.
        whole: Free more than a simple lens if the photos are not few.
    """
    names = () if held else SIMPLE if photos < MIN_PHOTOS or not whole else None
    return prior_lens(camera, lenses.get(camera.camera_id, UNKNOWN_LENS), names)


def doubted(adjusted: AdjustedBlock, lenses: Mapping[int, LensKnowledge]) -> AdjustedBlock:
    """The same state for propagation, with held focal lengths as uncertain as what they come from."""
    own = [
        prior_lens(
            lens.camera,
            replace(lenses.get(lens.camera.camera_id, UNKNOWN_LENS), focal_px=float(lens.camera.params[0])),
            ("f",),
        )
        for lens in adjusted.block.lenses
    ]
    block = replace(adjusted.block, lenses=tuple(own))
    return replace(adjusted, block=block, reduced=reduce_block(block))


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


def simple_lens(camera: pycolmap.Camera, own: pycolmap.Camera, known: LensKnowledge, held: bool) -> Lens:
    """A lens with its focal length and the coefficients of its own model free, for photos without accurate positions.

    Args:
        camera: Of a wide model.
        own: The same, of its own model.
        known: Before its photos were looked at.
        held: Keep it fixed.
    """
    if held or not is_known(camera.model_name):
        return free_lens(camera, (), {}, {})
    names = ("f", *(name for name in PARAMETERS[own.model_name] if name.startswith(("k", "p")) and name not in FIXED))
    focal = float(camera.params[0]) if known.focal_px is None else known.focal_px
    return free_lens(
        camera, names, {"f": focal}, {"f": FOCAL_SHARE * focal, **dict.fromkeys(names[1:], DISTORTION_SIGMA)}
    )


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
        result = np.zeros((len(used), 3))
        for part in parts_of(self.adjusted, used):
            noise = replace(self.noise, of=self.noise.of[part.chosen])
            pieces = strip_pieces(part.positions)
            result[part.chosen] = predicted_errors(part.system, part.block, part.positions, noise, pieces)
        return result


@dataclass(frozen=True)
class BlockPart:
    """Part of a block that is small enough for dense statistics.

    Attributes:
        chosen: Which positions it has.
        block: Its photos and points.
        system: What they say of the projection centres.
        positions: Referring to its photos.
    """

    chosen: Bool[np.ndarray, " k"]
    block: Block
    system: CentreSystem
    positions: StatedPositions


def parts_of(adjusted: AdjustedBlock, positions: StatedPositions) -> Iterator[BlockPart]:
    """Cut a block along the order of capture; a small one is its only part."""
    count = max(1, round(len(positions) / PART_POSITIONS))
    if count == 1:
        system = centre_system(adjusted.reduced, len(adjusted.block))
        yield BlockPart(np.ones(len(positions), dtype=bool), adjusted.block, system, positions)
        return
    for chosen in np.array_split(np.arange(len(positions)), count):
        inside = np.zeros(len(positions), dtype=bool)
        inside[chosen] = True
        photos = np.zeros(len(adjusted.block), dtype=bool)
        photos[positions.photo[inside]] = True
        block, mine = part_of(adjusted.block, photos), positions.only(inside)
        mine = replace(mine, photo=(np.cumsum(photos) - 1)[mine.photo])
        yield BlockPart(inside, block, centre_system(reduce_block(block), len(block)), mine)


def converge(
    block: Block,
    positions: StatedPositions,
    kept: Bool[np.ndarray, " k"],
    poll: Callable[[int, int], None] = quietly,
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
    for done in range(MAX_ROUNDS):
        poll(min(2 + done, 4), 6)
        found = np.ones(len(positions), dtype=bool)
        for part in parts_of(adjusted, positions):
            plain = as_stated(part.positions)
            found[part.chosen] = ~find_blunders(part.system, part.block, part.positions, plain)
        if found.sum() >= 3:
            kept = found
        used = positions.only(kept)
        before, noise = noise, _noise_of(adjusted, used)
        adjusted = adjust_block(adjusted.block, noise.observations(used), adjusted.offsets)
        same = before.factors.shape == noise.factors.shape and len(before.of) == len(noise.of)
        if same and np.abs(before.factors / noise.factors - 1.0).max() < MIN_RELATIVE_CHANGE:
            break
    return BlockFit(adjusted, positions, kept, noise)


def _noise_of(adjusted: AdjustedBlock, positions: StatedPositions) -> PositionNoise:
    """The noise of all positions; of very many, the drift is that of the part in the middle."""
    parts = list(parts_of(adjusted, positions))
    middle = parts[len(parts) // 2]
    noise = estimate_noise(middle.system, middle.block, middle.positions)
    if len(parts) == 1:
        return noise
    every = as_stated(positions)
    factors, weights = np.zeros_like(every.factors), np.zeros(len(every.classes))
    for part in parts:
        found = noise if part is middle else noise_with_drift(part.system, part.block, part.positions, noise)
        for own, name in enumerate(found.classes):
            at = every.classes.index(name) if name in every.classes else len(every.classes) - 1
            count = float((found.of == own).sum())
            factors[at] += count * found.factors[own] ** 2
            weights[at] += count
    mean = np.sqrt(np.where(weights[:, None] > 0.0, factors / np.maximum(weights, 1.0)[:, None], 1.0))
    return with_drift_of(replace(every, factors=mean), noise)


def _judged(
    simple: BlockFit,
    whole: BlockFit,
    table: TieTable,
    chosen: Bool[np.ndarray, " p"],
    world_from_model: Similarity,
) -> LensJudgement:
    """Compare two lenses on tie points and positions that their adjustments did not use."""
    views = np.bincount(table.point, minlength=len(table.ids))
    others = np.flatnonzero(~chosen & (views >= 3))
    picked = np.zeros(len(table.ids), dtype=bool)
    picked[others[:: max(1, len(others) // HELD_OUT_POINTS)]] = True
    errors = []
    for fit in (simple, whole):
        block = observing(table.only(picked), fit.adjusted.block, world_from_model)
        size = np.linalg.norm(image_errors(intersected(block)), axis=1)
        errors.append(np.where(np.isfinite(size), size, np.inf))
    cap = MAX_ERROR_RATIO * float(np.median(np.minimum(*errors))) if picked.any() else 0.0
    px = [float(np.sqrt((np.minimum(each, cap) ** 2).mean())) if picked.any() else 0.0 for each in errors]
    metres = [_two(fit.predicted()) for fit in (simple, whole)]
    worse = px[1] > (1.0 + MAX_ERROR_INCREASE) * px[0] and max(metres[1]) > (1.0 + MAX_ERROR_INCREASE) * max(metres[0])
    return LensJudgement(px[0], px[1], metres[0], metres[1], not worse)


def _two(errors: Float64[np.ndarray, "k 3"]) -> tuple[float, float]:
    """Root mean square along a horizontal axis and in height."""
    squares = np.nanmean(errors**2, axis=0)
    return float(np.sqrt(squares[:2].mean())), float(np.sqrt(squares[2]))
