"""What must be done in one place, since files of others are read there, is done nowhere else."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[3]
COPIES = ("model", "reconstruction", "self.model")  # names of models in memory


def calls(name: str) -> Iterator[tuple[str, ast.Call]]:
    """Calls of a function like ``module.function``, and the files they are in."""
    for path in sorted([*ROOT.glob("pipeline/**/*.py"), *ROOT.glob("stages/**/*.py")]):
        text = path.read_text(encoding="utf-8")
        if not all(word in text for word in name.split(".")):
            continue  # cannot call it, and needs no parsing
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == name:
                yield str(path.relative_to(ROOT)), node


def test_colmap_models_are_read_after_a_check() -> None:
    read = {
        path for path, call in calls("pycolmap.Reconstruction") if call.args and ast.unparse(call.args[0]) not in COPIES
    }
    assert read == {
        "pipeline/photos/colmap/colmap_reconstruction.py",
        "pipeline/sfm/model/sparse_model.py",
    }  # which just wrote it


def test_pictures_of_users_are_opened_in_one_place() -> None:
    assert {path for path, _ in calls("Image.open")} == {
        "pipeline/photos/files/picture_file.py",
        "pipeline/app/preflight/sizing.py",  # reads headers only
        "pipeline/splat/containers/lossless_pictures.py",  # has limits of its own
        "pipeline/app/node/assets/rasters.py",  # a picture of our own, checked after it was written
    }


def test_files_of_users_are_split_at_line_feeds() -> None:
    split = {path for path, call in calls("text.splitlines")}
    assert split <= {
        "pipeline/engine/machine.py",
        "pipeline/app/batch/jobs/snakemake_process.py",
    }  # the kernel's; a log


def test_numpy_archives_are_opened_in_one_place() -> None:
    assert {path for path, _ in calls("np.load")} == {
        "pipeline/splat/containers/archives.py",
        "pipeline/mvs/rendered_depths.py",  # single arrays, which are not compressed
        "stages/sparse.py",
    }


def test_rasters_are_read_as_geotiffs_only() -> None:
    read = {path for path, call in calls("rasterio.open") if len(call.args) == 1}
    assert read == {"pipeline/surface/rasters/geotiff.py"}
