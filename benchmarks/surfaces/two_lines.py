"""Compare the two pipelines: photos → dense cloud → mesh → orthophoto, and photos → splat → the same products.

``two_lines --photos OUT --splat OUT --pictures FOLDER --depths FOLDER`` compares finished runs on the demo capture
from the same cameras: ``--photos`` with surfaces from the photos' depths, ``--splat`` with those from the splat's.
Either may be omitted. ``--views FOLDER`` compares the first run's textured mesh with its splat at the held-out views
(``mesh_views``), whose pictures it writes to the folder; ``side_by_side`` draws parts of them for people.
``--without-truth`` takes runs on any capture, and compares only stages and views. ``--poisson FOLDER`` adds a mesh by
``poisson_mesh`` of the first pipeline's cloud. Nothing is run: times and memory are taken from the runs' manifests, for
the machine that they name.

The first table lists the stages of each pipeline, shared ones once; the second, the products' size, completeness, and
accuracy against the truth by ``surface_truth``. The third has the figures that the paper that splatpipe follows
published for three buildings, on other hardware.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mesh_views import COLUMNS as VIEW_COLUMNS
from mesh_views import compare_views, mean_rows
from surface_products import find_products
from surface_truth import PRODUCTS, measure
from tables import Row, print_table

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.engine.runs.store import Artifact
from splatpipe.stages.line import LINE

SHARED = ("ingest", "features", "matches", "sparse", "control", "targets", "georef", "undistort")
SPLAT_ONLY = ("split", "initialize", "blocks", "train", "evaluate")
STAGES = {
    "line": "line:",
    "stage": "stage:",
    "CPU s": "cpu:,.0f",
    "wall s": "seconds:,.0f",
    "peak MB": "peak:MB",
    "files MB": "bytes:MB",
    "machine": "machine:",
}
FIGURES = {
    "product": "product:",
    "line": "line:",
    "MB": "bytes:MB",
    "complete": "complete:.3f",
    "what": "what:",
    "found": "found:.3f",
}
PUBLISHED = [
    {"building": number, "splat": splat, "classical": classical, "on": "RTX 3090"}
    for number, splat, classical in ((1, 28, 42), (2, 25, 47), (3, 35, 51))
]
VIEW_THREADS = 2
PUBLISHED_COLUMNS = {
    "building": "building:",
    "splat, min": "splat:",
    "classical, min": "classical:",
    "hardware": "on:",
}
# From each table of surface_truth: the row, the key, and its label.
TABLE_COLUMNS = {
    "dsm": (
        ("roofs and ground", "nmad", "NMAD, GSD"),
        ("roofs and ground", "bias", "bias, GSD"),
        ("roofs and ground", "within_3", "share within 3 GSD"),
        ("metal roof", "within_2", "metal roof: share within 2 GSD"),
    ),
    "ortho": (
        (None, "rmse", "check points, RMSE GSD"),
        (None, "psnr", "PSNR, dB"),
        (None, "p95", "roof edges, 95 % px"),
    ),
    "facades": (
        ("all walls", "nmad", "NMAD, GSD"),
        ("all walls", "within_25", "share within 2.5 GSD"),
        ("plain walls", "within_2", "plain walls: share within 2 GSD"),
    ),
    "points": (
        (None, "precision", "precision at 2 GSD"),
        (None, "recall", "recall at 2 GSD"),
        (None, "f1", "F1 at 2 GSD"),
    ),
}


def stage_rows(line: str, artifacts: Mapping[str, Artifact]) -> list[Row]:
    """Return a row for each finished stage: time, memory and files from its manifest.

    Args:
        line: Name of the pipeline; a stage that both need has none.
        artifacts: Artifacts by stage name, in the pipeline's order.
    """
    rows = []
    for name, artifact in artifacts.items():
        manifest: Mapping[str, Any] = artifact.manifest
        machine = manifest["machine"]
        rows.append(
            {
                "line": "both" if name in SHARED else line,
                "stage": name,
                "cpu": manifest.get("cpu_seconds"),
                "seconds": manifest.get("seconds"),
                "peak": manifest.get("peak_memory_bytes"),
                "bytes": sum(file["size"] for part in manifest["parts"].values() for file in part["files"]),
                "machine": f"{machine['processor']}, {machine['threads']} threads, {machine['device']}",
            }
        )
    return rows


def finished_stages(out: Path, without: tuple[str, ...]) -> dict[str, Artifact]:
    """Return the latest artifact of each stage that a run finished."""
    store = open_run_folder(out, LINE).store
    found = {stage.name: store.artifacts(stage.name) for stage in LINE if stage.name not in without}
    return {name: artifacts[0] for name, artifacts in found.items() if artifacts}


def product_rows(line: str, out: Path, tables: Mapping[str, list[Row]]) -> list[Row]:
    """Return a row for each figure of a pipeline's products, with the product's size in its first row.

    Args:
        line: Name of the pipeline.
        out: Folder of its products.
        tables: Tables from ``surface_truth.measure``.
    """
    rows: list[Row] = []
    files = find_products(out)
    for table, columns in TABLE_COLUMNS.items():
        for row in tables.get(table, []):
            wanted = [(key, what) for of, key, what in columns if of in (None, row.get("what"))]
            product = row["what"] if table == "points" else table
            for key, what in wanted:
                figure: Row = {"product": product, "line": line, "what": what, "found": row.get(key)}
                if not any(each["product"] == product for each in rows):
                    figure |= {"bytes": files[product].stat().st_size, "complete": row.get("complete")}
                rows.append(figure)
    return rows


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--photos", type=Path, help="OUT with surfaces of the photos' depths")
    options.add_argument("--splat", type=Path, help="OUT with surfaces of the splat's depths")
    options.add_argument("--views", type=Path, help="folder for pictures of the held-out views")
    options.add_argument("--without-truth", action="store_true", help="the runs are not on the demo capture")
    options.add_argument("--poisson", type=Path, help="folder of a Poisson mesh of the first line's cloud")
    options.add_argument("--pictures", type=Path, help="folder of true pictures, by splatpipe.demo.truth.orthographic")
    options.add_argument("--depths", type=Path, help="folder of true depths, by splatpipe.demo.truth.depth_maps")
    options.add_argument("--json", type=Path)
    arguments = options.parse_args()
    lines = {"photos": arguments.photos, "splat": arguments.splat}
    stages: list[Row] = []
    products: list[Row] = []
    views: list[Row] = []
    seconds: Row = {}
    try:
        for line, out in lines.items():
            if out is None:
                continue
            rows = stage_rows(line, finished_stages(out, SPLAT_ONLY if line == "photos" else ()))
            known = {row["stage"] for row in stages if row["line"] == "both"}
            stages += [row for row in rows if row["stage"] not in known]
            if not arguments.without_truth:
                tables = measure(out, list(PRODUCTS), "none", arguments.pictures, arguments.depths)
                products += product_rows(line, out, tables)
        if arguments.views is not None and arguments.photos is not None:
            views, seconds = compare_views(arguments.photos, arguments.views, VIEW_THREADS)
        if arguments.poisson is not None:
            tables = measure(arguments.poisson, ["mesh"], "none", None, arguments.depths)
            products += product_rows("Poisson", arguments.poisson, tables)
    except SplatpipeError as error:
        options.exit(error.exit_code, f"{error.message} {error.hint}\n")
    print_table("what each line takes", stages, STAGES)
    if products:
        print_table("what it gives", sorted(products, key=lambda row: str(row["product"])), FIGURES)
    if views:
        print_table("at the held-out views", [*views, *mean_rows(views)], VIEW_COLUMNS)
        print(f"CPU seconds: vertex colours {seconds['vertices']:.1f}, textures {seconds['textured']:.1f}")
    print_table("published: minutes for a building, photos to products", PUBLISHED, PUBLISHED_COLUMNS)
    if arguments.json:
        report = {"stages": stages, "products": products, "views": views, "published": PUBLISHED}
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
