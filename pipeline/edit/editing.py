"""Runs an edit from one splat file to another: the steps in order, the output, the record and the images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from splatpipe.pipeline.edit.clean import Clean
from splatpipe.pipeline.edit.merge import Merge, origin_of
from splatpipe.pipeline.edit.pictures import PictureCameras, Points, choose_views, picture, write_side_by_side
from splatpipe.pipeline.edit.record import Edit, with_edits, write_record
from splatpipe.pipeline.edit.size import OutputFile
from splatpipe.pipeline.edit.sources import SPLAT, STAGES, SplatSource, is_run, open_source
from splatpipe.pipeline.edit.workpiece import Workpiece, between
from splatpipe.pipeline.engine.digests import file_digest
from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError, UsageError
from splatpipe.pipeline.engine.files.durable import beside
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.pixels.images import Pixels
from splatpipe.pipeline.splat.containers.bounded import keep_unusable, usable
from splatpipe.pipeline.splat.formats.files import write_scene
from splatpipe.pipeline.splat.model.position_cost import PositionCost
from splatpipe.pipeline.splat.model.scene import Scene, SplatOrigin

RECORD, PICTURE = ".edits.json", ".edit.png"


@runtime_checkable
class Step(Protocol):
    """One step of an edit."""

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Apply the step; returns its record as a small JSON object."""
        ...


@dataclass(frozen=True)
class EditTask:
    """An edit to run.

    Attributes:
        source: The splat to edit.
        output: The file to write.
        steps: The steps, in order.
        pictures: Whether to write before-and-after images.
    """

    source: SplatSource
    output: OutputFile
    steps: Sequence[Step]
    pictures: bool = True

    def beside(self, ending: str) -> Path:
        """Path of a file beside the output, with the same stem and another ending."""
        path = self.output.path
        return path.with_name(path.name.removesuffix(self.output.kind.ending) + ending)


@dataclass(frozen=True, eq=False)
class _SplatExtent:
    """A splat's sampled centres, place and size, for the images."""

    points: Points
    place: SplatOrigin | None
    count: int


def edit_splat(task: EditTask, report: Reporter) -> dict[str, Any]:
    """Edit a splat: read it, apply the steps, and write the result, the record and the images.

    Args:
        task: The edit.
        report: Receives the progress and warnings.

    Returns:
        A summary as a JSON object.

    Raises:
        SplatpipeError: if a step cannot be applied; then nothing is written.
        MachineError: if something cannot be written.
    """
    require_free(task)
    total = len(task.steps) + 1 + task.pictures
    report.progress(0, total, "reading", "steps")
    digest = task.source.digest()
    whole, unusable = _read(task)
    for note in whole.notes:
        report.warning(note)
    piece = Workpiece(whole)
    del whole  # changed in place
    before = _SplatExtent(piece.sample(), piece.facts.place, len(piece))
    edits = [*unusable, *_take_steps(task, piece, total, report)]
    scene = piece.scene()
    _require_finite(scene)
    scene = Scene(scene.gaussians, with_edits(scene.facts, edits))
    after = _SplatExtent(piece.sample(), scene.facts.place, len(piece))
    del piece
    cost = _write(task, scene)
    for warning in cost.warnings():
        report.warning(warning)
    write_record(task.beside(RECORD), task.source, digest, edits, _made(task, after.count))
    outputs = [task.output.path, task.beside(RECORD)]
    facts = scene.facts
    if task.pictures:
        report.progress(total - 1, total, "drawing", "steps")
        views = _views(task, before, after)
        try:
            right = picture(scene, views.after, after.points, f"after: {after.count:,} Gaussians")
            del scene  # the one read next is as large
            _write_picture(task, views, before, right)
            outputs.append(task.beside(PICTURE))
        except SplatpipeError as error:
            report.warning(f"No pictures were written: {error.message}", error.hint)
    report.progress(total, total, "done", "steps")
    placed = None if facts.place is None else [facts.place.latitude, facts.place.longitude, facts.place.height_m]
    return {
        "steps": edits,
        "gaussians": after.count,
        "place": placed,
        "format": task.output.kind.name,
        **cost.summary(facts),
        "outputs": [str(path) for path in outputs],
    }


