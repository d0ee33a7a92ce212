"""A ladder for photos that mapping left: registration, joined sub-models, more pairs, stronger keypoints.

The cheapest rung comes first, and a rung works for what is still left alone. It is kept only where it placed photos and
the model is not worse for it: its own photos keep their points, and the error does not grow.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import pycolmap

from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.sfm.agreement import compare
from splatpipe.pipeline.sfm.capture import MappingInput, MappingResult
from splatpipe.pipeline.sfm.coarseness import coarseness
from splatpipe.pipeline.sfm.completion import complete
from splatpipe.pipeline.sfm.ladder_growth import LEAST_OBSERVATIONS, ModelMapper, mean_error_px, observations
from splatpipe.pipeline.sfm.ladder_joins import join
from splatpipe.pipeline.sfm.ladder_keypoints import strengthen
from splatpipe.pipeline.sfm.ladder_pairs import match_more, tried_pairs
from splatpipe.pipeline.sfm.ladder_partners import Ranked, choose_pairs, rank_partners
from splatpipe.pipeline.sfm.ladder_poses import LARGE_SHARE, LEAST_PARTNERS, PoseEstimate, place, sightings
from splatpipe.pipeline.sfm.mapping import MappingOptions, incremental_options
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.pairs import Pair
from splatpipe.pipeline.sfm.structure import (
    Structure,
    cameras_of,
    make_model,
    poses_of,
    read_structure,
)
from splatpipe.pipeline.sfm.view_graph import ViewGraph, read_verified

Model: TypeAlias = pycolmap.Reconstruction

PAIRS_A_PHOTO = 20  # as many as `matches` tries for each
ROUNDS = 4  # of registration: photos that were just placed bring points for the next
PARTNERS = 3  # placed photos that get stronger keypoints, too, for each that is left
MOST_STRONGER = 12  # photos looked at again, or a share of all: no more than mapping costs
MOST_STRONGER_SHARE = 0.125
WEAK_SHARE = 0.5  # of the placed photos' median keypoints; fewer are worth another look
LEAST_KEYPOINTS = 16  # a photo with fewer is blank, blurred or masked
KEPT_OBSERVATIONS = 0.98  # of the photos that were there before: a right photo takes none away
WORSE_ERROR = 1.05  # times the mean reprojection error before, and
WORSE_ERROR_PX = 0.05  # more than it


@dataclass(frozen=True)
class LadderContext:
    """What all rungs share."""

    capture: MappingInput
    options: MappingOptions
    report: Reporter

    def tell(self, done: int, total: int, what: str) -> None:
        self.report.progress(done, total, what, "photos")


def climb(capture: MappingInput, found: MappingResult, config: SparseConfig, report: Reporter) -> MappingResult:
    """Place photos that mapping left, as far as that is sure.

    Args:
        capture: The run's photos.
        found: What mapping gave.
        config: ``ladder`` and the seed.
        report: Told of progress and of each rung's cost.

    Returns:
        The same where nothing is left or nothing helped; else a larger model, perhaps on a view graph that has grown.
    """
    held = any(row.get("focal_held") for row in found.tried if row.get("chosen"))
    wide = coarseness(found.verified.cameras.values())
    options = MappingOptions(config.seed, config.min_model_size, hold_focal=bool(held), coarseness=wide)
    work = LadderContext(capture, options, report)
    if not config.ladder:
        return found
    rungs: list[tuple[str, Callable[[LadderContext, MappingResult], MappingResult]]] = [
        ("registration", settle),
        ("more pairs", with_more_pairs),
        ("stronger keypoints", with_stronger_keypoints),
    ]
    for name, rung in rungs:
        left = unplaced(found)
        if not left:
            break
        started = time.process_time()
        before = found
        found = rung(work, found)
        cpu_s = time.process_time() - started
        gained = len(left) - len(unplaced(found))
        report.note(f"Ladder, {name}: {gained} of {len(left)} remaining photos placed.")
        found = replace(found, rungs=(*before.rungs, {**_row(name, before, found), "cpu_s": round(cpu_s, 2)}))
    return found


def unplaced(found: MappingResult) -> list[int]:
    """COLMAP's numbers of photos that the model lacks."""
    placed = set(found.model.reg_image_ids())
    return [number for number in sorted(found.verified.names) if number not in placed]


def settle(work: LadderContext, found: MappingResult) -> MappingResult:
    """Register single photos and join sub-models until neither helps, each on what is there."""
    while True:
        grown = _joined(work, _registered(work, found))
        if grown.model.num_reg_images() == found.model.num_reg_images():
            return grown
        found = grown


