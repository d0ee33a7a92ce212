"""A marking session: every change is written to disk before it is acknowledged, and can be undone.

Detected targets are shown like marks and count like them, but are never written: the file contains only what a person
marked or declared not visible.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.app.view.marking.estimate import (
    HELPFUL_MARKS,
    Estimate,
    Estimator,
    Marks,
    Projection,
    Projector,
    residual_of,
)
from splatpipe.pipeline.app.view.marking.marking_job import MarkingJob
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.photos.files.names import NameFinder
from splatpipe.pipeline.survey.files.control_edit import ControlText
from splatpipe.pipeline.survey.files.control_file import SurveyedPoint

MAX_UNDO = 10_000
MAX_RAY_ANGLE_RAD = math.radians(60.0)  # between rays: a larger angle adds nothing
HELPFUL_PHOTOS = 20  # photos of a point ordered by how much they help; the rest follow by distance
DIGITS = 2  # decimal places of pixel coordinates in the file
# A point in a photo: its mark in pixels, or not visible, or neither.
State = tuple[float, float] | Literal["hidden"] | None


class WrongRequestError(Exception):
    """An invalid request from the page; the text says why."""


@dataclass(frozen=True)
class Change:
    """A change of a point's state in a photo."""

    point: str
    photo: str
    before: State
    after: State


