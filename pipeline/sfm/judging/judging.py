"""Judge whether the estimated cameras are right, by the model itself and not by how it was obtained.

The evidence is what was not used to build the model: all verified matches (``agreement``), the metadata's focal
lengths where they can be trusted, and simple shares of the photos. A bent or ghosted model is known by another
arrangement of its cameras that explains clearly more of the matches (``rearrangement``). Pairs that contradict the best
arrangement are wrong matches: windows, tiles and wallpaper repeat.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.sfm.judging.agreement import Agreement, compare, contradicting, rays_of
from splatpipe.pipeline.sfm.judging.cuts import find_cut
from splatpipe.pipeline.sfm.judging.rearrangement import Rearrangement, find_better
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph
from splatpipe.pipeline.sfm.pairing.pairs import Pair

Level = Literal["good", "doubt", "bad"]
LEVELS: tuple[Level, ...] = ("good", "doubt", "bad")

PLACED_GOOD, PLACED_DOUBT = 0.95, 0.75  # share of the photos; Pix4D's quality report requires 95 %
TRUSTED_SOURCES = ("xmp-calibrated", "sensor-table", "focal-plane-resolution", "lens-file", "xmp-dewarp")
# A trusted focal length is off by a few per cent (a Phantom's by 0.5, sensor tables by up to 5); a 35 mm equivalent was
# seen 26 % off on a phone, and that of a resized file can be off by even more.
FOCAL_TRUSTED = (0.10, 0.30)  # relative deviation above which the level is doubt, and bad
FOCAL_UNTRUSTED = (0.35, 1.0)  # ratio to an untrusted focal length, less one, above which the level is doubt, and bad
FOCAL_BOUNDS = (0.25, 6.0)  # focal length over the longer side of lenses used for mapping, 127 to 10 degrees
MIN_WRONG_LENS_SHARE = 0.1  # share of the photos below which a wrong lens says nothing about the others
# explained share of the matches among placed photos; sound models have 0.93 or more
EXPLAINED_GOOD, EXPLAINED_DOUBT = 0.85, 0.65
GAIN_DOUBT, GAIN_BAD = 0.01, 0.02  # gain of the score by another arrangement; sound models gain at most 0.002
ALIKE_TIMES = 3.0  # median error of a pair that shows another place, over EXPLAINED_PX; a wrong lens is off by less
FEW_PAIRS = 3  # fewer pairs that look alike are not worth telling
CUT_DOUBT = 1.0  # ratio of contradicting to agreeing matches between two groups of cameras


@dataclass(frozen=True)
class Reason:
    """Evidence against a model.

    Attributes:
        level: Its severity.
        text: The problem in plain words, a whole sentence.
        hint: What to do about it; may be empty.
        kind: Machine-readable kind: ``placed``, ``focal``, ``bent``, ``doubles``,
            ``unexplained``, ``lens``, ``positions``.
    """

    level: Level
    text: str
    hint: str
    kind: str


@dataclass(frozen=True)
class Judgement:
    """Assessment of a model.

    Attributes:
        level: The worst level among the reasons.
        reasons: The worst first.
        score: How many of all verified matches the model explains and how closely, 0 to 1; for comparing two models of
            the same view graph.
        explained: Share of all verified matches that the model explains.
        held_out: The same for matches among placed photos that are not observations of the model.
        contradicted: Number of pairs whose matches the model contradicts.
        pairs: Number of pairs among placed photos.
        alike: Those of the contradicting pairs that look alike without showing the same place, (i, j), i < j.
        reachable: The best arrangement's score.
        better: Poses of another arrangement, camera from world, by image id, if it explains clearly more.
    """

    level: Level
    reasons: tuple[Reason, ...]
    score: float
    explained: float
    held_out: float
    contradicted: int
    pairs: int
    alike: tuple[Pair, ...] = ()
    reachable: float = 0.0
    better: Mapping[int, Float64[np.ndarray, "3 4"]] = field(default_factory=dict)

    def joined(self, more: Sequence[Reason]) -> Judgement:
        """Return a copy with more reasons."""
        reasons = _worst_first([*self.reasons, *more])
        return replace(self, level=reasons[0].level if reasons else "good", reasons=reasons)

    def as_json(self) -> JSON:
        """Return level and reasons for ``models.json``."""
        reasons = [{"level": it.level, "kind": it.kind, "text": it.text, "hint": it.hint} for it in self.reasons]
        return {"level": self.level, "reasons": reasons}


def judge(
    model: pycolmap.Reconstruction, verified: ViewGraph, cameras: Sequence[JSON], placeable: int | None = None
) -> Judgement:
    """Judge a model.

    Args:
        model: In any frame, with the keypoints of ``verified``.
        verified: The view graph.
        cameras: The camera groups of ``ingest.cameras``, for the sources of their focal lengths; COLMAP's ids count
            from 1 in their order.
        placeable: Number of photos on which the share of placed photos is based; defaults to all photos.
    """
    rays = rays_of(model, verified)
    agreement = compare(model, verified, rays=rays)
    found = find_better(model, verified, agreement, rays)
    contradicts = contradicting(agreement)
    clearly = found.agreement.score >= agreement.score + GAIN_DOUBT
    left = contradicting(found.agreement) if clearly else contradicts
    alike = left & (found.agreement.median_px > ALIKE_TIMES * agreement.bounds_px)
    placed = agreement.placed
    reasons = [
        *_placed(model, placeable or len(verified.names)),
        *_focal_lengths(model, verified, cameras),
        *_unexplained(agreement, alike),
        *_bent(agreement, found, verified),
    ]
    return Judgement(
        level="good",
        reasons=(),
        score=agreement.score,
        explained=_share(agreement.explained, agreement.matches),
        held_out=_share(agreement.held_out_explained[placed], agreement.held_out[placed]),
        contradicted=int(contradicts.sum()),
        pairs=int(placed.sum()),
        alike=tuple((int(i), int(j)) for i, j in agreement.pairs[alike]),
        reachable=found.agreement.score,
        better=found.poses if clearly else {},
    ).joined(reasons)


def _worst_first(reasons: Sequence[Reason]) -> tuple[Reason, ...]:
    return tuple(sorted(reasons, key=lambda reason: -LEVELS.index(reason.level)))


def is_trusted(camera: Mapping[str, JSON]) -> bool:
    """Whether a camera group's prior focal length is reliable enough to check a model against."""
    return bool(camera.get("has_prior")) and camera.get("focal_source") in TRUSTED_SOURCES


