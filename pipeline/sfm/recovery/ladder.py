"""Recovery ladder for photos that mapping did not place: registration, joining sub-models, more pairs, more keypoints.

The cheapest rung comes first, and each rung handles only the photos still left. Its result is kept only if it placed
photos without degrading the model: the old photos keep their points, and the reprojection error does not grow.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pycolmap

from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.sfm.capture import MappingInput, MappingResult
from splatpipe.pipeline.sfm.judging.agreement import compare
from splatpipe.pipeline.sfm.mapping.completion import complete, read_correspondences
from splatpipe.pipeline.sfm.mapping.mapping import MappingOptions, incremental_options
from splatpipe.pipeline.sfm.matching.matching import look_alike
from splatpipe.pipeline.sfm.model.pixel_tolerance_scale import pixel_tolerance_scale
from splatpipe.pipeline.sfm.model.structure import (
    Observations,
    cameras_of,
    make_model,
    poses_of,
    read_observations,
    read_structure,
    without,
)
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph, read_verified
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.pairing.pairs import Costs, Pair
from splatpipe.pipeline.sfm.recovery.ladder_growth import MIN_OBSERVATIONS, ModelMapper, mean_error_px, observations
from splatpipe.pipeline.sfm.recovery.ladder_joins import join
from splatpipe.pipeline.sfm.recovery.ladder_keypoints import reextract
from splatpipe.pipeline.sfm.recovery.ladder_pairs import match_more, tried_pairs
from splatpipe.pipeline.sfm.recovery.ladder_partners import PartnersByPhoto, choose_pairs, rank_partners
from splatpipe.pipeline.sfm.recovery.ladder_poses import LARGE_SHARE, MIN_PARTNERS, PoseEstimate, place, sightings

Model: TypeAlias = pycolmap.Reconstruction

PAIRS_A_PHOTO = 20  # as many as `matches` tries per photo
ROUNDS = 4  # registration rounds: newly placed photos add points for the next ones
PARTNERS = 3  # placed photos that also get stronger keypoints, per leftover photo
MAX_STRONGER = 12  # photos extracted again, or the share of all below: costs no more than mapping
MAX_STRONGER_SHARE = 0.125
WEAK_SHARE = 0.5  # keypoints over the placed photos' median, below which a photo is worth extracting again
MIN_KEYPOINTS = 16  # a photo with fewer is blank, blurred or masked
KEPT_OBSERVATIONS = 0.98  # share the old photos must keep: a correctly placed photo takes none away
WORSE_ERROR = 1.05  # the mean reprojection error may grow to this multiple,
WORSE_ERROR_PX = 0.05  # or by this much if that is more


@dataclass(frozen=True)
class LadderContext:
    """Context shared by all rungs."""

    capture: MappingInput
    options: MappingOptions
    report: Reporter
    _correspondences: dict[Path, pycolmap.DatabaseCache] = field(default_factory=dict)  # of one database

    @cached_property
    def alike(self) -> Costs:
        """Costs of pairs by the photos' content."""
        return look_alike(self.capture.features, self.options.seed)

    def mapper(self, database: Path, model: Model) -> ModelMapper:
        """Return COLMAP's mapper on a model, which has the database's keypoints."""
        if database not in self._correspondences:
            self._correspondences.clear()
            self._correspondences[database] = read_correspondences(database)
        return ModelMapper(self._correspondences[database], model, self.options)

    def free_memory(self) -> None:
        """Return to the system what the steps so far needed, before a step that needs much."""
        self._correspondences.clear()
        return_free_heap()

    def report_progress(self, done: int, total: int, what: str) -> None:
        self.report.progress(done, total, what, "photos")


Rung: TypeAlias = Callable[[LadderContext, MappingResult], MappingResult]