class Marking:
    """The marks, kept in memory as they are in the file.

    Args:
        job: The marking job.
    """

    def __init__(self, job: MarkingJob) -> None:
        self.job = job
        self._lock = threading.Lock()
        self._points = {point.name: point for point in job.points}
        self._photos = tuple(sorted(job.photos))
        self._estimator, self._projector = Estimator(job), Projector(job)
        self._text = job.text
        self._done: list[Change] = []
        self._undone: list[Change] = []
        self.revision = 0
        self._estimated: tuple[int, Estimate, Projection] | None = None

    @property
    def photos(self) -> tuple[str, ...]:
        """Names of all photos; a photo's number is its index here."""
        return self._photos

    def change(self, point: str, photo: str, after: State, nudge: bool = False) -> None:
        """Mark a point in a photo, remove the mark, or declare the point not visible.

        Args:
            point: The point's name.
            photo: The photo's name.
            after: The new state.
            nudge: Whether it continues the previous change, to be undone together with it.

        Raises:
            WrongRequestError: if there is no such point, photo or pixel.
            SplatpipeError: if the file cannot be read or written; it is then unchanged.
        """
        after = self._checked(point, photo, after)
        with self._lock:
            text = self._current_text()
            before = self._state(text, point, photo)
            if before == after:
                return
            self._write(text, Change(point, photo, before, after))
            last = self._done[-1] if self._done else None
            if nudge and last is not None and (last.point, last.photo, last.after) == (point, photo, before):
                self._done[-1] = replace(last, after=after)
            else:
                self._done = [*self._done[-MAX_UNDO:], Change(point, photo, before, after)]
            self._undone.clear()

    def undo(self) -> Change | None:
        """Undo the last change and return it; None if there is none."""
        return self._move_change(self._done, self._undone, back=True)

    def redo(self) -> Change | None:
        """Redo the last undone change and return it; None if there is none."""
        return self._move_change(self._undone, self._done, back=False)

    def _move_change(self, source: list[Change], target: list[Change], back: bool) -> Change | None:
        with self._lock:
            if not source:
                return None
            change = source[-1]
            text = self._current_text()
            now = self._state(text, change.point, change.photo)
            self._write(text, replace(change, before=now, after=change.before if back else change.after))
            target.append(source.pop())
            return change

    def _checked(self, point: str, photo: str, after: State) -> State:
        if point not in self._points:
            raise WrongRequestError("There is no such point.")
        if photo not in self.job.photos:
            raise WrongRequestError("There is no such photo.")
        if not isinstance(after, tuple):
            return after
        x, y = (round(value, DIGITS) for value in after)
        size = self.job.photos[photo]
        if not (math.isfinite(x) and math.isfinite(y) and 0.0 <= x <= size.width and 0.0 <= y <= size.height):
            raise WrongRequestError("The position is outside the photo.")
        return x, y

    def _current_text(self) -> ControlText:
        """The file's current content, including changes by others; a deleted file is restored."""
        if self.job.text.path.is_file():
            return ControlText.read(self.job.text.path, NameFinder(self._photos))
        return self._text

    def _state(self, text: ControlText, point: str, photo: str) -> State:
        if (point, photo) in text.hidden:
            return "hidden"
        pixel = text.marks.get(point, {}).get(photo)
        shift = self.job.pixel_shift
        return None if pixel is None else (round(pixel[0] + shift, DIGITS), round(pixel[1] + shift, DIGITS))

    def _write(self, text: ControlText, change: Change) -> None:
        point, shift = self._points[change.point], self.job.pixel_shift
        text = text.with_hidden(change.point, change.photo, hidden=change.after == "hidden")
        if isinstance(change.after, tuple):
            text = text.with_mark(point, change.photo, (change.after[0] - shift, change.after[1] - shift))
        else:
            text = text.without_mark(point, change.photo)
        text.save()
        self._text = text
        self.revision += 1

    def overview(self) -> dict[str, JSON]:
        """All points and the estimates from the marks, for the lists beside the photo."""
        with self._lock:
            revision, estimate, projection = self._estimate()
            marks, found, hidden = self._text.marks, self._detections(), self._text.hidden
            can_undo, can_redo = bool(self._done), bool(self._undone)
        points = [self._point_row(k, estimate, projection, (marks, found), hidden) for k in range(len(self.job.points))]
        return {
            "revision": revision,
            "file": str(self.job.text.path),
            "exists": self.job.text.path.is_file(),
            "command": self.job.command,
            "crs": f"{self.job.crs.text} ({self.job.crs.name})",
            "can_undo": can_undo,
            "can_redo": can_redo,
            "photos": [
                {"name": name, "width": self.job.photos[name].width, "height": self.job.photos[name].height}
                for name in self._photos
            ],
            "points": points,
            "expected_m": estimate.expected_m,
            "heights_tied": estimate.heights_tied,
            "gsd_m": estimate.gsd_m,
            "tables": {role: estimate.tables.get(role) for role in ("control", "check")},
            "placed": self.job.frame is not None or bool(estimate.tables),
            "warnings": estimate.warnings,
        }

    def detail(self, name: str) -> dict[str, JSON]:
        """A point in all photos, the most helpful ones first.

        Raises:
            WrongRequestError: if there is no such point.
        """
        if name not in self._points:
            raise WrongRequestError("There is no such point.")
        with self._lock:
            revision, estimate, projection = self._estimate()
            marks, found = self._text.marks.get(name, {}), self._detections().get(name, {})
            hidden = self._text.hidden
        number = list(self._points).index(name)
        sighting_by_photo = {s.photo: s for s in estimate.survey.points[number].sightings}
        index = {photo: k for k, photo in enumerate(self.job.model.names)}
        lines = self._lines(estimate, number)
        rows = []
        for photo in self._photos:
            row = self._photo_row(photo, index.get(photo), number, projection)
            sighting = sighting_by_photo.get(photo)
            off = None if sighting is None else residual_of(sighting, estimate.survey.points[number], self.job)
            mark = self._shift_pixel(marks[photo]) if photo in marks else found.get(photo)
            row |= {
                "mark": None if mark is None else [round(mark[0], DIGITS), round(mark[1], DIGITS)],
                "found": photo in found,
                "hidden": (name, photo) in hidden,
                "agrees": sighting.agrees if sighting is not None else True,
                "residual_px": off,
                "line": None if lines is None or photo not in index else _visible_part(lines[:, index[photo]]),
            }
            rows.append(row)
        rows.sort(key=lambda row: (row["predicted"] is None, row["doubtful"], row["rank"]))
        sure = [row for row in rows if row["predicted"] is not None and not row["doubtful"]]
        if sure:
            centres = self.job.model.centres[[index[row["name"]] for row in sure]]
            ranks = np.array([row["rank"] for row in sure])
            order = helpful_order(estimate.places[number], centres, ranks)
            rows[: len(sure)] = [sure[k] for k in order]
        return {"revision": revision, "name": name, "by_marks": bool(estimate.by_marks[number]), "photos": rows}

    def _lines(self, estimate: Estimate, number: int) -> Float64[np.ndarray, "steps m 2"] | None:
        """The epipolar curves of a point that is marked in exactly one photo; None for other points."""
        posed = [seen for seen in estimate.survey.points[number].sightings if seen.index is not None]
        return self._projector.line(posed[0]) if len(posed) == 1 else None

    def _detections(self) -> dict[str, dict[str, tuple[float, float]]]:
        """Detected targets, except where a person has marked the point or declared it not visible."""
        marks, hidden = self._text.marks, self._text.hidden
        return {
            name: {
                photo: pixel
                for photo, pixel in pixels.items()
                if photo not in marks.get(name, {}) and (name, photo) not in hidden
            }
            for name, pixels in self.job.found.items()
        }

    def _shift_pixel(self, pixel: tuple[float, float]) -> tuple[float, float]:
        shift = self.job.pixel_shift
        return round(pixel[0] + shift, DIGITS), round(pixel[1] + shift, DIGITS)

    def _photo_row(self, photo: str, index: int | None, number: int, projection: Projection) -> dict[str, Any]:
        """Where a photo shows a point; photos that are close and have it near the centre rank first."""
        row: dict[str, Any] = {"photo": self._photos.index(photo), "name": photo, "predicted": None, "radius_px": None}
        row |= {"doubtful": False, "rank": 0.0, "posed": index is not None}
        if index is None or not math.isfinite(projection.depth[number, index]):
            return row
        x, y = projection.pixels[number, index].tolist()
        size = self.job.photos[photo]
        aside = max(abs(x / size.width - 0.5), abs(y / size.height - 0.5))  # beyond 0.5 it is outside the image
        return row | {
            "predicted": [round(x, DIGITS), round(y, DIGITS)],
            "radius_px": round(float(projection.radius_px[number, index]), 1),
            "doubtful": bool(projection.doubtful[number, index]),
            "rank": float(projection.depth[number, index]) * (1.0 + aside),
        }

    def _estimate(self) -> tuple[int, Estimate, Projection]:
        """Version, estimate and projection for the current marks; called with the lock held."""
        if self._estimated is None or self._estimated[0] != self.revision:
            marks = {name: dict(pixels) for name, pixels in self._detections().items()}
            for name, seen in self._text.marks.items():
                marks.setdefault(name, {}).update((photo, self._shift_pixel(pixel)) for photo, pixel in seen.items())
            estimate = self._estimator.estimate(marks)
            self._estimated = self.revision, estimate, self._projector.project(estimate.places, estimate.radius_m)
        return self._estimated

    def _point_row(
        self,
        number: int,
        estimate: Estimate,
        projection: Projection,
        marks: tuple[Marks, Marks],
        hidden: set[tuple[str, str]],
    ) -> dict[str, JSON]:
        """A point for the list; ``marks`` are those in the file, and the detected targets."""
        point, stated = estimate.survey.points[number], self.job.points[number]
        made, found = (each.get(stated.name, {}) for each in marks)
        seen = {*made, *found}
        away = {photo for name, photo in hidden if name == stated.name}
        likely = {
            name
            for k, name in enumerate(self.job.model.names)
            if math.isfinite(projection.depth[number, k]) and not projection.doubtful[number, k]
        }
        residual = [None if math.isnan(value) else round(value, 4) for value in estimate.residual_m[number].tolist()]
        wrong = sum(not sighting.agrees for sighting in point.sightings)
        return {
            "name": stated.name,
            "role": point.role,
            "why": point.why if seen else "",
            "coordinates": _coordinates(stated),
            "marks": len(seen),
            "found": len(found),
            "wrong": wrong,
            "left": len(likely - away - seen),
            "enough": len(seen) - wrong >= HELPFUL_MARKS,
            "residual_m": residual if any(value is not None for value in residual) else None,
        }