def _read(task: EditTask) -> tuple[Scene, list[Edit]]:
    """The splat; if it is to be cleaned, without Gaussians that have unusable values, and the record of these.

    Raises:
        SplatpipeError: if it is broken, or nothing is left.
    """
    if not any(isinstance(step, Clean) for step in task.steps):
        scene = task.source.read()
        if not len(scene.gaussians):
            raise SplatpipeError(f"{task.source.name} has no Gaussians.", hint="Name another splat.")
        return scene, []
    scene = task.source.read(keep_unusable)
    count, good = len(scene.gaussians), usable(scene.gaussians)
    left = int(good.sum())
    if not left:
        raise SplatpipeError(f"{task.source.name} has no Gaussians with usable values.", hint="Name another splat.")
    if left == count:
        return scene, []
    kept = replace(scene, gaussians=scene.gaussians.select(good))
    return kept, [{"step": "drop unusable values", "gaussians": [count, left]}]


def _take_steps(task: EditTask, piece: Workpiece, total: int, report: Reporter) -> list[Edit]:
    edits: list[Edit] = []
    for number, step in enumerate(task.steps, start=1):
        count, earlier_notes = len(piece), len(piece.notes)
        edits.append({**step.apply(piece), "gaussians": [count, len(piece)]})
        report.progress(number, total, str(edits[-1]["step"]), "steps")
        for note in piece.notes[earlier_notes:]:
            report.warning(note)
    return edits


def _made(task: EditTask, count: int) -> dict[str, Any]:
    made = {"name": task.output.path.name, "format": task.output.kind.name, "gaussians": count}
    return {**made, "sha256": file_digest(task.output.path)} if task.output.path.is_file() else made


def require_free(task: EditTask) -> None:
    """Check that there are steps and that the output overwrites neither an input nor anything of a run.

    Raises:
        UsageError: if there is no step, or the output is any of these or a non-empty folder.
    """
    if not task.steps:
        raise UsageError("No edit step is given.", hint="Give a step, such as --crop-polygon FILE; see --help.")
    out = task.output.path.resolve()
    read = [task.source.path, *(open_source(step.path).path for step in task.steps if isinstance(step, Merge))]
    if any(path.resolve() == out for path in read):
        raise UsageError(
            f"{task.output.path} is an input of this edit.", hint="Write to another file: IN must not be overwritten."
        )
    if out.is_dir() and (any(out.iterdir()) or task.output.kind.ending):
        raise UsageError(f"{task.output.path} is a folder.", hint="Name a new file, such as edited.ply.")
    run = next((folder for folder in out.parents if is_run(folder)), None)
    if run is None:
        return
    inside = out.relative_to(run)
    own = inside.parts[0] == STAGES or any(part.startswith(".") for part in inside.parts) or inside == Path(SPLAT)
    beside = [task.beside(RECORD), task.beside(PICTURE)]
    if own or (any(path.exists() for path in [out, *beside]) and not task.beside(RECORD).is_file()):
        raise UsageError(
            f"{task.output.path} belongs to the run in {run}, which edit does not change.",
            hint="Name a new file, such as edited.ply.",
        )


def _require_finite(scene: Scene) -> None:
    bad = len(scene.gaussians) - int(scene.gaussians.finite().sum())
    if bad:
        raise SplatpipeError(
            f"A file cannot hold the values of {bad} of {len(scene.gaussians)} Gaussians.",
            hint="Scale or move it by less.",
        )


def _write(task: EditTask, scene: Scene) -> PositionCost:
    """Write the output atomically; returns what its positions have lost."""
    path = task.output.path
    try:
        with beside(path) as aside:
            return write_scene(aside, scene, task.output.kind)
    except OSError as error:
        raise MachineError(f"Cannot write {path}: {error.strerror}.", hint="Check the free space.") from error


def _views(task: EditTask, before: _SplatExtent, after: _SplatExtent) -> PictureCameras:
    """Choose the viewpoints; each is returned in the frame of the splat it shows."""
    to_after = _between(before.place, after.place)
    poses = ((camera, to_after.camera_pose(camera.cam_from_world)) for camera in task.source.cameras())
    cameras = [replace(camera, cam_from_world=pose) for camera, pose in poses]
    views = choose_views(cameras, to_after.apply(before.points), after.points)
    back = to_after.inverse().camera_pose(views.before.cam_from_world)
    return replace(views, before=replace(views.before, cam_from_world=back))


def _write_picture(task: EditTask, views: PictureCameras, before: _SplatExtent, right: Pixels) -> None:
    """Read the original again, and write its image beside that of the result."""
    left = picture(_read(task)[0], views.before, before.points, f"before: {before.count:,} Gaussians")
    try:
        write_side_by_side(task.beside(PICTURE), left, right)
    except OSError as error:
        raise MachineError(f"Cannot write the picture: {error.strerror}.", hint="Check the free space.") from error


def _between(before: SplatOrigin | None, after: SplatOrigin | None) -> Similarity:
    if before is None or after is None:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    return between(origin_of(before), origin_of(after))