def run_ladder(capture: MappingInput, found: MappingResult, config: SparseConfig, report: Reporter) -> MappingResult:
    """Place the photos that mapping did not, where that is certain.

    Args:
        capture: The run's photos.
        found: The result of mapping.
        config: ``ladder``, the seed and the minimum model size.
        report: Receives progress, and how many photos each rung placed.

    Returns:
        An unchanged model if no photo is left or no rung helped; otherwise a larger model, whose view graph may have
        been extended.
    """
    held = any(row.get("focal_held") for row in found.tried if row.get("chosen"))
    wide = pixel_tolerance_scale(found.verified.cameras.values())
    options = MappingOptions(config.seed, config.min_model_size, hold_focal=bool(held), pixel_tolerance_scale=wide)
    work = LadderContext(capture, options, report)
    if not config.ladder:
        return found
    rungs: list[tuple[str, Rung]] = [
        ("registration", register_until_stable),
        ("more pairs", with_more_pairs),
        ("stronger keypoints", with_stronger_keypoints),
    ]
    mapped = found
    for name, rung in rungs:
        if not unplaced(found):
            break
        work.free_memory()
        found = _climb(work, found, name, rung)
    return _completed(work, mapped, found)


def _climb(work: LadderContext, before: MappingResult, name: str, rung: Rung) -> MappingResult:
    """Run one rung, and record what it did."""
    started = time.process_time()
    found = rung(work, before)
    row = {**_row(name, before, found), "cpu_s": round(time.process_time() - started, 2)}
    work.report.note(f"Ladder, {name}: {row['placed']} of {row['left']} remaining photos placed.")
    return replace(found, rungs=(*before.rungs, row))


def _completed(work: LadderContext, mapped: MappingResult, found: MappingResult) -> MappingResult:
    """Adjust everything once to the photos that the rungs placed; the model as mapped if that would be worse."""
    added = set(found.model.reg_image_ids()).difference(mapped.model.reg_image_ids())
    if not added:
        return found
    work.report_progress(len(added), len(added), "adjusting everything")
    work.free_memory()
    before = replace(found, model=mapped.model)
    grown = _adjusted(work, before, found.model, added, everything=True)
    return mapped if grown is before else grown


def unplaced(found: MappingResult) -> list[int]:
    """Return COLMAP's numbers of the photos that are not in the model."""
    placed = set(found.model.reg_image_ids())
    return [number for number in sorted(found.verified.names) if number not in placed]


def register_until_stable(work: LadderContext, found: MappingResult) -> MappingResult:
    """Register single photos and join sub-models, using the existing matches, until neither places more."""
    while True:
        grown = _joined(work, _registered(work, found))
        if grown.model.num_reg_images() == found.model.num_reg_images():
            return grown
        found = grown


def with_more_pairs(work: LadderContext, found: MappingResult) -> MappingResult:
    """Match leftover photos with their likely partners, then place them."""
    left = unplaced(found)
    work.report_progress(0, len(left), "looking for matches of the remaining photos")
    tried = work.capture.tried | tried_pairs(found.database)
    pairs = choose_pairs(rank_partners(work.capture, found, left, work.alike), tried, PAIRS_A_PHOTO)
    if not pairs:
        return found
    work.free_memory()
    database = match_more(work.capture, found.database, pairs, work.options.seed, work.report)
    grown = register_until_stable(work, _on(found, replace(found, database=database, verified=read_verified(database))))
    return grown if len(unplaced(grown)) < len(left) else found


def with_stronger_keypoints(work: LadderContext, found: MappingResult) -> MappingResult:
    """Extract new keypoints in leftover photos and their likely partners, then place them."""
    left = unplaced(found)
    work.report_progress(0, len(left), "looking for matches of the remaining photos")
    partners_by_photo = rank_partners(work.capture, found, left, work.alike)
    photos = _choose_reextraction(
        found, partners_by_photo, max(MAX_STRONGER, int(MAX_STRONGER_SHARE * len(work.capture.photos)))
    )
    pairs = _pairs_among(found, partners_by_photo, photos)
    if not pairs:
        return found
    work.free_memory()
    stronger = reextract(work.capture, found, photos, pairs, work.options.seed, work.report)
    verified = read_verified(stronger.database)
    wider = replace(found, database=stronger.database, verified=verified, colours=stronger.colours)
    wider = _on(found, wider)
    growth = work.mapper(wider.database, wider.model)
    growth.triangulate([number for number in photos if wider.model.exists_image(number)])
    growth.end()
    grown = register_until_stable(work, wider)
    return grown if len(unplaced(grown)) < len(left) else found


