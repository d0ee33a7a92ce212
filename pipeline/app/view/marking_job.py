"""The input of a marking session: survey points, the photos of a run, and the file for the marks."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from splatpipe.pipeline.app.view.log import RunLog, contents_of
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.json_file import read_json
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE, RunFolder
from splatpipe.pipeline.engine.runs.source import AUTO, NONE, open_source
from splatpipe.pipeline.photos.files.names import NameFinder
from splatpipe.pipeline.photos.files.photo_list import Photo, load_photo_list
from splatpipe.pipeline.survey.crs.crs import Crs
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.files.control_edit import ControlText
from splatpipe.pipeline.survey.files.control_file import (
    SAME_PLACE_M,
    SurveyedPoint,
    crs_of,
    read_control_file,
    read_points_file,
)
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.placing.assumed_heights import with_assumed_heights
from splatpipe.pipeline.survey.placing.fitting import FrameUndeterminedError
from splatpipe.pipeline.survey.placing.gps import georeference, read_positions
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel, read_model
from splatpipe.stages.line import GEOREF, LINE
from splatpipe.stages.options import LineConfig

LIST_NAME, CSV_NAME = "gcp_list.txt", "control.csv"
CONTROL = "source.control"
Found = Mapping[str, Mapping[str, tuple[float, float]]]


@dataclass(frozen=True)
class MarkingJob:
    """The input of a marking session.

    Attributes:
        points: The survey points, with coordinates as given.
        crs: The points' CRS.
        photos: The capture's photos by name.
        photos_dir: The photo folder.
        photos_part: The part ``ingest.photos``.
        model: The sparse model before georeferencing.
        positions: The photos' stated positions.
        frame: The frame from these positions; None if they give none.
        config: The run's `georef` options.
        found: Image coordinates by point and photo of targets that georeferencing detected; (0, 0) is the top-left
            corner of the first pixel.
        text: The content of the file for the marks when the session began.
        command: The command that makes a run use the marks.
    """

    points: tuple[SurveyedPoint, ...]
    crs: Crs
    photos: Mapping[str, Photo]
    photos_dir: Path
    photos_part: Path
    model: SparseModel
    positions: Positions
    frame: Frame | None
    config: GeorefConfig
    found: Found
    text: ControlText
    command: str

    @property
    def pixel_shift(self) -> float:
        """Offset from the file's pixel coordinates to ours, whose (0, 0) is the top-left corner of the first pixel."""
        return 0.5 if self.config.pixel_origin == "centre" else 0.0


def open_job(run: RunFolder, points_file: Path | None) -> MarkingJob:
    """Read everything that marking needs.

    Args:
        run: A run with at least a sparse model.
        points_file: Points to mark in addition to those in the run's GCP file.

    Raises:
        SplatpipeError: if the run has not got that far, there are no points, or the files are inconsistent.
    """
    photos_dir, config = run.config(LineConfig)
    source = open_source(photos_dir, run.out, LINE, _without_missing_control(config))
    parts = {name: part.path for name, part in contents_of(run, RunLog(run.out, EVENTS_FILE)).parts.items()}
    if source.model is not None:
        parts["sparse.model"] = source.model
    missing = [name for name in ("ingest.photos", "ingest.positions", "sparse.model") if name not in parts]
    if missing:
        raise UsageError(
            f"{run.out} has no sparse model yet, which marking needs to predict where points appear.",
            hint=f"Run first: splatpipe run {photos_dir} {run.out} --until georef",
        )
    photos = load_photo_list(parts["ingest.photos"]).by_name()
    text, points = _text_and_points(run, source.named.get(CONTROL), points_file, (source.folder, config.georef), photos)
    crs = crs_of(text.path, text.table)
    model = read_model(parts["sparse.model"], photos)
    positions = with_assumed_heights(model, read_positions(parts["ingest.positions"]))
    command = _command(run, text.path, config.georef.control, source.named.get(CONTROL))
    places = (source.folder, parts["ingest.photos"])
    frame = _frame(model, positions, config.georef, photos)
    found = _found(parts.get("georef.control"), points, photos)
    return MarkingJob(points, crs, photos, *places, model, positions, frame, config.georef, found, text, command)


