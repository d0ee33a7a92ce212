"""Estimate cameras from the view graph: choose the mapper, and the better of two models."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import pycolmap

from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.sfm.capture import MappingInput, MappingResult
from splatpipe.pipeline.sfm.judging.agreement import compare
from splatpipe.pipeline.sfm.judging.judging import Judgement, judge
from splatpipe.pipeline.sfm.lenses.focal import MAX_UNOBSERVED_DEVIATION, adjust_within, undetermined_sigma
from splatpipe.pipeline.sfm.mapping.completion import complete
from splatpipe.pipeline.sfm.mapping.mapping import MappingOptions, incremental_options, map_global, map_incremental
from splatpipe.pipeline.sfm.model.pixel_tolerance_scale import pixel_tolerance_scale
from splatpipe.pipeline.sfm.model.structure import (
    Structure,
    cameras_of,
    loosely_tied,
    make_model,
    poses_of,
    without,
)
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph, read_verified
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.pairing.pairs import Pair
from splatpipe.pipeline.sfm.recovery.probing import ProbeResult, alike_pairs, is_thin, predicted_pairs, probe
from splatpipe.pipeline.sfm.recovery.refusal import refusal

Model: TypeAlias = pycolmap.Reconstruction
Mapper: TypeAlias = Literal["incremental", "global"]

MIN_SHARE = 0.1  # share of the photos in a model; one of fewer is accidental
MIN_SEEN = 15  # mean points per photo; COLMAP's minimum for a pair
ENOUGH_SHARE = 0.5  # below this share, an attempt with relaxed thresholds is worth its time
MAX_SHARE = 0.85  # below this share the other mapper may do better; above it the ladder places the rest more cheaply
MIN_SCORE_MARGIN = 0.005  # score margin by which a second model must be better to replace the first
MAX_FURTHER_MAPPINGS = 1  # mappings of a doubtful capture
TEXTS = {"bent": "pairs of photos contradict it", "unexplained": "many matches are unexplained"}


@dataclass(frozen=True, eq=False)
class MappingAttempt:
    """Result of one mapping attempt.

    Attributes:
        how: Human-readable description of the attempt.
        mapper: The mapper used.
        options: Its options.
        models: The models, largest first; may be empty.
        judgement: Of the first model; None if there is none.
        cpu_s: CPU time, seconds.
        adjusted: Whether an earlier attempt's cameras were adjusted instead of mapping the photos again.
    """

    how: str
    mapper: Mapper
    options: MappingOptions
    models: list[Model]
    judgement: Judgement | None
    cpu_s: float
    adjusted: bool = False

    @property
    def placed(self) -> int:
        """Number of photos placed in the largest model."""
        return self.models[0].num_reg_images() if self.models else 0


class Reconstructor:
    """Map a capture, more than once if needed, and record every attempt."""

    def __init__(self, capture: MappingInput, config: SparseConfig, report: Reporter) -> None:
        self.capture, self.config, self.report = capture, config, report
        self.database = capture.database
        self.verified = read_verified(capture.database)
        self.tried: list[MappingAttempt] = []
        self.notes: dict[MappingAttempt, str] = {}
        self.further = MAX_FURTHER_MAPPINGS

    def map(self, mapper: Mapper, how: str, **options: bool) -> MappingAttempt:
        """Run one mapper and judge its largest model."""
        began = time.process_time()
        wide = pixel_tolerance_scale(self.verified.cameras.values())
        chosen = replace(
            MappingOptions(self.config.seed, self.config.min_model_size, pixel_tolerance_scale=wide), **options
        )
        work = map_incremental if mapper == "incremental" else map_global
        found = work(self.database, self.capture.scratch, chosen, self.report.progress)
        self.report.progress(len(self.verified.names), len(self.verified.names), "placing photos", "photos")
        models = [model for model in found if _has_points(model)]
        return self._judged(MappingAttempt(how, mapper, chosen, models, None, time.process_time() - began))

    def map_further(self, mapper: Mapper, how: str, **options: bool) -> MappingAttempt:
        """Run one mapper again, which a doubtful capture may do only a few times."""
        self.further -= 1
        return self.map(mapper, how, **options)

    def adjust(self, answer: MappingAttempt, how: str, always: bool = False) -> MappingAttempt:
        """Triangulate all matches anew with the best arrangement of an attempt's cameras, and adjust everything.

        Args:
            answer: The attempt; returned as it is if no other arrangement explains more, unless ``always``.
            how: What this is.
            always: Also for the attempt's own arrangement, when there are new matches.
        """
        better = answer.judgement.better if answer.judgement is not None else {}
        if not better and not always:
            return answer
        began = time.process_time()
        old = answer.models[0]
        poses = poses_of(old) | {number: pycolmap.Rigid3d(pose) for number, pose in better.items()}
        model = make_model(cameras_of(old).values(), poses, self.verified, Structure(np.zeros((0, 3)), []))
        complete(model, self.database, incremental_options(answer.options), pycolmap.CancellationToken(), False)
        took = time.process_time() - began
        models = [model, *answer.models[1:]]
        if not _has_points(model) or model.num_reg_images() < old.num_reg_images():
            return answer
        fresh = replace(answer, how=f"{answer.how}, {how}", models=models, judgement=None, cpu_s=took, adjusted=True)
        return self._judged(fresh)

    def add_note(self, answer: MappingAttempt, text: str) -> None:
        """Say something about an attempt in its row."""
        self.notes[answer] = "; ".join(filter(None, [self.notes.get(answer, ""), text]))

    def _judged(self, answer: MappingAttempt) -> MappingAttempt:
        if answer.models:
            model, *others = answer.models
            while loose := loosely_tied(model):
                model = without(model, loose)
            found = judge(model, self.verified, self.capture.cameras)
            answer = replace(answer, models=[model, *others], judgement=found)
        self.tried.append(answer)
        return answer

    def rows(self, chosen: MappingAttempt) -> tuple[JSON, ...]:
        """Rows describing every attempt, for ``models.json``."""
        return tuple(
            {**_row(answer), "chosen": answer is chosen, "why": self.notes.get(answer, "")} for answer in self.tried
        )


def reconstruct(capture: MappingInput, config: SparseConfig, report: Reporter) -> MappingResult:
    """Estimate the cameras.

    Args:
        capture: The photos and what is known about them.
        config: Selects the mapper; ``auto`` maps incrementally first, then at most once more if the result is doubtful,
            and once more after matching more pairs of a thin view graph.
        report: Receives progress.

    Returns:
        The best model. Its database may have more pairs than the capture's.

    Raises:
        SplatpipeError: If too few photos can be placed.
    """
    work = Reconstructor(capture, config, report)
    answer = _first(work)
    if answer.placed < max(config.min_model_size, math.ceil(MIN_SHARE * len(work.verified.names))):
        raise refusal(answer.placed, config.min_model_size, work.verified, len(capture.tried))
    if config.mapper == "auto":
        answer = _best_attempt(work, _with_new_pairs(work, answer))
    return MappingResult(
        answer.models[0],
        tuple(answer.models[1:]),
        work.database,
        work.verified,
        capture.colours,
        work.rows(answer),
    )


def _first(work: Reconstructor) -> MappingAttempt:
    """Return the best attempt at placing enough photos with the mappers that the configuration allows."""
    mapper: Mapper = "global" if work.config.mapper == "global" else "incremental"
    best = _with_held_focal(work, work.map(mapper, mapper))
    total = len(work.verified.names)
    if work.config.mapper == "auto" and best.placed < MAX_SHARE * total:
        placed = f"{best.placed} of {total} photos placed" if best.placed else "no photo was placed"
        work.notes[best] = f"doubtful: {placed}"
        again = work.map if best.placed < ENOUGH_SHARE * total else work.map_further  # so few are no doubtful model yet
        best = _better(best, _with_held_focal(work, again("global", "global")))
    if best.placed < ENOUGH_SHARE * total and work.config.mapper != "global":
        best = _better(best, work.map("incremental", "incremental, relaxed thresholds", relaxed=True))
    return best


def _best_attempt(work: Reconstructor, answer: MappingAttempt) -> MappingAttempt:
    """Return the attempt with its cameras rearranged if that explains more, or a better one of the other mapper."""
    answer = _better(answer, work.adjust(answer, "rearranged"))
    doubts = _doubts(answer)
    if doubts and work.further and answer.mapper != "global":
        work.add_note(answer, f"doubtful: {'; '.join(doubts)}")
        answer = _better(answer, work.map_further("global", "global"))
    return answer


def _doubts(answer: MappingAttempt) -> list[str]:
    """Return the reasons for also trying the other mapper, if that can win: not where no arrangement explains more."""
    if answer.judgement is None:
        return ["no photo was placed"]
    found = ["the focal length diverged"] if any(it.kind == "focal" for it in answer.judgement.reasons) else []
    if answer.judgement.reachable > answer.judgement.score + MIN_SCORE_MARGIN:
        found += sorted({TEXTS[it.kind] for it in answer.judgement.reasons if it.kind in TEXTS})
    return found


def _better(first: MappingAttempt, second: MappingAttempt) -> MappingAttempt:
    """Return the better of two attempts: the first unless the second is clearly better."""
    if second.judgement is None or first.judgement is None:
        return first if second.judgement is None else second
    bad = first.judgement.level == "bad", second.judgement.level == "bad"
    if bad[0] != bad[1]:
        return second if bad[0] else first
    return second if second.judgement.score > first.judgement.score + MIN_SCORE_MARGIN else first


def _with_new_pairs(work: Reconstructor, answer: MappingAttempt) -> MappingAttempt:
    """Match more pairs where the model is uncertain or the graph thin, and map again if it was.

    Returns the given attempt, or a better one from the extended graph.
    """
    thin, mapped = is_thin(answer.models[0], work.verified), False
    if thin:
        alike = alike_pairs(work.capture, (work.database, work.verified), work.config.seed)
        if _add_pairs(work, answer, "pairs that look alike", alike).held:
            answer, mapped = _mapped_with_more_pairs(work, answer), True
    elif not _unsure(answer, work.verified):
        return answer
    graph = work.database, work.verified
    found = _add_pairs(work, answer, "predicted pairs", predicted_pairs(work.capture, answer.models[0], graph, thin))
    if not thin:
        return _rejudge(work, answer) if found.contradicting else answer
    if not found.held:
        return answer
    return _adjusted_to_predictions(work, answer, graph) if mapped else _mapped_with_more_pairs(work, answer)


def _adjusted_to_predictions(
    work: Reconstructor, answer: MappingAttempt, graph: tuple[Path, ViewGraph]
) -> MappingAttempt:
    """Return the attempt adjusted to the pairs that it predicted, unless the others then agree less.

    What a model predicts tends to confirm it, or what it becomes: where a pattern repeats, photos in the wrong place
    match their neighbours there, too. So such pairs are left out again if the others, of ``graph``, contradict them.
    """
    answer = _rejudge(work, answer)
    grown = work.adjust(answer, "with more pairs", always=True)
    before, after = (compare(attempt.models[0], graph[1]).score for attempt in (answer, grown))
    if after >= before - MIN_SCORE_MARGIN:
        return _better(grown, answer)
    work.add_note(grown, "the pairs that were not predicted contradict it")
    work.database, work.verified = graph
    return _rejudge(work, answer)


def _add_pairs(work: Reconstructor, answer: MappingAttempt, what: str, pairs: Sequence[Pair]) -> ProbeResult:
    """Match pairs, go on with the graph that they extend, and note what they say of an attempt."""
    graph = work.database, work.verified
    found = probe(work.capture, answer.models[0], graph, pairs, work.config.seed, work.report)
    work.database, work.verified = found.database, found.verified
    if found.held:
        text = f"{found.held} of {found.tried} {what} were verified, {found.contradicting} contradict it"
        work.add_note(answer, text)
    return found


def _mapped_with_more_pairs(work: Reconstructor, answer: MappingAttempt) -> MappingAttempt:
    """Return the attempt, or a better one by the same mapper from the graph as it is now."""
    answer = _rejudge(work, answer)
    work.further += 1
    return _better(work.map_further(answer.mapper, f"{answer.mapper}, with more pairs"), answer)


def _unsure(answer: MappingAttempt, verified: ViewGraph) -> bool:
    """Whether a model lacks a prior focal length, or is judged less than good."""
    known = all(verified.cameras[number].has_prior_focal_length for number in _used(answer.models[0]))
    return not known or (answer.judgement is not None and answer.judgement.level != "good")


def _rejudge(work: Reconstructor, answer: MappingAttempt) -> MappingAttempt:
    """Judge an attempt's largest model again, against the current view graph."""
    judgement = judge(answer.models[0], work.verified, work.capture.cameras)
    fresh = replace(answer, judgement=judgement)
    work.tried[work.tried.index(answer)] = fresh
    work.notes[fresh] = work.notes.pop(answer, "")
    return fresh