def _choose_reextraction(found: MappingResult, partners_by_photo: PartnersByPhoto, most: int) -> list[int]:
    """Choose leftover photos and their likeliest partners, at most ``most``; those with the most matches first.

    A photo with many keypoints but no match with a placed photo is left out: it shows something else.
    """
    placed = set(found.model.reg_image_ids())
    counts = {number: len(places) for number, places in found.verified.keypoints.items()}
    weak = WEAK_SHARE * float(np.median([counts[number] for number in sorted(placed)]))
    matches = {number: 0 for number in partners_by_photo if MIN_KEYPOINTS <= counts[number] < weak}
    for (i, j), rows in found.verified.matches.items():
        for number, other in ((i, j), (j, i)):
            if number in partners_by_photo and other in placed:
                matches[number] = matches.get(number, 0) + len(rows)
    chosen: dict[int, None] = {}
    for photo in sorted(matches, key=lambda number: (-matches[number], number)):
        wanted = [photo, *partners_by_photo[photo][:PARTNERS]]
        if len(wanted) > 1 and len(chosen.keys() | set(wanted)) <= most:
            chosen.update(dict.fromkeys(wanted))
    return sorted(chosen)


def _pairs_among(found: MappingResult, partners_by_photo: PartnersByPhoto, photos: Collection[int]) -> list[Pair]:
    """Return pairs among photos: each leftover photo with its partners, and pairs that already have matches."""
    chosen = set(photos)
    pairs = {pair for pair in found.verified.matches if chosen.issuperset(pair)}
    for photo in chosen & partners_by_photo.keys():
        for partner in partners_by_photo[photo][:PARTNERS]:
            if partner in chosen:
                pairs.add((min(photo, partner), max(photo, partner)))
    return sorted(pairs)


def _on(found: MappingResult, wider: MappingResult) -> MappingResult:
    """Transfer the model to an extended view graph."""
    model = make_model(
        cameras_of(found.model).values(), poses_of(found.model), wider.verified, read_structure(found.model)
    )
    return replace(wider, model=model)


def _registered(work: LadderContext, found: MappingResult) -> MappingResult:
    """Add photos whose pose is certain, in rounds, then adjust and keep those that still hold."""
    model, added = found.model, set[int]()
    for _ in range(ROUNDS):
        left = [number for number in unplaced(found) if number not in added]
        seen = read_observations(model, _partners(found.verified, left).intersection(model.reg_image_ids()))
        placements = _placements(work, found.verified, model, seen, left)
        model = _extended(model, found.verified, seen, placements)
        growth = work.mapper(found.database, model)
        growth.triangulate(sorted(placements))
        fresh = sorted(placements) or growth.place_by_pairs(left)
        growth.end()
        if not fresh:
            break
        added.update(fresh)
    if not added:
        return found
    work.report_progress(len(added), len(unplaced(found)), "adjusting with the newly placed photos")
    return _adjusted(work, found, model, added)


def _partners(verified: ViewGraph, photos: Collection[int]) -> set[int]:
    """Return the photos that have matches with some."""
    asked = set(photos)
    return {number for pair in verified.matches if not asked.isdisjoint(pair) for number in pair}


def _placements(
    work: LadderContext, verified: ViewGraph, model: Model, seen: Observations, left: Collection[int]
) -> dict[int, PoseEstimate]:
    rows = seen.rows({number: len(verified.keypoints[number]) for number in np.unique(seen.photo).tolist()})
    cameras = cameras_of(model)
    placements = {}
    for done, number in enumerate(sorted(left)):
        work.report_progress(done, len(left), "placing the remaining photos")
        camera = verified.camera_of[number]
        placement = place(
            sightings(verified, rows, number),
            verified.keypoints[number],
            seen.points,
            cameras.get(camera, verified.cameras[camera]),
            camera in cameras,
            work.options.seed,
        )
        if placement is not None:
            placements[number] = placement
    return placements


def _extended(model: Model, verified: ViewGraph, seen: Observations, placements: Mapping[int, PoseEstimate]) -> Model:
    """Return a copy of the model with more photos and their observations of its points."""
    grown = pycolmap.Reconstruction(model)
    grown.tear_down()  # COLMAP's global mapper leaves photos and cameras in it that are not placed
    for number, placement in sorted(placements.items()):
        camera = verified.camera_of[number]
        if not grown.exists_camera(camera):
            grown.add_camera_with_trivial_rig(placement.camera)
        image = pycolmap.Image(verified.names[number], verified.keypoints[number].astype(np.float64), camera, number)
        grown.add_image_with_trivial_frame(image, placement.pose)
        for keypoint, row in placement.observations:
            grown.add_observation(int(seen.ids[row]), pycolmap.TrackElement(number, keypoint))
    return grown


