"""The surveyed points of a capture: from the control file to rays of the model's cameras, each point with its role."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.files.names import NameFinder, hint_of_several, list_names, without_zeros
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.crs.crs import Crs
from splatpipe.pipeline.survey.crs.readings import MIN_EXPLAINED_SHARE
from splatpipe.pipeline.survey.files.control_file import ControlFile, read_control_file, titled
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.points.located_points import Sighting, SurveyPoint, locate, residual_px
from splatpipe.pipeline.survey.points.mark_readings import Marks, named_reading, require_agreement, sentence_of

MIN_FOR_CHECKS = 6  # points: with at least as many, some are kept as check points
EVERY_NTH = 3  # point becomes a check point
MAX_OUTSIDE_SHARE = 0.3  # share of marks outside their photos, above which they were made in photos of another size


@dataclass(frozen=True)
class Survey:
    """All points.

    Attributes:
        file: The contents of the control file.
        points: In the file's order.
    """

    file: ControlFile
    points: tuple[SurveyPoint, ...]

    @property
    def crs(self) -> Crs:
        """The CRS of the file's coordinates."""
        return self.file.crs

    @property
    def name(self) -> str:
        """The file's name, for messages."""
        return self.file.name

    def with_points(self, points: Sequence[SurveyPoint]) -> Survey:
        """The same file with other points."""
        return replace(self, points=tuple(points))

    def of_role(self, role: str) -> list[SurveyPoint]:
        """The points that have a given role."""
        return [point for point in self.points if point.role == role]


# Returns pixels by point and photo, for a survey whose manual marks are already located.
TargetFinder = Callable[[Survey], Mapping[str, Mapping[str, tuple[float, float]]]]


def load_survey(
    path: Path,
    config: GeorefConfig,
    photos: Mapping[str, Photo],
    model: SparseModel,
    report: Reporter,
    find_targets: TargetFinder | None = None,
) -> Survey:
    """Read a control file and find its points in the model.

    Args:
        path: The file.
        config: Roles and the pixel convention.
        photos: All photos of the capture by name.
        model: The sparse model.
        report: Receives warnings about marks and photos that cannot be used.
        find_targets: Returns marks of points that are targets in the photos.

    Raises:
        SplatpipeError: if it is not a control file, or does not belong to these photos.
    """
    file = read_control_file(path)
    find = NameFinder(sorted(photos))
    marks = _marks(file, find, config)
    sightings = _sightings(file, path.name, marks, config, photos, model, report)
    points = [
        locate(SurveyPoint(point, "control", "", tuple(seen)), model, photos, config.mark_sigma_px)
        for point, seen in zip(file.points, sightings, strict=True)
    ]
    require_agreement(path.name, marks, points, model, photos, config.mark_sigma_px)
    if find_targets is not None:
        points = _with_targets(points, find_targets(Survey(file, tuple(points))), model, photos, config)
    if not any(point.sightings for point in points):
        report.warning(
            f"{path.name} has points without marks in photos, and no targets were detected for them.",
            "Mark each point in at least two, better four photos: splatpipe view OUT --mark.",
        )
        return Survey(file, tuple(with_roles(points, config.check_points)))
    if file.zero_heights:
        report.note(
            f"A height of 0.0 is treated as unknown: {list_names(file.zero_heights)} of {path.name} "
            f"{'controls' if len(file.zero_heights) == 1 else 'control'} horizontally only."
        )
    _warn_of_unusable(points, path.name, model, photos, report)
    roled = with_roles(points, config.check_points)
    _report_overruled_roles(roled, path.name, config.check_points, report)
    return Survey(file, tuple(roled))