def _with_held_focal(work: Reconstructor, answer: MappingAttempt) -> MappingAttempt:
    """Return the attempt, or one with the focal length held near its prior if it strayed from that without need.

    That is where the photos do not determine it, or where the judge doubts it; the held focal length has to explain the
    matches just as well.
    """
    enough = answer.placed >= ENOUGH_SHARE * len(work.verified.names)  # a small model says nothing about the lens
    if not enough or not work.further or not _focal_in_doubt(answer, work.verified.cameras):
        return answer
    held = work.map_further(answer.mapper, f"{answer.how}, focal length held", hold_focal=True)
    if held.placed < answer.placed:
        return answer
    model, priors = held.models[0], work.verified.cameras
    adjust_within(
        model, {number: priors[number].mean_focal_length() for number in _used(model)}, MAX_UNOBSERVED_DEVIATION
    )
    held = _rejudge(work, held)
    if held.judgement is None or answer.judgement is None:
        return answer
    return held if held.judgement.score >= answer.judgement.score - MIN_SCORE_MARGIN else answer


def _row(answer: MappingAttempt) -> dict[str, JSON]:
    row: dict[str, JSON] = {
        "mapper": answer.mapper,
        "how": answer.how,
        "placed": answer.placed,
        "adjusted": answer.adjusted,
        "focal_held": answer.options.hold_focal,
        "cpu_s": round(answer.cpu_s, 1),
    }
    if answer.judgement is None:
        return row
    model, judgement = answer.models[0], answer.judgement
    return {
        **row,
        "points3d": model.num_points3D(),
        "error_px": round(model.compute_mean_reprojection_error(), 3),
        "focal_px": [round(camera.mean_focal_length(), 1) for _, camera in sorted(model.cameras.items())],
        "explained": round(judgement.explained, 4),
        "held_out": round(judgement.held_out, 4),
        "contradicted": [judgement.contradicted, judgement.pairs],
        "score": round(judgement.score, 4),
        "level": judgement.level,
    }


def _has_points(model: Model) -> bool:
    """Whether a model's photos observe enough points; photos taken from one spot are placed without any."""
    return bool(model.compute_num_observations() >= MIN_SEEN * model.num_reg_images())


def _focal_in_doubt(answer: MappingAttempt, priors: Mapping[int, pycolmap.Camera]) -> bool:
    """Whether a focal length left its prior, and the photos do not determine it or the judge doubts it."""
    model = answer.models[0]
    used = _used(model)
    strayed = [
        number for number in used if _focal_deviation(model.cameras[number], priors[number]) >= MAX_UNOBSERVED_DEVIATION
    ]
    if not strayed or not all(priors[number].has_prior_focal_length for number in used):
        return False
    if answer.judgement is not None and any(reason.kind == "focal" for reason in answer.judgement.reasons):
        return True
    return undetermined_sigma(model, strayed) > 0.0


def _used(model: Model) -> list[int]:
    """Ids of the placed photos' cameras, sorted."""
    return sorted({model.images[number].camera_id for number in model.reg_image_ids()})


def _focal_deviation(camera: pycolmap.Camera, prior: pycolmap.Camera) -> float:
    return float(abs(camera.mean_focal_length() / prior.mean_focal_length() - 1.0))