def _joined(work: LadderContext, found: MappingResult) -> MappingResult:
    """Join the sub-models that share enough points with the model."""
    remaining = []
    for other in found.others:
        fresh = set(other.reg_image_ids()) - set(found.model.reg_image_ids())
        if not fresh:
            continue
        work.report_progress(0, len(fresh), "joining models")
        model = join(found.model, other, found.verified, work.options.seed)
        if model is None:
            remaining.append(other)
            continue
        growth = work.mapper(found.database, model)
        growth.triangulate(sorted(fresh))
        growth.end()
        grown = _adjusted(work, found, model, sorted(fresh))
        if grown is found:
            remaining.append(other)
        found = grown
    return replace(found, others=tuple(remaining))


def _adjusted(
    work: LadderContext, found: MappingResult, model: Model, added: Collection[int], everything: bool = False
) -> MappingResult:
    """Adjust a model with new photos and drop those whose pose does not hold.

    Args:
        work: The options.
        found: The result before.
        model: The model with the new photos; changed in place.
        added: The new photos.
        everything: Adjust the other photos too, with all of their matches.

    Returns:
        The result with the new model, or ``found`` itself if no new photo holds or the model got worse.
    """
    old = sorted(found.model.reg_image_ids())
    before, error = sum(observations(found.model, old).values()), mean_error_px(found.model)
    kept = sorted(added)
    while True:
        if everything:
            complete(model, found.database, incremental_options(work.options), pycolmap.CancellationToken(), False)
        else:
            growth = work.mapper(found.database, model)
            growth.adjust(kept)
            growth.end()
        bad = _not_held(found.verified, model, kept)
        if not bad:
            break
        kept = [number for number in kept if number not in bad]
        if not kept:
            return found
        model = without(model, bad)
    after, placed = sum(observations(model, old).values()), set(model.reg_image_ids())
    limit = max(WORSE_ERROR * error, error + WORSE_ERROR_PX)
    if not placed.issuperset(old) or after < KEPT_OBSERVATIONS * before or mean_error_px(model) > limit:
        return found
    return replace(found, model=model)


def _not_held(verified: ViewGraph, model: Model, photos: Collection[int]) -> set[int]:
    """Return the photos that lost their points in the adjustment, or whose pose their matches contradict."""
    placed, asked = set(model.reg_image_ids()), set(photos)
    matched = {pair: rows for pair, rows in verified.matches.items() if not asked.isdisjoint(pair)}
    agreement = compare(model, replace(verified, matches=matched))
    matches, explained = dict.fromkeys(photos, 0), dict.fromkeys(photos, 0)
    partners, pairs = dict.fromkeys(photos, 0), dict.fromkeys(photos, 0)
    for row in np.flatnonzero(agreement.placed).tolist():
        for number in agreement.pairs[row].tolist():
            if number in matches:
                pairs[number] += 1
                matches[number] += int(agreement.matches[row])
                explained[number] += int(agreement.explained[row])
                partners[number] += bool(agreement.explained[row] >= LARGE_SHARE * agreement.matches[row])
    bad = set()
    for number in photos:
        few = number not in placed or model.images[number].num_points3D < MIN_OBSERVATIONS
        alone = partners[number] < min(MIN_PARTNERS, pairs[number])
        if few or alone or explained[number] < LARGE_SHARE * matches[number]:
            bad.add(number)
    return bad


def _row(name: str, before: MappingResult, after: MappingResult) -> dict[str, JSON]:
    """Describe what a rung achieved, for ``models.json``."""
    return {
        "rung": name,
        "left": len(unplaced(before)),
        "placed": len(unplaced(before)) - len(unplaced(after)),
        "photos": after.model.num_reg_images(),
        "points": after.model.num_points3D(),
        "points_before": before.model.num_points3D(),
        "verified_pairs_added": len(after.verified.matches) - len(before.verified.matches),
        "keypoints_added": len(after.colours) - len(before.colours),
        "models_joined": len(before.others) - len(after.others),
    }
