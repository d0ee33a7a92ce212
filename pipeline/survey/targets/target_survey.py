"""Targets and scale bars in georeferencing: marks for the control file's points, and metric scale for a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.files.names import NameFinder, list_names
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.files.control_edit import ControlText
from splatpipe.pipeline.survey.files.scale_bars import ModelScale, ScaleBar, scale_by
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.points.surveyed_points import Survey
from splatpipe.pipeline.survey.targets.expected_places import expected_enu, free_enu
from splatpipe.pipeline.survey.targets.target_finds import TargetFind, WantedTargets
from splatpipe.pipeline.survey.targets.target_marks import ExpectedPoints, TargetMarks, named_tracks

SCALE_OFF_SIGMAS = 3.0  # joint sigmas between the bars' scale and the frame's: worth a warning


@dataclass(frozen=True)
class FoundBars:
    """Scale bars whose ends were found in photos.

    Attributes:
        bars: Of which both ends were found.
        used: Indices of those that agree with the others.
        places: Of the ends, model frame, by name.
        pixels: Where photos show the detected ones, by name and photo.
    """

    bars: tuple[ScaleBar, ...]
    used: tuple[int, ...]
    places: Mapping[str, Float64[np.ndarray, " 3"]]
    pixels: Mapping[str, Mapping[str, tuple[float, float]]]


@dataclass(frozen=True)
class TargetSurvey:
    """Identifies detected targets.

    Attributes:
        wanted: Control points and scale bars.
        finds: Targets in photos.
        model: The sparse model.
        photos: All photos by name.
        frame: Of the photos' positions; None where they give none.
        approximate_crs: As georef's option.
    """

    wanted: WantedTargets
    finds: tuple[TargetFind, ...]
    model: SparseModel
    photos: Mapping[str, Photo]
    frame: Frame | None
    approximate_crs: bool

    def marks(self, seeds: Mapping[str, Float64[np.ndarray, " 3"]], report: Reporter) -> TargetMarks:
        """The targets by their names; reports which were used and which were not.

        Args:
            seeds: Positions of manually marked points, by name.
            report: Receives notes.
        """
        ends = sorted({name for bar in self.wanted.bars for name in (bar.a, bar.b)})
        points = [name for name, *_ in self.wanted.points]
        names = points + [name for name in ends if name not in points]
        found = named_tracks(self.finds, names, (self.model, self.photos), self._expected(points), seeds)
        if found.named:
            marks = sum(len(each.track.finds) for each in found.named)
            listed = list_names([each.name for each in found.named])
            report.note(f"Targets detected in the photos: {listed}, with {marks} marks.")
        refused = [f"{count} {what}" for what, count in sorted(found.refused.items())]
        if refused:
            report.note(f"Targets not used: {', '.join(refused)}.")
        return found

    def _expected(self, points: list[str]) -> ExpectedPoints | None:
        if not points:
            return None
        try:
            if self.frame is None:
                return ExpectedPoints(tuple(points), free_enu(self.wanted, self.approximate_crs), None)
            enu = expected_enu(self.wanted, self.frame, self.model, self.approximate_crs)
            return ExpectedPoints(tuple(points), enu, self.frame.world_from_model)
        except SplatpipeError:  # about the CRS; reported where control is placed
            return None


def marker_of(
    survey: TargetSurvey, control: Path, report: Reporter, seen: list[TargetMarks]
) -> Callable[[Survey], dict[str, dict[str, tuple[float, float]]]]:
    """Return the target finder for a control file's points; it skips photos marked as not showing a point."""

    def find(points: Survey) -> dict[str, dict[str, tuple[float, float]]]:
        seeds = {point.name: point.found.xyz for point in points.points if point.found is not None}
        found = survey.marks(seeds, report)
        seen.append(found)
        hidden = ControlText.read(control, NameFinder(sorted(survey.photos))).hidden
        named = {point.name for point in points.points}
        return {
            name: {photo: pixel for photo, pixel in pixels.items() if (name, photo) not in hidden}
            for name, pixels in found.pixels().items()
            if name in named
        }

    return find


