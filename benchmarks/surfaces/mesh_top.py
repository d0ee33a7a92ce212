"""Draw a run's textured mesh from straight above and compare it with the demo's truth: ``mesh_top OUT --pictures F``.

It is drawn on the grid of the run's orthophoto, and measured as `surface_truth` measures that: distances of roof edges,
targets and PSNR. OUT is a run on the demo capture with its control, an orthophoto and a mesh; F has the true image by
``python -m splatpipe.demo.truth.orthographic --only top``.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from mesh_renders import MeshScene, texture_shade
from mesh_views import DEMANDS, open_run_mesh
from surface_checks import measure_ortho, ortho_site
from surface_products import Raster, find_products, frames_of, read_raster
from surface_scene import load_truth
from surface_truth import ORTHO
from tables import Row, print_table

from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh, load_textured_mesh

ABOVE_M = 100.0  # of the highest vertex, where rays begin


def draw_from_above(made: TexturedMesh, grid: Raster, out: Path) -> Raster:
    """Draw a mesh on a raster's grid."""
    frames = frames_of(out, grid.crs, "none")
    height, width = grid.there.shape
    here = frames.run.crs_from_local(made.coloured.mesh.vertices[:1])[0, 2]
    rise = float(np.ptp(made.coloured.mesh.vertices[:, 2])) + ABOVE_M

    def origins(column: np.ndarray, row: np.ndarray) -> np.ndarray:
        places = np.stack([column.ravel(), row.ravel(), np.full(column.size, here + rise)], axis=1)
        return frames.run.local_from_crs(grid.from_grid(places)).reshape(*column.shape, 3)

    scene = MeshScene(made.coloured.mesh)
    view = scene.parallel_view(origins, np.array([0.0, 0.0, -1.0]), (width, height), texture_shade(made))
    return replace(grid, bands=np.moveaxis(view.picture, -1, 0), there=view.there)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path, help="OUT of a run on the demo capture with its control")
    options.add_argument("--pictures", type=Path, required=True, help="folder of true pictures")
    options.add_argument("--save", type=Path, help="picture to write")
    options.add_argument("--json", type=Path)
    arguments = options.parse_args()
    try:
        run = open_run_mesh(arguments.out)
        made = load_textured_mesh(run.parts["mesh.textured"], run.parts["mesh.files"])
        if made is None:
            raise UsageError("The run's mesh is empty.")
        row = measure_from_above(made, arguments.out, arguments.pictures, arguments.save)
    except SplatpipeError as error:
        options.exit(error.exit_code, f"{error.message} {error.hint}\n")
    demands = judge(row)
    print_table("the mesh from above", [row], ORTHO)
    print_table("what issue 50 demands", demands, DEMANDS)
    if arguments.json:
        arguments.json.write_text(json.dumps({"mesh": row, "demands": demands}, indent=1) + "\n", encoding="utf-8")


def measure_from_above(made: TexturedMesh, out: Path, pictures: Path, save: Path | None) -> Row:
    """Draw and measure a run's mesh; returns the figures of ``measure_ortho``."""
    drawn = draw_from_above(made, read_raster(find_products(out)["ortho"]), out)
    if save is not None:
        cv2.imwrite(str(save), np.moveaxis(drawn.bands, 0, -1)[..., ::-1])
    site = ortho_site(load_truth(), drawn, frames_of(out, drawn.crs, "none").crs_from_true)
    return measure_ortho(site, drawn, pictures / "top.png")[0]


def judge(row: Row) -> list[Row]:
    """What issue 50 demands of roof edges."""
    bounds = (("roof edges from above, median px", row.get("median"), 0.5), ("95 % px", row.get("p95"), 3.0))
    return [
        {
            "what": what,
            "found": found,
            "bound": f"≤ {bound:g}",
            "holds": "yes" if found is not None and found <= bound else "NO",
        }
        for what, found, bound in bounds
    ]


if __name__ == "__main__":
    main()