def _with_targets(
    points: Sequence[SurveyPoint],
    found: Mapping[str, Mapping[str, tuple[float, float]]],
    model: SparseModel,
    photos: Mapping[str, Photo],
    config: GeorefConfig,
) -> list[SurveyPoint]:
    """Add detected targets to the points' marks; a manual mark in the same photo takes precedence."""
    index, result = {photo: k for k, photo in enumerate(model.names)}, []
    for point in points:
        marked = {sighting.photo for sighting in point.sightings}
        new = [
            Sighting(photo, pixel, index.get(photo), automatic=True)
            for photo, pixel in found.get(point.name, {}).items()
            if photo not in marked
        ]
        if new:
            every = tuple(sorted([*point.sightings, *new], key=lambda sighting: sighting.photo))
            fresh = SurveyPoint(point.surveyed, "control", "", every)
            point = locate(fresh, model, photos, config.mark_sigma_px)
        result.append(point)
    return result


def _marks(file: ControlFile, find: NameFinder, config: GeorefConfig) -> Marks:
    """The marks in photos of the capture; of several in one photo, the first."""
    shift = 0.5 if config.pixel_origin == "centre" else 0.0
    pixels = []
    for point in file.points:
        seen: dict[str, tuple[float, float]] = {}
        for mark in point.marks:
            photo = find(mark.photo)
            if photo is not None:
                seen.setdefault(photo, (mark.x + shift, mark.y + shift))
        pixels.append(seen)
    return Marks(file.points, tuple(pixels))


def _sightings(
    file: ControlFile,
    name: str,
    marks: Marks,
    config: GeorefConfig,
    photos: Mapping[str, Photo],
    model: SparseModel,
    report: Reporter,
) -> list[list[Sighting]]:
    """Each point's marks inside their photos.

    Raises:
        SplatpipeError: if no photo is known, or too many marks lie outside.
    """
    _check_photos(name, file, photos, report)
    index = {photo: k for k, photo in enumerate(model.names)}
    outside: list[str] = []
    result = []
    for point, pixels in zip(marks.points, marks.pixels, strict=True):
        seen = []
        for photo, (x, y) in sorted(pixels.items()):
            if 0.0 <= x <= photos[photo].width and 0.0 <= y <= photos[photo].height:
                seen.append(Sighting(photo, (x, y), index.get(photo)))
            else:
                outside.append(f"{point.name} in {photo}")
        result.append(seen)
    count = sum(len(point.marks) for point in file.points)
    if len(outside) > MAX_OUTSIDE_SHARE * count:
        cause = named_reading(marks, model, photos, config.mark_sigma_px)
        hint = "Were they made in photos that were resized or rotated? Pixel coordinates must be in these photos."
        raise SplatpipeError(
            f"{len(outside)} of {count} marks of {name} lie outside their photos: {list_names(outside)}.",
            hint if cause is None else f"{sentence_of(*cause)} --set georef.control=none runs without control.",
        )
    if outside:
        report.warning(
            f"{len(outside)} marks of {name} lie outside their photos and are left out: {list_names(outside)}.",
            "Correct their pixel coordinates.",
        )
    return result


def _check_photos(name: str, file: ControlFile, photos: Mapping[str, Photo], report: Reporter) -> None:
    """Warn of photos that the file names and the capture does not have.

    Raises:
        SplatpipeError: if it has none of them.
    """
    find = NameFinder(sorted(photos))
    named = sorted({mark.photo for point in file.points for mark in point.marks})
    missing = [photo for photo in named if find(photo) is None]
    if not missing:
        return
    known = name_hint(missing, photos)
    if len(missing) == len(named):
        raise SplatpipeError(
            f"None of the photos that {name} names can be found in this capture: {list_names(missing)}.",
            (known or "Check that the file belongs to these photos; photos must be listed by their file names.")
            + " --set georef.control=none runs without control.",
        )
    report.warning(
        f"{name} names {missing_photos(missing)}.",
        f"Their marks are ignored. {known or 'Correct the names, or add the photos.'}",
    )


def name_hint(missing: Sequence[str], photos: Iterable[str]) -> str:
    """What appears to be wrong with names of photos that are not found; empty if nothing is known."""
    known = sorted(photos)
    return hint_of_several(missing, known) or eaten_zeros(missing, known)