def scale_of(
    survey: TargetSurvey, found: TargetMarks, marked: Mapping[str, Float64[np.ndarray, " 3"]], report: Reporter
) -> tuple[ModelScale | None, FoundBars | None]:
    """The model's scale by the scale bars, and these; warns about bars that contradict the others or were not found."""
    bars = survey.wanted.bars
    if not bars:
        return None, None
    places = dict(marked) | {each.name: each.track.place for each in found.named}
    scale = scale_by(bars, places)
    missing = [f"{bar.a} to {bar.b}" for bar in bars if bar.a not in places or bar.b not in places]
    if missing:
        report.warning(
            f"Of {len(missing)} of {len(bars)} scale bars a target was not detected: {list_names(missing)}.",
            "A coded target's name must end in its number; each must be sharp in two photos and at least 20 pixels "
            "wide.",
        )
    if scale is None:
        if len(missing) < len(bars):
            report.warning("The scale bars contradict each other, so none of them is used.", "Measure them again.")
        return None, None
    wrong = [
        f"{bar.a} to {bar.b} ({scale.errors_m[k]:+.3f} m)"
        for k, bar in enumerate(bars)
        if k not in scale.used and np.isfinite(scale.errors_m[k])
    ]
    if wrong:
        report.warning(
            f"Scale bars contradict the others and are left out: {list_names(wrong)}.", "Measure them again."
        )
    there = [k for k, bar in enumerate(bars) if bar.a in places and bar.b in places]
    used = tuple(place for place, k in enumerate(there) if k in scale.used)
    return scale, FoundBars(tuple(bars[k] for k in there), used, places, found.pixels())


def scaled(frame: Frame, scale: ModelScale) -> Frame:
    """An arbitrary frame scaled to metres by the bars."""
    factor = scale.metres_per_unit / frame.world_from_model.scale
    old = frame.world_from_model
    similarity = Similarity(old.scale * factor, old.rotation, old.translation * factor)
    upright = frame.note.partition(" Up is")[2]
    note = f"Metres by {_bars_text(scale)}, good to {scale.sigma:.2%}; place and heading are arbitrary. Up is"
    return replace(frame, world_from_model=similarity, metres=True, note=note + upright)


def compare(frame: Frame, scale: ModelScale, report: Reporter, adjusted: bool = False) -> None:
    """Report how well the frame's scale agrees with the bars'.

    Args:
        frame: The resulting one.
        scale: By the bars.
        report: Receives the sentence.
        adjusted: Whether the bars took part in the adjustment.
    """
    ratio = frame.world_from_model.scale / scale.metres_per_unit - 1.0
    bars = f"{_bars_text(scale)} (good to {scale.sigma:.3%})"
    what = f"According to {bars}, lengths in this result are {ratio:+.3%} off."
    if adjusted:
        what = f"After the adjustment, which {bars} took part in, lengths are {ratio:+.3%} off theirs."
    if abs(ratio) > SCALE_OFF_SIGMAS * scale.sigma + 0.01:
        report.warning(what, "Check the bars, and the coordinates or positions that set the scale.")
    else:
        report.note(what)


def scale_json(bars: Sequence[ScaleBar], scale: ModelScale | None, frame: Frame) -> dict[str, JSON]:
    """The scale bars' entry in ``accuracy.json``; empty where none gave a scale.

    Each bar's error is the length in the result less the stated one.
    """
    if scale is None:
        return {}
    ratio = frame.world_from_model.scale / scale.metres_per_unit
    sentence = f"its metres are those of {_bars_text(scale)}, good to {scale.sigma:.2%} where they lie."
    if frame.origin is not None:
        sentence = f"by {_bars_text(scale)} (good to {scale.sigma:.2%}) lengths are {ratio - 1.0:+.2%} off."
    rows = [
        {
            "a": bar.a,
            "b": bar.b,
            "metres": bar.metres,
            "error_m": (bar.metres + error) * ratio - bar.metres if np.isfinite(error) else None,
            "used": k in scale.used,
        }
        for k, (bar, error) in enumerate(zip(bars, scale.errors_m, strict=True))
    ]
    placed = frame.origin is not None
    return {"scale": {"metric": True, "placed": placed, "sentence": sentence, "sigma": scale.sigma, "bars": rows}}


def _bars_text(scale: ModelScale) -> str:
    return f"{len(scale.used)} scale bar{'' if len(scale.used) == 1 else 's'}"


def scale_summary(scale: ModelScale | None) -> dict[str, JSON]:
    """The scale bars' part of the stage's summary."""
    if scale is None:
        return {}
    errors = [None if not np.isfinite(error) else float(error) for error in scale.errors_m]
    return {"scale_bars": len(scale.used), "scale_sigma": scale.sigma, "scale_bar_errors_m": errors}
