"""Compare a run's surface products with the demo's truth: ``surface_truth OUT --pictures FOLDER --depths FOLDER``.

OUT may be any folder with some of ``dsm.tif``, ``ortho.tif``, ``facades.json``, ``mesh.ply`` (or ``.glb``) and
``cloud.laz``; missing ones are reported, and fail. Distances are normal to the true surface, in GSD of the original
photos. Places count if they lie below the flight (within the cameras' hull in plan), at least three photos truly see
them, and they are not within two cells of a height step, which are counted separately. Missing values count as wrong.

The true images are made by ``python -m splatpipe.demo.truth.orthographic`` (extra ``demo``), the true depths by
``python -m splatpipe.demo.truth.depth_maps`` (a CPU minute). Without the images, PSNR, edges and contrasts are not
measured, and fail; without the depths, they are computed at half the size. The run needs control: its products are
compared at their stated coordinates. ``--align cameras`` aligns it to the truth by its camera centres instead.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from surface_checks import (
    GSD_M,
    SEED,
    measure_dsm,
    measure_facades,
    measure_ortho,
    measure_points,
    ortho_site,
    true_surface_of,
)
from surface_products import (
    ProductTransform,
    find_products,
    frames_of,
    read_cloud,
    read_facades,
    read_mesh,
    read_raster,
)
from surface_scene import SceneTruth, load_truth, site_of
from tables import Row, print_table
from triangle_distances import areas, spread, surface_of

from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError

CRS = "EPSG:32633"  # the demo's, if no product states another
MAX_MESH_PLACES = 4_000_000
PRODUCTS = ("dsm", "ortho", "facades", "cloud", "mesh")

FIGURES = {
    "what": "what:",
    "cells": "cells:,",
    "complete": "complete:.3f",
    "bias GSD": "bias:.2f",
    "mean": "mean:.2f",
    "NMAD": "nmad:.2f",
    "p95": "p95:.2f",
    "in 2 GSD": "within_2:.3f",
    "in 2.5": "within_25:.3f",
    "in 3": "within_3:.3f",
}
CORNERS = {"corners": "corners:.2f"}
ORTHO = {
    "targets": "targets:",
    "found": "found:",
    "RMSE GSD": "rmse:.2f",
    "complete": "complete:.3f",
    "PSNR": "psnr:.2f",
    "psnr_cc": "psnr_cc:.2f",
    "edges": "edges:,",
    "median px": "median:.2f",
    "p95": "p95:.2f",
    "lost": "lost:.3f",
}
CONTRASTS = {"texture": "texture:", "pixels": "pixels:,"} | {
    f"{band} {what}": f"{band} {what}:.2f" for band in ("1-2 px", "2-4 px", "4-8 px") for what in ("contrast", "slope")
}
POINTS = {
    "what": "what:",
    "points": "points:,",
    "true places": "true places:,",
    "precision": "precision:.3f",
    "recall": "recall:.3f",
    "F1": "f1:.3f",
}
DEMANDS = {"what": "what:", "found": "found:.3f", "bound": "bound:", "holds": "holds:"}


@dataclass(frozen=True)
class Demand:
    """A bound that the issue sets.

    Attributes:
        what: What it applies to.
        table: Table with its figure.
        row: Row of that table.
        key: Key in that row.
        bound: Upper bound on the figure's magnitude, or lower bound.
        least: Whether it is a lower bound.
    """

    what: str
    table: str
    row: int | str
    key: str
    bound: float
    least: bool = False

    @property
    def product(self) -> str:
        """Return the product concerned."""
        if self.table == "points":
            return str(self.row)
        return "ortho" if self.table == "contrasts" else self.table

    def judge(self, tables: dict[str, list[Row]]) -> Row:
        """Return the row of the verdict; a missing figure fails."""
        rows = tables.get(self.table, [])
        found = [row for k, row in enumerate(rows) if self.row in (k, row.get("what"), row.get("texture"))]
        value = found[0].get(self.key) if found else None
        holds = value is not None and (value >= self.bound if self.least else abs(value) <= self.bound)
        sign = "≥" if self.least else "≤"
        return {"what": self.what, "found": value, "bound": f"{sign} {self.bound:g}", "holds": "yes" if holds else "NO"}


def _demands() -> list[Demand]:
    demands = []
    for what in ("roofs and ground", "roofs", "ground"):
        demands += [
            Demand(f"DSM, {what}: bias, GSD", "dsm", what, "bias", 0.5),
            Demand(f"DSM, {what}: NMAD, GSD", "dsm", what, "nmad", 0.7),
            Demand(f"DSM, {what}: within 3 GSD", "dsm", what, "within_3", 0.95, least=True),
            Demand(f"DSM, {what}: completeness", "dsm", what, "complete", 0.97, least=True),
        ]
    demands += [
        Demand("orthophoto: check points, RMSE GSD", "ortho", 0, "rmse", 1.0),
        Demand("orthophoto: PSNR, dB", "ortho", 0, "psnr", 24.0, least=True),
        Demand("orthophoto: roof edges, median px", "ortho", 0, "median", 1.0),
        Demand("orthophoto: roof edges, 95 % px", "ortho", 0, "p95", 3.0),
        Demand("orthophoto: contrast of tiles", "contrasts", "tiles", "1-2 px contrast", 0.7, least=True),
        Demand("orthophoto: contrast of slates", "contrasts", "slates", "1-2 px contrast", 0.7, least=True),
    ]
    for wall in ("south", "north", "west", "east"):
        demands += [
            Demand(f"façade {wall}: median, GSD", "facades", wall, "bias", 0.5),
            Demand(f"façade {wall}: NMAD, GSD", "facades", wall, "nmad", 0.7),
            Demand(f"façade {wall}: within 2.5 GSD", "facades", wall, "within_25", 0.95, least=True),
            Demand(f"façade {wall}: corners, GSD", "facades", wall, "corners", 2.0),
        ]
    return [
        *demands,
        Demand("plain walls: within 2 GSD", "facades", "plain walls", "within_2", 0.90, least=True),
        Demand("metal roof: within 2 GSD", "dsm", "metal roof", "within_2", 0.90, least=True),
        Demand("cloud: F1 at 2 GSD", "points", "cloud", "f1", 0.85, least=True),
        Demand("mesh: F1 at 2 GSD", "points", "mesh", "f1", 0.85, least=True),
    ]


DEMANDS_OF_THE_ISSUE = tuple(_demands())


def measure(
    out: Path, chosen: list[str], align: str, pictures: Path | None, depths: Path | None
) -> dict[str, list[Row]]:
    """Return the tables of all existing products.

    Args:
        out: OUT, or a folder with products.
        chosen: Products to measure.
        align: As ``frames_of`` takes it.
        pictures: Folder of the true images; None for none.
        depths: Folder of the true depths; None to compute them.

    Raises:
        UsageError: if there is nothing to measure.
    """
    products = {name: path for name, path in find_products(out).items() if name in chosen}
    if not products:
        raise UsageError(f"{out} has none of {', '.join(chosen)}.")
    truth = load_truth(depths)
    rasters = {name: read_raster(products[name]) for name in ("dsm", "ortho") if name in products}
    frames = frames_of(out, next((raster.crs for raster in rasters.values()), CRS), align)
    tables: dict[str, list[Row]] = {}
    if "dsm" in rasters:
        tables["dsm"] = measure_dsm(site_of(truth, rasters["dsm"], frames.crs_from_true), rasters["dsm"])
    if "ortho" in rasters:
        site = ortho_site(truth, rasters["ortho"], frames.crs_from_true)
        true = None if pictures is None else pictures / "top.png"
        row, tables["contrasts"] = measure_ortho(site, rasters["ortho"], true)
        tables["ortho"] = [row]
    if "facades" in products:
        tables["facades"] = measure_facades(truth, read_facades(products["facades"], frames.true_from_crs))
    rows = [
        _measure_cloud_or_mesh(name, products[name], truth, frames) for name in ("cloud", "mesh") if name in products
    ]
    return tables | ({"points": rows} if rows else {})


def _measure_cloud_or_mesh(name: str, path: Path, truth: SceneTruth, frames: ProductTransform) -> Row:
    surface, rng = true_surface_of(truth), np.random.default_rng(SEED)
    distances_to: Callable[[np.ndarray], np.ndarray]
    if name == "cloud":
        points = read_cloud(path, frames.true_from_crs, frames.true_from_local)
        distances_to = surface_of_points(points)
    else:
        corners = frames.true_from_local(read_mesh(path).reshape(-1, 3)).reshape(-1, 3, 3)
        spacing = max(GSD_M, float(np.sqrt(areas(corners).sum() / MAX_MESH_PLACES)))
        points, _ = spread(corners, round(float(areas(corners).sum()) / spacing**2), rng)
        distances_to = surface_of(corners, spacing, rng).distances
    return {"what": name} | measure_points(truth, surface, points, distances_to)


def surface_of_points(points: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that measures distances to the nearest of the points."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points, balanced_tree=False)
    return lambda places: np.asarray(tree.query(places)[0])


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path, help="OUT of a run on the demo capture with its control, or a folder")
    options.add_argument("--products", default=",".join(PRODUCTS), help="which to measure")
    options.add_argument("--pictures", type=Path, help="folder of true pictures, by splatpipe.demo.truth.orthographic")
    options.add_argument("--depths", type=Path, help="folder of true depths, by splatpipe.demo.truth.depth_maps")
    options.add_argument("--align", choices=("none", "cameras"), default="none")
    options.add_argument("--json", type=Path)
    arguments = options.parse_args()
    chosen = arguments.products.replace(" ", "").split(",")
    try:
        tables = measure(arguments.out, chosen, arguments.align, arguments.pictures, arguments.depths)
    except SplatpipeError as error:
        options.exit(error.exit_code, f"{error.message} {error.hint}\n")
    layouts = {"dsm": FIGURES, "ortho": ORTHO, "contrasts": CONTRASTS, "facades": FIGURES | CORNERS, "points": POINTS}
    for name, rows in tables.items():
        print_table(name, rows, layouts[name])
    missing = [name for name in chosen if name not in {*tables, *(row["what"] for row in tables.get("points", []))}]
    if missing:
        print(f"Not there: {', '.join(missing)}.")
    judged = [demand.judge(tables) for demand in DEMANDS_OF_THE_ISSUE if demand.product in chosen]
    print_table("what issue 18 demands", judged, DEMANDS)
    if arguments.json:
        text = json.dumps(tables | {"demands": judged}, indent=1)
        arguments.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