def with_more_pairs(work: LadderContext, found: MappingResult) -> MappingResult:
    """Match photos that are left with others that may show the same, then place them."""
    left = unplaced(found)
    work.tell(0, len(left), "looking for matches of the remaining photos")
    tried = work.capture.tried | tried_pairs(found.database)
    pairs = choose_pairs(rank_partners(work.capture, found, left, work.options.seed), tried, PAIRS_A_PHOTO)
    if not pairs:
        return found
    database = match_more(work.capture, found.database, pairs, work.options.seed, work.report)
    grown = settle(work, _on(found, replace(found, database=database, verified=read_verified(database))))
    return grown if len(unplaced(grown)) < len(left) else found


def with_stronger_keypoints(work: LadderContext, found: MappingResult) -> MappingResult:
    """Find new keypoints in photos that are left and in those that may show the same, then place them."""
    left = unplaced(found)
    work.tell(0, len(left), "looking for matches of the remaining photos")
    ranked = rank_partners(work.capture, found, left, work.options.seed)
    photos = _worth_another_look(found, ranked, max(MOST_STRONGER, int(MOST_STRONGER_SHARE * len(work.capture.photos))))
    pairs = _among(found, ranked, photos)
    if not pairs:
        return found
    stronger = strengthen(work.capture, found, photos, pairs, work.options.seed, work.report)
    verified = read_verified(stronger.database)
    wider = replace(found, database=stronger.database, verified=verified, colours=stronger.colours)
    wider = _on(found, wider)
    growth = ModelMapper(wider.database, wider.model, work.options)
    growth.triangulate([number for number in photos if wider.model.exists_image(number)])
    growth.end()
    grown = settle(work, wider)
    return grown if len(unplaced(grown)) < len(left) else found


def _worth_another_look(found: MappingResult, ranked: Ranked, most: int) -> list[int]:
    """Photos that are left and their likeliest partners, as many as may be; those with the most matches first.

    One that has plenty of keypoints and yet no match with what is placed shows something else.
    """
    placed = set(found.model.reg_image_ids())
    counts = {number: len(places) for number, places in found.verified.keypoints.items()}
    weak = WEAK_SHARE * float(np.median([counts[number] for number in sorted(placed)]))
    matches = {number: 0 for number in ranked if LEAST_KEYPOINTS <= counts[number] < weak}
    for (i, j), rows in found.verified.matches.items():
        for number, other in ((i, j), (j, i)):
            if number in ranked and other in placed:
                matches[number] = matches.get(number, 0) + len(rows)
    chosen: dict[int, None] = {}
    for photo in sorted(matches, key=lambda number: (-matches[number], number)):
        wanted = [photo, *ranked[photo][:PARTNERS]]
        if len(wanted) > 1 and len(chosen.keys() | set(wanted)) <= most:
            chosen.update(dict.fromkeys(wanted))
    return sorted(chosen)


def _among(found: MappingResult, ranked: Ranked, photos: Collection[int]) -> list[Pair]:
    """Pairs among photos: each that is left with its partners, and those that share matches already."""
    chosen = set(photos)
    pairs = {pair for pair in found.verified.matches if chosen.issuperset(pair)}
    for photo in chosen & ranked.keys():
        for partner in ranked[photo][:PARTNERS]:
            if partner in chosen:
                pairs.add((min(photo, partner), max(photo, partner)))
    return sorted(pairs)


def _on(found: MappingResult, wider: MappingResult) -> MappingResult:
    """The same model on a view graph that has grown."""
    model = make_model(
        cameras_of(found.model).values(), poses_of(found.model), wider.verified, read_structure(found.model)
    )
    return replace(wider, model=model)


def _registered(work: LadderContext, found: MappingResult) -> MappingResult:
    """Add photos whose pose is sure, round after round, then adjust; all or nothing of what is still sure then."""
    model, added = found.model, set[int]()
    for _ in range(ROUNDS):
        left = [number for number in unplaced(found) if number not in added]
        placements = _placements(work, found.verified, model, left)
        model = _extended(model, found.verified, placements) if placements else pycolmap.Reconstruction(model)
        growth = ModelMapper(found.database, model, work.options)
        growth.triangulate(sorted(placements))
        fresh = sorted(placements) or growth.place_by_pairs(left)
        growth.end()
        if not fresh:
            break
        added.update(fresh)
    if not added:
        return found
    work.tell(len(added), len(unplaced(found)), "adjusting with the newly placed photos")
    return _adjusted(work, found, model, added)