def eaten_zeros(missing: Sequence[str], known: Iterable[str], what: str = "photos") -> str:
    """A hint where names lack only the leading zeros of known names; empty where most differ otherwise."""
    find = NameFinder(sorted(known))
    bare = NameFinder(sorted({without_zeros(name) for name in known}))
    back = [name for name in missing if find(name) is None and bare(without_zeros(name)) is not None]
    if len(back) < MIN_EXPLAINED_SHARE * max(len(missing), 1):
        return ""
    return (
        f"Without leading zeros, {list_names(back, 3)} would be {what} of this capture: a spreadsheet drops the zeros"
        " of 001. Format the column as text."
    )


def missing_photos(names: Sequence[str]) -> str:
    """Phrase for messages about photos that a file names and the capture does not have."""
    many = "1 photo that is" if len(names) == 1 else f"{len(names)} photos that are"
    return f"{many} not found in this capture: {list_names(names)}"


def _report_overruled_roles(points: Sequence[SurveyPoint], name: str, setting: str, report: Reporter) -> None:
    """Report that the option, possibly left from an earlier call, overrides the roles that the file states."""
    usable = [point for point in points if point.role != "left_out"]
    stated = {point.name for point in usable if point.surveyed.role == "check"}
    if any(point.surveyed.role for point in usable) and stated != {p.name for p in usable if p.role == "check"}:
        report.note(
            f"georef.check_points={setting} goes before the roles in {name}, which has "
            f"{list_names(sorted(stated)) if stated else 'no point'} as check points; "
            "--set georef.check_points=auto takes the file's."
        )


def _warn_of_unusable(
    points: Sequence[SurveyPoint], name: str, model: SparseModel, photos: Mapping[str, Photo], report: Reporter
) -> None:
    for point in points:
        if point.found is None:
            report.warning(
                f"{titled('', point.name)} of {name} is left out: {point.why}.",
                "Mark it in at least two photos taken from different positions; four are better.",
            )
            continue
        wrong = [s for s in point.sightings if s.index is not None and not s.agrees]
        if wrong:
            off = [residual_px(sighting, point.found.xyz, model, photos) for sighting in wrong]
            named = [
                s.photo if r is None else f"{s.photo} ({np.hypot(*r):.0f} px)" for s, r in zip(wrong, off, strict=True)
            ]
            report.warning(
                f"Marks of {point.name} disagree with its other marks, and are left out: {list_names(named)}.",
                "Correct these marks: another point may have been marked, or the wrong photo given.",
            )


def with_roles(points: Sequence[SurveyPoint], setting: str) -> list[SurveyPoint]:
    """Assign roles by the option, else by the file, else every third point of at least six is a check point.

    Args:
        points: Each with role ``control``, or left out.
        setting: `georef.check_points`.

    Raises:
        SplatpipeError: if it names points that are not in the control file.
    """
    usable = [point.name for point in points if point.role != "left_out"]
    checks = check_names(usable, {point.name: point.surveyed.role for point in points}, setting)
    unknown = sorted(checks - {point.name for point in points})
    if unknown:
        raise SplatpipeError(
            f"georef.check_points has points that are not in the control file: {list_names(unknown)}.",
            eaten_zeros(unknown, [point.name for point in points], "points")
            or f"It has {list_names([point.name for point in points])}.",
        )
    return [
        replace(point, role="check") if point.role == "control" and point.name in checks else point for point in points
    ]


def check_names(usable: Sequence[str], roles: Mapping[str, str | None], setting: str) -> set[str]:
    """Names of the check points: by the option, else by the file, else every third of at least six.

    Args:
        usable: The points that can be one, in the file's order.
        roles: What the file states of each point's role; None for nothing.
        setting: `georef.check_points`.
    """
    setting = setting.strip()
    if setting == "none":
        return set()
    if setting != "auto":
        return {name.strip() for name in setting.split(",") if name.strip()}
    if any(role is not None for role in roles.values()):
        return {name for name, role in roles.items() if role == "check"}
    return set(usable[EVERY_NTH - 1 :: EVERY_NTH]) if len(usable) >= MIN_FOR_CHECKS else set()
