"""The table of the two pipelines: figures of the manifests, and measured ones."""

from pathlib import Path

from two_lines import product_rows, stage_rows

from splatpipe.pipeline.engine.runs.store import Artifact

MACHINE = {"processor": "x86_64", "threads": 2, "device": "cpu"}


def artifact(cpu: float, sizes: tuple[int, ...]) -> Artifact:
    files = [{"path": f"{size}", "size": size, "sha256": ""} for size in sizes]
    parts = {"one": {"path": "one", "digest": "", "files": files}}
    manifest = {
        "cpu_seconds": cpu,
        "seconds": cpu / 2.0,
        "peak_memory_bytes": 5_000_000,
        "machine": MACHINE,
        "parts": parts,
    }
    return Artifact(Path(), manifest)


def test_stages_of_both_pipelines_belong_to_neither() -> None:
    rows = stage_rows("photos", {"sparse": artifact(8.0, (1,)), "depths": artifact(90.0, (10, 20))})
    assert [(row["line"], row["stage"], row["cpu"], row["bytes"]) for row in rows] == [
        ("both", "sparse", 8.0, 1),
        ("photos", "depths", 90.0, 30),
    ]
    assert rows[0]["machine"] == "x86_64, 2 threads, cpu"


def test_figures_are_in_their_products_row(tmp_path: Path) -> None:
    (tmp_path / "mesh.ply").write_bytes(b"ply" * 100)
    (tmp_path / "dsm.tif").write_bytes(b"tif")
    tables = {
        "dsm": [
            {"what": "roofs", "nmad": 9.0},
            {"what": "roofs and ground", "nmad": 0.4, "bias": 0.1, "within_3": 0.97, "complete": 0.98},
        ],
        "points": [{"what": "mesh", "precision": 0.9, "recall": 0.8, "f1": 0.847}],
    }
    rows = product_rows("splat", tmp_path, tables)
    assert [(row["product"], row["found"]) for row in rows] == [
        ("dsm", 0.4),
        ("dsm", 0.1),
        ("dsm", 0.97),
        ("mesh", 0.9),
        ("mesh", 0.8),
        ("mesh", 0.847),
    ]
    assert rows[0]["bytes"] == 3 and rows[0]["complete"] == 0.98 and "bytes" not in rows[1] and rows[3]["bytes"] == 300
