"""Benchmarks of training: they run on any dataset, and train as the pipeline does."""

import json
import math
import subprocess
from pathlib import Path
from typing import Any

import measure
import pytest
import tiny_scene
from repository import benchmark

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.stages import evaluate, initialize, train

MEGAPIXELS = 1e-6 * tiny_scene.WIDTH * tiny_scene.HEIGHT


KEYS = {"gaussians", "megapixels", "threads", "wall_s", "cpu_s", "peak_bytes"}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_scene.write_dataset(tmp_path_factory.mktemp("scene") / "tiny")


def run(name: str, dataset: Path, out: Path, *options: str) -> dict[str, Any]:
    command = benchmark(name, "--data", dataset, "--json", out, *options)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert name in done.stdout
    found: dict[str, Any] = json.loads(out.read_text())
    assert found["machine"]["fma_gflops_per_core"] > 0.0 and found["machine"]["copy_gb_s"] > 0.0
    assert found["machine"]["isa"] in found["machine"]["isas"] and found["machine"]["cpu"]
    for row in found["rows"]:
        assert row.keys() >= KEYS
        assert all(row[key] > 0 for key in KEYS)
    return found


def test_train_speed_times_every_point_set_at_every_size(dataset: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    for link, target in (("images", "images"), ("sparse", "sparse"), ("sparse_again", "sparse")):
        (data / link).symlink_to(dataset / target)
    sizes = ("--megapixels", "0.001", str(MEGAPIXELS))
    rows = run("train_speed", data, tmp_path / "f.json", "--threads", "2", *sizes, "--repeats", "3")["rows"]
    assert [row["points"] for row in rows] == ["sparse", "sparse", "sparse_again", "sparse_again"]
    small, whole = rows[:2]
    assert small["megapixels"] == pytest.approx(0.001, rel=0.05) and whole["megapixels"] == pytest.approx(MEGAPIXELS)
    for row in rows:
        assert row["gaussians"] == tiny_scene.GAUSSIANS and row["threads"] == 2 and row["sh_degree"] == 3
        assert row["pairs"] == pytest.approx(1e6 * row["megapixels"] * row["pairs_per_pixel"], rel=0.05)
        assert row["gpairs_per_s_per_core"] > 0.0 and row["wall_min_s"] <= row["wall_s"]
        assert all(row[f"{part}_{clock}_s"] > 0.0 for part in (*measure.PARTS, "rest") for clock in ("wall", "cpu"))


def test_scaling_keeps_the_pairs_per_pixel_while_the_number_of_gaussians_grows(dataset: Path, tmp_path: Path) -> None:
    options = ("--threads", "1", "--gaussians", "400", "1600", "--at-gaussians", "1600", "--photos", "5", "--memory")
    size, pairs = str(MEGAPIXELS), 12.0
    sizes = ("--megapixels", size, "--at-megapixels", size, "--pairs", str(pairs), "--repeats", "2")
    rows = run("scaling", dataset, tmp_path / "f.json", *options, *sizes)["rows"]
    assert [row["series"] for row in rows] == ["gaussians", "gaussians", "megapixels", "threads", "memory", "memory"]
    assert [row["gaussians"] for row in rows[:4]] == [400, 1600, 1600, 1600]
    for row in rows[:4]:  # the iterations in between change opacities and sizes a little
        assert row["pairs_per_pixel"] == pytest.approx(pairs, rel=0.35)
    for row, asked in zip(rows[4:], (400, 1600), strict=True):
        assert 0.9 * asked < row["gaussians"] <= asked
    assert rows[0]["ratio_to_linear"] == 1.0
    growth = rows[1]["wall_s"] / rows[0]["wall_s"]
    assert math.isclose(rows[1]["ratio_to_linear"], growth / 4.0)


def test_time_to_quality_trains_and_measures_as_the_pipeline_does(dataset: Path, tmp_path: Path) -> None:
    iterations, held_out = 60, "flight 1/photo_4.png"
    options = ("--threads", "1", "--held-out", held_out, "--iterations", str(iterations), "--every", "1e9")
    found = run("time_to_quality", dataset, tmp_path / "f.json", *options, "--marks", "1", "99")
    (row,) = found["rows"]

    parts = {"undistort.dataset": dataset, "initialize.splat": tmp_path / "init.ply"}
    parts |= {"clean.model": tmp_path / "model.ply", "train.rendering": tmp_path / "rendering.json"}
    parts["train.sky"] = tmp_path / "sky.npz"
    parts |= tiny_scene.split_part(dataset, names=held_out)
    inputs = Inputs(parts, tmp_path, machine=Machine("cpu", 1))
    recorder = tiny_scene.Recorder()
    initialize.run(InitializeConfig(), inputs, tmp_path, recorder)
    summary = train.run(TrainConfig(iterations=iterations), inputs, tmp_path, recorder)
    quality = evaluate.run(EvaluateConfig(), inputs, tmp_path, recorder)
    assert (row["iteration"], row["gaussians"]) == (iterations, summary["gaussians"])
    assert row["psnr"] == pytest.approx(quality["psnr"], abs=1e-6)
    assert row["ssim"] == pytest.approx(quality["ssim"], abs=1e-6)

    low, high = found["machine"]["marks"]
    assert low["cpu_s"] == row["cpu_s"] and low["iteration"] == iterations
    assert high["mark_db"] == 99.0 and high["cpu_s"] is None