def _found(control: Path | None, points: Sequence[SurveyedPoint], photos: Mapping[str, Photo]) -> Found:
    """The detected targets in georef's ``control.json``; empty if the run was not georeferenced with GCPs yet.

    Raises:
        SplatpipeError: if the file is broken.
    """
    if control is None:
        return {}
    names, found = {point.name for point in points}, {}
    try:
        for point in read_json(control)["points"]:
            pixels = {
                str(seen["photo"]): (float(seen["pixel"][0]), float(seen["pixel"][1]))
                for seen in point["observations"]
                if seen.get("automatic") and seen["photo"] in photos
            }
            if pixels and point["name"] in names:
                found[str(point["name"])] = pixels
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise SplatpipeError(f"The control {control} cannot be read: {error}", "Run with --rerun georef.") from error
    return found


def _without_missing_control(config: LineConfig) -> LineConfig:
    """The options of a run; if its GCP file was deleted, a new one is started in its place."""
    setting = config.georef.control
    if setting in (AUTO, NONE) or Path(setting).is_file():
        return config
    return config.model_copy(update={"georef": config.georef.model_copy(update={"control": NONE})})


def _frame(model: SparseModel, positions: Positions, config: GeorefConfig, photos: Mapping[str, Photo]) -> Frame | None:
    try:
        return georeference(model, positions, config.max_position_error_m, photos)[0]
    except FrameUndeterminedError:
        return None


def _text_and_points(
    run: RunFolder,
    control: Path | None,
    points_file: Path | None,
    place: tuple[Path, GeorefConfig],
    photos: Mapping[str, Photo],
) -> tuple[ControlText, tuple[SurveyedPoint, ...]]:
    """The file for the marks, and the points of both files."""
    folder, config = place
    find = NameFinder(sorted(photos))
    stated = read_points_file(points_file) if points_file is not None else None
    as_csv = stated is not None and any(p.role is not None or p.sigma_m != (None, None) for p in stated.points)
    path = control or _new_file(run, folder, config, CSV_NAME if as_csv else LIST_NAME)
    if path.is_file():
        text = ControlText.read(path, find)
        known = (*(read_control_file(path).points if text.table.rows else ()), *text.unmarked)
    elif stated is not None:
        text, known = ControlText.begin(path, stated.crs.text, as_csv, find), ()
    else:
        raise UsageError(
            "There are no points to mark: the run has no control file.",
            hint="Give their names and coordinates: --points FILE, a first line with the CRS (EPSG:25832), then a CSV"
            " with the header name,x,y,z.",
        )
    if stated is not None and stated.crs != crs_of(text.path, text.table):
        raise UsageError(
            f"{points_file} is in {stated.crs.text}, and {text.path} in {text.table.crs}.",
            hint="One control file has one CRS: convert the points to it.",
        )
    return text, _merge_points(known, () if stated is None else stated.points, text.path)


def _merge_points(
    known: Sequence[SurveyedPoint], stated: Sequence[SurveyedPoint], path: Path
) -> tuple[SurveyedPoint, ...]:
    """The points of the GCP file, then those that it does not have yet."""
    by_name = {point.name: point for point in known}
    for point in stated:
        mine = by_name.setdefault(point.name, replace(point, marks=()))
        off = max(abs(mine.x - point.x), abs(mine.y - point.y), abs((mine.z or 0.0) - (point.z or 0.0)))
        if off > SAME_PLACE_M:
            raise UsageError(
                f"{point.name} has other coordinates in {path} than in the file of points.",
                hint="Each name must be one point: correct one of the two files.",
            )
    return tuple(by_name.values())


def _new_file(run: RunFolder, folder: Path, config: GeorefConfig, name: str) -> Path:
    """The path of a new GCP file: beside the photos or, if not writable, in OUT."""
    if config.control not in (AUTO, NONE):
        return Path(config.control)
    return (folder if os.access(folder, os.W_OK) else run.out) / name


def _command(run: RunFolder, path: Path, setting: str, control: Path | None) -> str:
    """The command that applies the marks; it names the file unless the run finds it automatically."""
    named = GEOREF.files["control"].names
    found = control is not None or (setting == AUTO and path.name in named and path.parent != run.out)
    return f"splatpipe georef {_quote(run.out)}" + ("" if found else f" --gcp {_quote(path)}")


def _quote(path: Path) -> str:
    return shlex.quote(str(path))
