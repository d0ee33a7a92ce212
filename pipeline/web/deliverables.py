"""The deliverables of a run besides `splat.ply`: files and folders by the names of their formats.

What only some formats need is imported when one of them is written: together it takes half a CPU second.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatpipe.pipeline.delivery.delivery_frame import cameras_json
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import write_json
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import Points
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS
from splatpipe.pipeline.splat.formats.files import write_scene
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene
from splatpipe.pipeline.splat.model.sh import C0
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.web.options import EXPORT, WEB
from splatpipe.pipeline.web.viewer import ViewerScene

if TYPE_CHECKING:
    from splatpipe.pipeline.splat.levels.levels import LevelNode
    from splatpipe.pipeline.surface.shapes.point_cloud import CloudChunk

DATASET, CENTRES, SPARSE = "dataset", "centres.laz", "sparse.laz"
MAX_CONFIDENCE = 255  # largest number of photos that fits in a byte


@dataclass(frozen=True, eq=False)
class RunSplat:
    """A run's splat with the data it was made from.

    Attributes:
        scene: The splat in the world frame, finite.
        frame: The frame of `georef`.
        dataset: The folder that `undistort` wrote.
        cameras: The photos' cameras, in the model frame.
        points: The sparse points, in the model frame.
        held_out: Names of the held-out photos.
        georeference: The content of `georef.json`.
        viewer: What the viewer pages show besides the splat.
    """

    scene: Scene
    frame: Frame
    dataset: Path
    cameras: Sequence[Camera]
    points: Points
    held_out: frozenset[str]
    georeference: Mapping[str, object]
    viewer: ViewerScene

    @cached_property
    def levels(self) -> LevelNode:
        """The splat's levels of detail, built once for all streamed formats."""
        from splatpipe.pipeline.splat.levels.levels import build_levels

        return build_levels(self.scene.gaussians)


def write_deliverables(names: Sequence[str], run: RunSplat, out: Path, report: Reporter) -> dict[str, int]:
    """Write each format into `export/` below a folder, and the web viewer into `web/`.

    Args:
        names: Names of the formats, each once.
        run: The run to export.
        out: The folder, laid out like OUT.
        report: Receives progress and warnings about formats that this run does not support.

    Returns:
        Bytes of each format that was written, by name.

    Raises:
        MachineError: if the disk is full or not writable.
    """
    sizes, folder = {}, out / EXPORT
    for done, name in enumerate(names):
        report.progress(done, len(names), f"writing {name}", "formats")
        folder.mkdir(parents=True, exist_ok=True)
        before = _bytes_below(out)
        try:
            if name == "web":
                from splatpipe.pipeline.web.site import write_site

                write_site(out / WEB, run.viewer, run.scene, run.levels)
            elif name == "tiles":
                _write_tiles(run, folder / "tiles", report)
            elif name == "streamed-sog":
                from splatpipe.pipeline.splat.levels.streamed_sog import write_streamed_sog

                write_streamed_sog(folder / name, run.scene, run.levels)
            else:
                for warning in _write(name, run, folder):
                    report.warning(f"{name}: {warning}")
        except SplatpipeError as error:
            if error.exit_code != SplatpipeError.exit_code:
                raise
            report.warning(f"{name} is left out: {error.message}", hint=error.hint)
            continue
        sizes[name] = _bytes_below(out) - before
    return sizes


def _write_tiles(run: RunSplat, folder: Path, report: Reporter) -> None:
    from splatpipe.pipeline.delivery.ecef_tiles import write_tiles_on_globe

    placement = write_tiles_on_globe(folder, run.scene, run.levels)
    if placement.approximate:
        report.note(f"3D Tiles: {placement.note}")


def _write(name: str, run: RunSplat, folder: Path) -> tuple[str, ...]:
    """Write a format; returns what the user has to know about it."""
    warnings: tuple[str, ...] = ()
    kind = next((each for each in SPLAT_FORMATS if each.name == name), None)
    if kind is not None:
        warnings = write_scene(folder / kind.file, run.scene, kind).warnings()
    if name == "model":
        _complete_model_folder(run, folder / "model")
    elif name == "colmap":
        from splatpipe.pipeline.delivery.trainer_dataset import write_colmap

        write_colmap(run.dataset, run.frame, folder / DATASET)
    elif name == "transforms":
        from splatpipe.pipeline.delivery.trainer_dataset import write_transforms

        write_transforms(run.dataset, run.frame, run.held_out, folder / DATASET)
    elif name == "laz":
        _write_clouds(run, folder)
    if name in ("model", "colmap", "transforms"):  # these formats cannot store it themselves
        write_json(folder / ("model" if name == "model" else DATASET) / "georef.json", dict(run.georeference))
    return warnings


def _complete_model_folder(run: RunSplat, folder: Path) -> None:
    """Write the files that 3DGS trainers put beside the splat."""
    from splatpipe.pipeline.delivery.trainer_dataset import write_points_ply

    write_json(folder / "cameras.json", cameras_json(run.cameras, run.frame))
    write_points_ply(folder / "input.ply", run.points, run.frame)


def _write_clouds(run: RunSplat, folder: Path) -> None:
    """Write the splat's centres and the sparse points as point clouds, in the run's CRS."""
    from splatpipe.pipeline.surface.rasters.map_crs import open_map
    from splatpipe.pipeline.surface.shapes.point_cloud import CloudChunk, CloudFrame, write_cloud

    frame = CloudFrame.of_crs(open_map(run.frame))
    write_cloud(folder / CENTRES, _centres(run.scene.gaussians), frame)
    usable = np.isfinite(run.points.xyz).all(axis=1)
    xyz = run.frame.world_from_model.apply(run.points.xyz[usable])
    seen = np.minimum(run.points.track_lengths[usable], MAX_CONFIDENCE).astype(np.uint8)
    chunk = CloudChunk(xyz, run.points.rgb[usable], np.zeros(xyz.shape, np.float32), seen)
    write_cloud(folder / SPARSE, [chunk], frame)


def _centres(gaussians: Gaussians) -> Iterator[CloudChunk]:
    """Yield the Gaussians' centres in their view-independent (SH degree 0) colour, with a confidence of 0 (unknown)."""
    from splatpipe.pipeline.surface.shapes.point_cloud import CloudChunk

    for piece in gaussians.pieces():
        xyz = piece.means.double().numpy()
        colours = np.rint((0.5 + C0 * piece.sh[:, 0].double().numpy()).clip(0.0, 1.0) * 255.0).astype(np.uint8)
        yield CloudChunk(xyz, colours, np.zeros(xyz.shape, np.float32), np.zeros(len(xyz), np.uint8))


def _bytes_below(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
