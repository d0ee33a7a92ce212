"""The whole pipeline on the demo capture: what it leaves, and what it reuses."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import plyfile
import pycolmap
import pytest
from command import answered, ran
from PIL import Image
from quick_line import STAGES, sets, sha256

from splatpipe.demo import capture_path


def test_a_run_leaves_what_is_promised(demo_run: Path) -> None:
    for name in (
        "splat.ply",
        "georef.json",
        "cameras.json",
        "metrics.json",
        "sparse.glb",
        "viewer.html",
        "flythrough.webm",
        "dsm.tif",
        "dsm_confidence.tif",
        "dtm.tif",
        "dtm_confidence.tif",
        "chm.tif",
        "contours.dxf",
        "contours.geojson",
        "ortho.tif",
        "config.toml",
        "events.jsonl",
        "report.html",
        "stages",
    ):
        assert (demo_run / name).exists(), name
    metrics = json.loads((demo_run / "metrics.json").read_text())
    for key in [
        "photos",
        "registered",
        "points3d",
        "mean_reprojection_error_px",
        "gaussians",
        "iterations",
        "train_seconds",
        "train_megapixels",
        "peak_memory_bytes",
        "test_views",
        "psnr",
        "psnr_cc",
        "ssim",
        "accuracy",
        "per_view",
        "versions",
        "seed",
        "device",
    ]:
        assert key in metrics, key
    assert metrics["photos"] == metrics["registered"] == 40
    assert metrics["test_views"] == 10
    assert {"name", "psnr", "psnr_cc", "ssim"} <= set(metrics["per_view"][0])


def test_a_second_run_does_nothing(demo_options: list[str], demo_copy: Path) -> None:
    shown = ("splat.ply", "report.html")
    before = [(sha256(demo_copy / name), (demo_copy / name).stat().st_mtime_ns) for name in shown]
    result = answered("run", capture_path(), demo_copy, *demo_options)
    assert ran(result) == []
    assert [(sha256(demo_copy / name), (demo_copy / name).stat().st_mtime_ns) for name in shown] == before


@pytest.mark.usefixtures("plain_reports")
def test_changed_option_reruns_only_downstream(demo_options: list[str], demo_copy: Path) -> None:
    changed = (*demo_options, *sets("train.iterations=40"), "--until", "evaluate")
    assert ran(answered("run", capture_path(), demo_copy, *changed)) == ["blocks", "train", "clean", "evaluate"]


@pytest.mark.usefixtures("plain_reports")
def test_one_stage_runs_alone(demo_copy: Path) -> None:
    assert ran(answered("stage", "split", demo_copy)) == ["split"]


def test_a_lost_deliverable_comes_back(demo_options: list[str], demo_copy: Path) -> None:
    before = sha256(demo_copy / "splat.ply")
    (demo_copy / "splat.ply").unlink()
    assert ran(answered("run", capture_path(), demo_copy, *demo_options)) == []
    assert sha256(demo_copy / "splat.ply") == before


def test_the_splat_is_read_by_an_independent_reader(demo_run: Path) -> None:
    vertex = plyfile.PlyData.read(demo_run / "splat.ply")["vertex"]
    names = [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(45)]
    assert [item.name for item in vertex.properties] == [
        *("x", "y", "z", "nx", "ny", "nz"), *names, "opacity",
        *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)),
    ]  # fmt: skip
    values = np.stack([vertex[item.name] for item in vertex.properties])
    assert np.isfinite(values).all()
    assert len(vertex) == json.loads((demo_run / "metrics.json").read_text())["gaussians"]


def test_the_dataset_is_read_by_pycolmap(demo_run: Path) -> None:
    dataset = next((demo_run / "stages").glob("undistort-*")) / "dataset"
    model = pycolmap.Reconstruction(dataset / "sparse" / "0")
    assert model.num_reg_images() == 40
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert camera.model.name == "PINHOLE"
        with Image.open(dataset / "images" / image.name) as picture:
            assert picture.size == (camera.width, camera.height)


def test_the_figures_can_be_recomputed_from_the_pictures(demo_run: Path) -> None:
    metrics = json.loads((demo_run / "metrics.json").read_text())
    views = next((demo_run / "stages").glob("evaluate-*")) / "views"
    assert len(list(views.glob("*.error.png"))) == metrics["test_views"]
    psnrs = []
    for render in sorted(views.glob("*.render.png")):
        photo = render.with_name(render.name.replace(".render.png", ".photo.png"))
        a, b = (np.asarray(Image.open(path), dtype=np.float64) / 255 for path in (render, photo))
        psnrs.append(-10 * np.log10(np.mean((a - b) ** 2)))
    assert np.mean(psnrs) == pytest.approx(metrics["psnr"], abs=1e-3)


def test_status_names_every_stage(demo_run: Path) -> None:
    result = answered("status", demo_run)
    assert [(stage["name"], stage["state"]) for stage in result["stages"]] == [(name, "valid") for name in STAGES]  # type: ignore[index,attr-defined]


@pytest.mark.usefixtures("plain_reports")
def test_a_folder_of_another_disk_or_place_gives_the_same_splat(
    demo_options: list[str], demo_copy: Path, tmp_path: Path
) -> None:
    elsewhere = shutil.copytree(capture_path(), tmp_path / "写真 elsewhere")
    for beside in capture_path().parent.glob("*.txt"):
        shutil.copy(beside, tmp_path)
    for photo in elsewhere.iterdir():
        os.utime(photo, (0, 0))
    assert ran(answered("run", elsewhere, demo_copy, *demo_options)) == []
