"""Merges another splat into the edited one, each at its georeferenced position."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatpipe.pipeline.edit.crops import DIGEST_CHARACTERS
from splatpipe.pipeline.edit.sources import open_source
from splatpipe.pipeline.edit.workpiece import Workpiece, between
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import NO_OFFSET, Scene, SceneFacts, SplatOrigin, turn_of
from splatpipe.pipeline.survey.crs.crs import UNKNOWN, describe_vertical, parse_vertical, same_datum
from splatpipe.pipeline.survey.crs.frames import Origin

MAX_DISTANCE_M = 30_000.0  # between two splats in one file: float32 has steps of 2 mm there


@dataclass(frozen=True)
class Merge:
    """Another splat to merge unchanged: earlier steps do not apply to it.

    Attributes:
        path: Its file, or a run's OUT.
    """

    path: Path

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Merge the other splat; returns the record of the step.

        Raises:
            SplatpipeError: if it cannot be read, or the relative position of the two is unknown.
        """
        source = open_source(self.path)
        digest = source.digest()
        other = source.read()
        ours = piece.scene()
        moved = _frame_from_other(ours.facts, other.facts, source.name)
        if other.facts.antialias != ours.facts.antialias:
            piece.notes.append(
                f"Only one of {source.name} and the splat was trained with anti-aliasing: "
                "small Gaussians of the other will look too thin or too thick."
            )
        count = len(other.gaussians)
        piece.replace_gaussians(_joined(ours, other, moved))
        piece.merged = True
        return {"step": "merge", "file": source.name[:80], "sha256": digest[:DIGEST_CHARACTERS], "added": count}


def _joined(ours: Scene, other: Scene, moved: Similarity) -> Gaussians:
    """Both sets in our axes in one new set; no further copy of that size is made."""
    first, second = ours.gaussians, other.gaussians
    joined = Gaussians.empty(len(first) + len(second), max(first.sh_degree, second.sh_degree))
    to_own, to_up = turn_of(ours.facts.axes, "z up"), turn_of("z up", other.facts.axes)
    rotation = to_own @ torch.from_numpy(np.ascontiguousarray(moved.rotation)) @ to_up
    translation = to_own @ torch.from_numpy(np.ascontiguousarray(moved.translation))
    stays = bool((rotation == torch.eye(3)).all() and (translation == 0.0).all())  # then it is copied bit by bit
    start = 0
    for part, as_it_is in ((first, True), (second, stays)):
        for piece in part.pieces():
            put = piece if as_it_is else piece.transformed(1.0, rotation, translation)
            rows = slice(start, start + len(put))
            for name, tensor in joined.tensors().items():
                values = getattr(put, name)
                (tensor[rows, : values.shape[1]] if name == "sh" else tensor[rows]).copy_(values)
            start += len(put)
    return joined


def _frame_from_other(ours: SceneFacts, other: SceneFacts, name: str) -> Similarity:
    """The transform from the other's frame to ours, both rotated to z up.

    Raises:
        SplatpipeError: if it is unknown, or they are too far apart.
    """
    if (ours.place is None) != (other.place is None):
        without = name if other.place is None else "the splat"
        raise SplatpipeError(
            f"{without} is not georeferenced but the other splat is, so their relative position is unknown.",
            hint="Georeference its run (splatpipe georef), and take the splat that it exports.",
        )
    if ours.place is not None and other.place is not None:
        return _on_earth(ours.place, other.place, name)
    surveyed = ours.offset != NO_OFFSET and other.offset != NO_OFFSET  # z up, whatever the files' axes
    if ours.axes != other.axes and not surveyed:
        raise SplatpipeError(
            f"{name} has its {other.axes.replace(' ', ' axis ')}, the splat its {ours.axes.replace(' ', ' axis ')}.",
            hint="Splats that are not georeferenced can be merged only in the same frame.",
        )
    if ours.metres != other.metres:
        raise SplatpipeError(
            f"Only one of {name} and the splat is in metres.",
            hint="Scale the other first: splatpipe edit IN OUT --scale-from A B 12.40m.",
        )
    apart = np.array(other.turned("z up").offset) - np.array(ours.turned("z up").offset)
    if float(np.linalg.norm(apart)) > MAX_DISTANCE_M:
        raise SplatpipeError(
            f"By its coordinates, {name} lies {np.linalg.norm(apart):,.0f} from the splat: one file cannot hold both.",
            hint="Export both in the same coordinates.",
        )
    return Similarity(1.0, np.eye(3), apart)


def _on_earth(ours: SplatOrigin, other: SplatOrigin, name: str) -> Similarity:
    datums = parse_vertical(ours.vertical_datum), parse_vertical(other.vertical_datum)
    known = datums[0] == datums[1] or (UNKNOWN not in datums and same_datum(*datums))
    if not known:
        names = [describe_vertical(datum) if datum != UNKNOWN else "an unknown datum" for datum in datums]
        raise SplatpipeError(
            f"Heights of the splat are in {names[0]}, those of {name} in {names[1]}: they may be tens of metres apart.",
            hint="Give both runs the same vertical datum: --set georef.vertical=…, then splatpipe georef OUT.",
        )
    to_ours = between(origin_of(other), origin_of(ours))
    apart = float(np.linalg.norm(to_ours.translation))
    if apart > MAX_DISTANCE_M:
        raise SplatpipeError(
            f"{name} lies {apart / 1000.0:,.0f} km from the splat: one file cannot hold both.",
            hint=f"At most {MAX_DISTANCE_M / 1000.0:.0f} km: coordinates in a file are 32-bit numbers.",
        )
    return to_ours


def origin_of(place: SplatOrigin) -> Origin:
    """The origin of a splat's frame."""
    return Origin(place.latitude, place.longitude, place.height_m)