def helpful_order(
    place: Float64[np.ndarray, " 3"], centres: Float64[np.ndarray, "n 3"], ranks: Float64[np.ndarray, " n"]
) -> list[int]:
    """Order photos by how much they help to locate a point: close ones with new viewing directions first.

    Args:
        place: The point.
        centres: The camera centres.
        ranks: Their distances, ascending; greater for cameras that see the point less well.
    """
    directions = centres - place
    directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-300)
    chosen, apart = [0], np.full(len(ranks), MAX_RAY_ANGLE_RAD)
    while len(chosen) < min(len(ranks), HELPFUL_PHOTOS):
        apart = np.minimum(apart, np.arccos(np.clip(directions @ directions[chosen[-1]], -1.0, 1.0)))
        score = apart / ranks
        score[chosen] = -1.0
        chosen.append(int(np.argmax(score)))
    return [*chosen, *(k for k in range(len(ranks)) if k not in chosen)]


def _visible_part(line: Float64[np.ndarray, "steps 2"]) -> list[list[float]] | None:
    """The part of a line within the photo."""
    visible = line[np.isfinite(line).all(axis=1)]
    return np.round(visible, 1).tolist() if len(visible) > 1 else None


def _coordinates(point: SurveyedPoint) -> list[float | None]:
    return [point.x, point.y, point.z]