def _share(part: np.ndarray, whole: np.ndarray) -> float:
    total = float(whole.sum())
    return float(part.sum()) / total if total > 0.0 else 0.0


def _placed(model: pycolmap.Reconstruction, total: int) -> list[Reason]:
    count = model.num_reg_images()
    if count >= PLACED_GOOD * total:
        return []
    level: Level = "doubt" if count >= PLACED_DOUBT * total else "bad"
    text = f"Only {count} of {total} photos could be placed: the areas that only the others show are missing."
    hint = "Look at the photos that were not placed: take more with overlap, or try --set matches.pairing=exhaustive."
    return [Reason(level, text, hint, "placed")]


def _focal_lengths(model: pycolmap.Reconstruction, verified: ViewGraph, cameras: Sequence[JSON]) -> list[Reason]:
    found, ran_away = [], 0
    photos = Counter(model.images[number].camera_id for number in model.reg_image_ids())
    used = sorted(photos)
    for number in used:
        camera, before, group = model.cameras[number], verified.cameras[number], cameras[number - 1]
        focal, prior = camera.mean_focal_length(), before.mean_focal_length()
        which = "The focal length" if len(used) == 1 else f"The focal length of camera {number}"
        ratio = focal / max(camera.width, camera.height)
        stray = max(focal / prior, prior / focal) - 1.0
        doubt, bad = FOCAL_TRUSTED if is_trusted(group) else FOCAL_UNTRUSTED
        hint = (
            "Heights and scale may be off: compare a known one. Oblique photos or a second flying height "
            "constrain the lens better."
        )
        if not FOCAL_BOUNDS[0] <= ratio <= FOCAL_BOUNDS[1]:
            text = (
                f"{which} came out as {focal:.0f} pixels, {ratio:.2g} times the photo's longer side, which is "
                "implausible."
            )
            found.append(Reason("bad", text, hint, "focal"))
            ran_away += photos[number]
        elif before.has_prior_focal_length and stray > doubt:
            text = f"{which} went from {prior:.0f} to {focal:.0f} pixels, {100 * (focal / prior - 1):+.0f} %."
            if not is_trusted(group):
                text += " The value in the metadata is only approximate."
            found.append(Reason("bad" if stray > bad else "doubt", text, hint, "focal"))
            ran_away += photos[number] if stray > bad else 0
    if ran_away < MIN_WRONG_LENS_SHARE * photos.total():
        found = [replace(reason, level="doubt") for reason in found]
    return found


def _unexplained(agreement: Agreement, alike: Bool[np.ndarray, " n"]) -> list[Reason]:
    """Report matches that are not explained, other than those of pairs that only look alike."""
    valid = agreement.placed & ~alike
    share = _share(agreement.explained[valid], agreement.matches[valid])
    if share >= EXPLAINED_GOOD or not valid.any():
        return []
    level: Level = "doubt" if share >= EXPLAINED_DOUBT else "bad"
    text = f"The cameras explain only {100 * share:.0f} % of the matches among the placed photos."
    hint = "Check that all photos have the same lens settings and that the scene did not move."
    return [Reason(level, text, hint, "unexplained")]


def _bent(agreement: Agreement, found: Rearrangement, verified: ViewGraph) -> list[Reason]:
    """Report that another arrangement of the cameras explains clearly more."""
    gain = found.agreement.score - agreement.score
    hint = "Look for duplicated objects in sparse.glb. Add photos that close the loop, or try"
    hint += " --set sparse.mapper=global and --set matches.pairing=exhaustive."
    against = contradicting(agreement)
    if gain < GAIN_DOUBT:
        cut = find_cut(agreement, against)
        if cut.ratio < CUT_DOUBT:
            return []
        text = f"{name_photo_group(cut.group, verified)} match the other photos elsewhere more than where the model "
        text += "has them: the scene repeats itself there, or the model is bent."
        return [Reason("doubt", text, hint, "bent")]
    resolved = int((against & ~contradicting(found.agreement)).sum())
    text = "Another arrangement of the cameras explains "
    text += f"{resolved} of the {against.sum()} contradicting pairs of photos" if resolved else "the matches better"
    cut = find_cut(agreement, against)
    if cut.ratio >= CUT_DOUBT:
        text += f": {name_photo_group(cut.group, verified)} disagree with the others"
    text += ", so the model is bent or contains duplicates."
    return [Reason("bad" if gain >= GAIN_BAD else "doubt", text, hint, "bent")]


def name_photo_group(group: Sequence[int], verified: ViewGraph) -> str:
    """Name a group of photos."""
    names = [verified.names[number] for number in group]
    if len(names) <= 2:
        return " and ".join(names)
    return f"{len(names)} photos ({names[0]}, {names[1]}, …)"
