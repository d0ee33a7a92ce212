"""Compare a run's mesh with its splat at the held-out views: ``mesh_views OUT WORK``.

The mesh of the finished run OUT is coloured again without the held-out photos: with textures, and with colours of its
vertices. Both are drawn at the views that `evaluate` judged, at the same size, and measured as `evaluate` measures the
splat's renders, which are taken from the run: over the pixels that the mesh fills, and over all. Pixels without a mesh
are black. ``shown`` is the share of the view that each fills: for the splat, where it has a median depth. WORK receives
the textures and the pictures: ``NAME.photo.png``, ``.splat.png``, ``.textured.png``, ``.vertices.png``, and
``.shown.png`` (white where the mesh is).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from mesh_renders import MeshScene, texture_shade, vertex_shade
from opened_run import OpenedRun, open_run
from tables import Row, print_table

from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.photos.pixels.dataset import View, load_split, load_views
from splatpipe.pipeline.photos.pixels.images import reduced_view
from splatpipe.pipeline.render.options import JUDGED_MEGAPIXELS
from splatpipe.pipeline.splat.quality import metrics
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet
from splatpipe.pipeline.surface.depths.run_sources import open_surveyed
from splatpipe.pipeline.surface.shapes.point_colours import photo_set
from splatpipe.pipeline.surface.shapes.surface_mesh import vertex_colours
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh
from splatpipe.pipeline.surface.texture.texture import TextureTask, texture_mesh
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh, load_textured_mesh
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.stages.line import EVALUATE, LINE, MESH

KINDS = ("splat", "textured", "vertices")
METRICS = ("psnr_cc", "ssim", "sharpness")
COLUMNS = {
    "view": "view:",
    "of": "of:",
    "shown": "shown:.3f",
    "psnr_cc": "psnr_cc:.2f",
    "SSIM": "ssim:.3f",
    "sharpness": "sharpness:.3f",
    "all: psnr_cc": "all_psnr_cc:.2f",
    "all: SSIM": "all_ssim:.3f",
    "all: sharpness": "all_sharpness:.3f",
}
DEMANDS = {"what": "what:", "found": "found:.3f", "bound": "bound:", "holds": "holds:"}
MEGA = 1_000_000


class _Quiet:
    """A reporter that says nothing."""

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None: ...
    def metric(self, name: str, value: float, step: int | None = None) -> None: ...
    def warning(self, message: str, hint: str = "") -> None: ...
    def note(self, message: str) -> None: ...


@dataclass(frozen=True, eq=False)
class RunMesh:
    """A finished run with a mesh.

    Attributes:
        parts: Paths of its parts, by name.
        photos_dir: The user's photos.
        held_out: Names of the held-out photos.
        texture_megapixels: The run's own limit.
    """

    parts: Mapping[str, Path]
    photos_dir: Path
    held_out: frozenset[str]
    texture_megapixels: float


def open_run_mesh(out: Path) -> RunMesh:
    """Open a run.

    Raises:
        UsageError: if it has no mesh or no held-out views.
    """
    run = open_run_folder(out, LINE)
    photos_dir, _ = run.settings()
    mesh = {name: part.path for name, part in run.lineage(MESH).items()}
    parts = {name: part.path for name, part in run.lineage(EVALUATE).items()} | mesh
    if "mesh.textured" not in mesh or "split.views" not in parts:
        raise UsageError(f"{out} has no mesh with textures, or no held-out views.")
    config = run.store.artifacts("mesh")[0].manifest["inputs"]["config"]
    held_out = frozenset(load_split(parts["split.views"]).held_out)
    return RunMesh(parts, photos_dir, held_out, float(config["texture_megapixels"]))


def colour_without(run: RunMesh, work: Path, threads: int) -> tuple[TexturedMesh, Row]:
    """Colour a run's mesh without its held-out photos.

    Returns:
        The mesh, its vertices coloured likewise, and the seconds of CPU that both took.
    """
    made = load_textured_mesh(run.parts["mesh.textured"], run.parts["mesh.files"])
    inputs = Inputs(parts=run.parts, photos_dir=run.photos_dir, machine=Machine(threads=threads))
    opened = open_surveyed(True, inputs, _Quiet())
    if made is None or opened is None:
        raise UsageError("The run's mesh is empty.")
    surface, site, _ = opened
    work.mkdir(parents=True, exist_ok=True)
    began = time.process_time()
    photos: PhotoSet = photo_set(
        [source for source in surface.photos if source.camera.name not in run.held_out], 2.0 * site.gsd_m, threads
    )
    coloured = ColouredMesh(made.coloured.mesh, vertex_colours(photos, made.coloured.mesh, threads))
    between = time.process_time()
    task = TextureTask(photos, site.gsd_m, run.texture_megapixels * MEGA, threads)
    textured = texture_mesh(task, coloured, work, work, _Quiet())
    return textured, {"vertices": between - began, "textured": time.process_time() - between}


def judged(run: RunMesh) -> list[tuple[str, View]]:
    """File stems and views that `evaluate` judged."""
    stems = {each["name"]: each["file"] for each in read_json(run.parts["evaluate.metrics"])["per_view"]}
    views = load_views(run.parts["undistort.dataset"])
    return [(stems[view.camera.name], view) for view in views if view.camera.name in stems]


def draw_views(run: RunMesh, made: TexturedMesh, splat_run: OpenedRun, folder: Path) -> list[Row]:
    """Draw and measure all judged views; returns a row for each view and kind."""
    scene, frame = MeshScene(made.coloured.mesh), load_frame(run.parts["georef.frame"])
    shades = {"textured": texture_shade(made), "vertices": vertex_shade(made.coloured)}
    rows: list[Row] = []
    for stem, view in judged(run):
        camera, photo, mask = reduced_view(view, JUDGED_MEGAPIXELS)
        pose = frame.world_from_model.camera_pose(camera.cam_from_world)
        local = replace(camera, cam_from_world=pose)
        drawn = {kind: scene.camera_view(local, shade) for kind, shade in shades.items()}
        shown = drawn["textured"].there
        splat = cv2.imread(str(run.parts["evaluate.views"] / f"{stem}.render.png"))
        pictures = {"splat": np.ascontiguousarray(splat[..., ::-1])}
        pictures |= {kind: each.picture for kind, each in drawn.items()}
        filled = dict.fromkeys(KINDS, float(shown.mean()))
        filled["splat"] = float((splat_run.median_depth(camera) > 0.0).mean())
        for kind in KINDS:
            row: Row = {"view": stem, "of": kind, "shown": filled[kind]}
            rows.append(row | _figures((pictures[kind], photo, mask), shown))
        for name, picture in {"photo": photo, **pictures, "shown": np.where(shown, 255, 0).astype(np.uint8)}.items():
            cv2.imwrite(str(folder / f"{stem}.{name}.png"), picture[..., ::-1] if picture.ndim == 3 else picture)
    return rows


def _figures(
    pictures: tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None],
    shown: Bool[np.ndarray, "h w"],
) -> Row:
    """Figures over the pixels that the mesh fills, and over all."""
    render, photo, mask = pictures
    inside, whole = measure(render, photo, shown if mask is None else shown & mask), measure(render, photo, mask)
    return inside | {f"all_{name}": value for name, value in whole.items()}


def measure(
    render: UInt8[np.ndarray, "h w 3"], photo: UInt8[np.ndarray, "h w 3"], counts: Bool[np.ndarray, "h w"] | None
) -> Row:
    """Measure a picture as `evaluate` does, by fewer metrics."""
    x, y = (torch.from_numpy(pixels.astype(np.float32) / np.float32(255.0)) for pixels in (render, photo))
    pair = metrics.pair_of(x, y, None if counts is None else torch.from_numpy(counts))
    return {name: float(metrics.METRICS[name].of_pair(pair)) for name in METRICS}


def mean_rows(rows: list[Row]) -> list[Row]:
    """The means of all views, a row for each kind."""
    means: list[Row] = []
    for kind in KINDS:
        own = [row for row in rows if row["of"] == kind]
        keys = [key for key in own[0] if key not in ("view", "of")]
        means.append({"view": "mean", "of": kind} | {key: float(np.mean([row[key] for row in own])) for key in keys})
    return means


def judge(means: list[Row]) -> list[Row]:
    """What issue 50 demands of the textures."""
    _, textured, vertices = means
    figures = (
        ("sharpness", textured["sharpness"], 0.75, 1.1),
        ("sharpness above that of vertex colours", textured["sharpness"] - vertices["sharpness"], 0.2, np.inf),
        ("SSIM above that of vertex colours", textured["ssim"] - vertices["ssim"], -0.01, np.inf),
        ("psnr_cc above that of vertex colours, dB", textured["psnr_cc"] - vertices["psnr_cc"], -1.0, np.inf),
    )
    return [
        {
            "what": what,
            "found": found,
            "bound": f"≥ {low:g}" + ("" if np.isinf(high) else f", ≤ {high:g}"),
            "holds": "yes" if low <= found <= high else "NO",
        }
        for what, found, low, high in figures
    ]


def compare_views(out: Path, work: Path, threads: int) -> tuple[list[Row], Row]:
    """Colour a run's mesh without its held-out photos and compare it with its splat at their views.

    Args:
        out: OUT of a run with a mesh.
        work: Folder for textures and pictures.
        threads: Photos in parallel.

    Returns:
        A row for each view and kind, and the CPU seconds that colours and textures took.
    """
    run = open_run_mesh(out)
    made, seconds = colour_without(run, work, threads)
    return draw_views(run, made, open_run(out), work), seconds


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path, help="OUT of a run with a mesh")
    options.add_argument("work", type=Path, help="folder for textures and pictures")
    options.add_argument("--threads", type=int, default=2)
    options.add_argument("--json", type=Path)
    arguments = options.parse_args()
    try:
        rows, seconds = compare_views(arguments.out, arguments.work, arguments.threads)
    except SplatpipeError as error:
        options.exit(error.exit_code, f"{error.message} {error.hint}\n")
    means = mean_rows(rows)
    demands = judge(means)
    print_table("held-out views: pixels that the mesh fills, and all", [*rows, *means], COLUMNS)
    print(f"CPU seconds: vertex colours {seconds['vertices']:.1f}, textures {seconds['textured']:.1f}")
    print_table("what issue 50 demands", demands, DEMANDS)
    if arguments.json:
        report = {"views": rows, "means": means, "seconds": seconds, "demands": demands}
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