def _placements(
    work: LadderContext, verified: ViewGraph, model: Model, left: Collection[int]
) -> dict[int, PoseEstimate]:
    structure = read_structure(model)
    counts = {number: len(verified.keypoints[number]) for number in model.reg_image_ids()}
    rows = structure.rows(counts)
    cameras = cameras_of(model)
    placements = {}
    for done, number in enumerate(sorted(left)):
        work.tell(done, len(left), "placing the remaining photos")
        camera = verified.camera_of[number]
        placement = place(
            sightings(verified, rows, number),
            verified.keypoints[number],
            structure.points,
            cameras.get(camera, verified.cameras[camera]),
            camera in cameras,
            work.options.seed,
        )
        if placement is not None:
            placements[number] = placement
    return placements


def _extended(model: Model, verified: ViewGraph, placements: Mapping[int, PoseEstimate]) -> Model:
    """A model with more photos, and with what they see of its points."""
    structure = read_structure(model)
    tracks = [list(track) for track in structure.tracks]
    cameras = cameras_of(model)
    poses = poses_of(model)
    for number, placement in sorted(placements.items()):
        poses[number] = placement.pose
        cameras.setdefault(verified.camera_of[number], placement.camera)
        for keypoint, row in placement.observations:
            tracks[row].append((number, keypoint))
    ordered = Structure(structure.points, [sorted(track) for track in tracks])
    return make_model(cameras.values(), poses, verified, ordered)


def _joined(work: LadderContext, found: MappingResult) -> MappingResult:
    """Join the other models that share enough with this one."""
    remaining = []
    for other in found.others:
        fresh = set(other.reg_image_ids()) - set(found.model.reg_image_ids())
        if not fresh:
            continue
        work.tell(0, len(fresh), "joining models")
        model = join(found.model, other, found.verified, work.options.seed)
        if model is None:
            remaining.append(other)
            continue
        growth = ModelMapper(found.database, model, work.options)
        growth.triangulate(sorted(fresh))
        growth.end()
        grown = _adjusted(work, found, model, sorted(fresh))
        if grown is found:
            remaining.append(other)
        found = grown
    return replace(found, others=tuple(remaining))


def _adjusted(work: LadderContext, found: MappingResult, model: Model, added: Collection[int]) -> MappingResult:
    """Adjust a model with new photos and drop those that do not hold; the old one where nothing does or it was better.

    Args:
        work: The options.
        found: Before.
        model: With the new photos; changed in place.
        added: The new photos.
    """
    old = sorted(found.model.reg_image_ids())
    before, error = sum(observations(found.model, old).values()), mean_error_px(found.model)
    kept = sorted(added)
    while kept:
        complete(model, found.database, incremental_options(work.options), pycolmap.CancellationToken(), False)
        bad = _not_held(found.verified, model, kept)
        if not bad:
            break
        kept = [number for number in kept if number not in bad]
        model = without(model, found.verified, bad)
    after, placed = sum(observations(model, old).values()), set(model.reg_image_ids())
    limit = max(WORSE_ERROR * error, error + WORSE_ERROR_PX)
    if not kept or not placed.issuperset(old) or after < KEPT_OBSERVATIONS * before or mean_error_px(model) > limit:
        return found
    return replace(found, model=model)


def _not_held(verified: ViewGraph, model: Model, photos: Collection[int]) -> set[int]:
    """Which of the photos lost their points in the adjustment, or are where their matches do not agree."""
    placed = set(model.reg_image_ids())
    agreement = compare(model, verified)
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
        few = number not in placed or model.images[number].num_points3D < LEAST_OBSERVATIONS
        alone = partners[number] < min(LEAST_PARTNERS, pairs[number])
        if few or alone or explained[number] < LARGE_SHARE * matches[number]:
            bad.add(number)
    return bad


def without(model: Model, verified: ViewGraph, photos: Collection[int]) -> Model:
    """The same model without some photos and what only they saw."""
    structure = read_structure(model)
    tracks = [[element for element in track if element[0] not in photos] for track in structure.tracks]
    poses = {number: pose for number, pose in poses_of(model).items() if number not in photos}
    used = {verified.camera_of[number] for number in poses}
    cameras = [camera for number, camera in cameras_of(model).items() if number in used]
    return make_model(cameras, poses, verified, Structure(structure.points, tracks))


def _row(name: str, before: MappingResult, after: MappingResult) -> dict[str, JSON]:
    """What a rung brought, for ``models.json``."""
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
