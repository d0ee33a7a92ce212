"""The whole pipeline on a few photos of the demo capture: its outputs, reuse, and robustness against kills."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from itertools import cycle
from pathlib import Path

import numpy as np
import plyfile
import pycolmap
import pytest
from PIL import Image

from splatpipe.demo import capture_path
from splatpipe.stages.line import LINE

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
from timeouts import TIMEOUT_S, wait_until

QUICK = (
    "features.extractor=opencv-sift",
    "features.max_image_size=800",
    "features.max_features=2000",
    "undistort.max_megapixels=0.03",
    "train.iterations=60",
    "split.every=4",
    "flythrough.seconds=0.2",
    "depths.max_megapixels=0.005",
    "dsm.cell_m=0.3",
    "ortho.gsd_m=0.3",
)
PRODUCTS = (  # what no run makes unasked, but the mesh, which takes open3d
    *("splat_depths.enabled=true", "facades.enabled=true", "facades.gsd_m=0.2"),
    *("cloud.enabled=true", "cloud.spacing_m=0.3"),
)
SURFACES = ["dsm", "ortho"]  # of QUICK: what is turned off reads nothing, and is not made again
STAGES = [stage.name for stage in LINE]
KILLED_RUN = Path(__file__).with_name("killed_run.py")


def sets(*assignments: str) -> list[str]:
    return [part for text in assignments for part in ("--set", text)]


def splatpipe(*arguments: object) -> dict[str, object]:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli", *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    told: dict[str, object] = json.loads(done.stdout)
    return told


def ran(told: dict[str, object]) -> list[str]:
    return [stage["name"] for stage in told["stages"] if stage["state"] == "ran"]  # type: ignore[index,attr-defined]


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def part_digests(out: Path) -> dict[str, str]:
    """Digest of every part, by name: what `the same bits` means."""
    digests = {}
    for manifest in sorted((out / "stages").glob("*/manifest.json")):
        told = json.loads(manifest.read_text())
        digests |= {f"{told['stage']}.{name}": part["digest"] for name, part in told["parts"].items()}
    return digests


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The last dozen photos of the demo capture: a strip from above and the end of an orbit."""
    folder = tmp_path_factory.mktemp("capture") / "photos of a house"
    folder.mkdir()
    for photo in sorted(capture_path().glob("*.JPG"))[-12:]:
        shutil.copy(photo, folder)
    return folder


@pytest.fixture(scope="session")
def undisturbed(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    told = splatpipe("run", photos, out, *sets(*QUICK), "--threads", 2)
    assert ran(told) == STAGES
    return out


@pytest.fixture
def copy_of_run(undisturbed: Path, tmp_path: Path) -> Path:
    """A finished run that a test may change."""
    return shutil.copytree(undisturbed, tmp_path / "out")


def test_control_given_to_a_finished_run_retrains_nothing(copy_of_run: Path, tmp_path: Path) -> None:
    """Targets and georef anew, then only what reads the frame; once more with a point less, and with another CRS."""
    lines = (capture_path().parent / "gcp_list.txt").read_text().splitlines()
    more = tmp_path / "more points.txt"
    more.write_text("\n".join(lines))
    fewer = tmp_path / "fewer.txt"
    fewer.write_text("\n".join(line for line in lines if not line.endswith(" P15")))
    before = json.loads((copy_of_run / "metrics.json").read_text())
    for file in (fewer, more):
        told = splatpipe("georef", copy_of_run, "--gcp", file)
        assert ran(told) == ["control", "targets", "georef", "evaluate", "export", *SURFACES]
    after = json.loads((copy_of_run / "metrics.json").read_text())
    assert before["accuracy"]["splat"] is None and after["psnr"] == before["psnr"]
    tables = after["accuracy"]["tables"]
    assert tables["control"]["count"] > tables["check"]["count"] > 1 and tables["check"]["rmse_3d_m"] < 0.3
    assert after["accuracy"]["splat"]["points"]
    assert json.loads((copy_of_run / "georef.json").read_text())["crs"]["id"] == "EPSG:32633"
    assert ran(splatpipe("georef", copy_of_run)) == []
    told = splatpipe("georef", copy_of_run, *sets("georef.crs=EPSG:31255"))
    assert "train" not in ran(told) and ran(told)[-3:] == ["export", *SURFACES]
    assert json.loads((copy_of_run / "georef.json").read_text())["crs"]["id"] == "EPSG:31255"


def test_a_run_leaves_what_is_promised(undisturbed: Path) -> None:
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
        "contours.dxf",
        "contours.geojson",
        "ortho.tif",
        "config.toml",
        "events.jsonl",
        "report.html",
        "stages",
    ):
        assert (undisturbed / name).exists(), name
    metrics = json.loads((undisturbed / "metrics.json").read_text())
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
    assert metrics["photos"] == metrics["registered"] == 12
    assert metrics["test_views"] == 3
    assert {"name", "psnr", "psnr_cc", "ssim"} <= set(metrics["per_view"][0])


def test_a_second_run_does_nothing(photos: Path, copy_of_run: Path) -> None:
    before = sha256(copy_of_run / "splat.ply")
    told = splatpipe("run", photos, copy_of_run, *sets(*QUICK))
    assert ran(told) == []
    assert sha256(copy_of_run / "splat.ply") == before


def test_changed_option_reruns_only_downstream(photos: Path, copy_of_run: Path) -> None:
    told = splatpipe("run", photos, copy_of_run, *sets(*QUICK, "train.iterations=40"))
    assert ran(told) == ["blocks", "train", "clean", "evaluate", "export", "flythrough"]


def test_a_budget_is_planned_shown_and_reused(photos: Path, copy_of_run: Path) -> None:
    budgets = ("--time-budget", "8s", "--max-memory", "4G")
    told = splatpipe("run", photos, copy_of_run, *sets(*QUICK), *budgets)
    assert ran(told) == [
        "blocks",
        "train",
        "clean",
        "evaluate",
        "export",
        "flythrough",
        *SURFACES,
    ]  # which it turns off
    events = [json.loads(line) for line in (copy_of_run / "events.jsonl").read_text().splitlines()]
    notes = [event["data"]["message"] for event in events if event["kind"] == "note"]
    assert any(note.startswith("plan: ") and "8 s budget, within 4.0 GB" in note for note in notes), notes
    metrics = json.loads((copy_of_run / "metrics.json").read_text())
    assert metrics["time_budget_s"] == 8.0 and metrics["iterations"] > 0 and metrics["planned_iterations"] > 0
    assert ran(splatpipe("run", photos, copy_of_run, *sets(*QUICK), *budgets)) == []


def test_one_stage_runs_alone(copy_of_run: Path) -> None:
    assert ran(splatpipe("stage", "evaluate", copy_of_run)) == ["evaluate"]


def test_a_lost_deliverable_comes_back(photos: Path, copy_of_run: Path) -> None:
    before = sha256(copy_of_run / "splat.ply")
    (copy_of_run / "splat.ply").unlink()
    assert ran(splatpipe("run", photos, copy_of_run, *sets(*QUICK))) == []
    assert sha256(copy_of_run / "splat.ply") == before


def test_one_thread_and_two_leave_the_same_bits(photos: Path, undisturbed: Path, tmp_path: Path) -> None:
    splatpipe("run", photos, tmp_path / "out", *sets(*QUICK), "--threads", 1)
    mine, theirs = part_digests(tmp_path / "out"), part_digests(undisturbed)
    timed = {"export.metrics"}  # seconds and bytes of this very run
    assert {name for name in theirs if mine[name] != theirs[name]} <= timed
    assert sha256(tmp_path / "out" / "splat.ply") == sha256(undisturbed / "splat.ply")


def test_kill_9_in_every_stage_loses_nothing(photos: Path, undisturbed: Path, tmp_path: Path) -> None:
    """By turns the stage's process alone and its whole process group."""
    out, every = tmp_path / "out", (*QUICK, *PRODUCTS)
    for stage, how in zip(STAGES, cycle(("alone", "group"))):
        command = [sys.executable, KILLED_RUN, photos, out, stage, how, *every]
        died = subprocess.run(command, check=False, start_new_session=True, capture_output=True)
        log = (out / "events.jsonl").read_text().splitlines()
        of_stage = "\n".join(line for line in log if f'"{stage}"' in line)
        assert died.returncode == -signal.SIGKILL, (
            f"{stage} was not hit: {died.stderr.decode()[-2000:]}{of_stage[-4000:]}"
        )
        assert not list((out / "stages").glob(f"{stage}-*")), f"{stage} was left in spite of the kill"
    told = splatpipe("run", photos, out, *sets(*every))
    assert ran(told) == [STAGES[-1]]
    assert sha256(out / "splat.ply") == sha256(undisturbed / "splat.ply")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_command_says_so_and_goes_on_later(
    photos: Path, copy_of_run: Path, number: signal.Signals, code: int
) -> None:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli", "run", photos, copy_of_run]
    longer = sets(*QUICK, "train.iterations=100000")
    told_before = len((copy_of_run / "events.jsonl").read_text())
    pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, *longer], **pipes) as running:
        events = copy_of_run / "events.jsonl"
        wait_until(lambda: '"what": "training"' in events.read_text()[told_before:] or running.poll() is not None)
        assert running.poll() is None, running.stderr and running.stderr.read()
        running.send_signal(number)
        _, said = running.communicate(timeout=TIMEOUT_S)
    assert running.returncode == code
    assert "Stopped" in said
    assert "Traceback" not in said
    assert ran(splatpipe("run", photos, copy_of_run, *sets(*QUICK))) == []


def test_the_splat_is_read_by_an_independent_reader(undisturbed: Path) -> None:
    vertex = plyfile.PlyData.read(undisturbed / "splat.ply")["vertex"]
    names = [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(45)]
    assert [item.name for item in vertex.properties] == [
        *("x", "y", "z", "nx", "ny", "nz"), *names, "opacity",
        *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)),
    ]  # fmt: skip
    values = np.stack([vertex[item.name] for item in vertex.properties])
    assert np.isfinite(values).all()
    assert len(vertex) == json.loads((undisturbed / "metrics.json").read_text())["gaussians"]


def test_the_dataset_is_read_by_pycolmap(undisturbed: Path) -> None:
    dataset = next((undisturbed / "stages").glob("undistort-*")) / "dataset"
    model = pycolmap.Reconstruction(dataset / "sparse" / "0")
    assert model.num_reg_images() == 12
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert camera.model.name == "PINHOLE"
        with Image.open(dataset / "images" / image.name) as picture:
            assert picture.size == (camera.width, camera.height)


def test_the_figures_can_be_recomputed_from_the_pictures(undisturbed: Path) -> None:
    metrics = json.loads((undisturbed / "metrics.json").read_text())
    views = next((undisturbed / "stages").glob("evaluate-*")) / "views"
    assert len(list(views.glob("*.error.png"))) == metrics["test_views"]
    psnrs = []
    for render in sorted(views.glob("*.render.png")):
        photo = render.with_name(render.name.replace(".render.png", ".photo.png"))
        a, b = (np.asarray(Image.open(path), dtype=np.float64) / 255 for path in (render, photo))
        psnrs.append(-10 * np.log10(np.mean((a - b) ** 2)))
    assert np.mean(psnrs) == pytest.approx(metrics["psnr"], abs=1e-3)


def test_a_reconstruction_of_another_program_enters_at_georef(photos: Path, copy_of_run: Path, tmp_path: Path) -> None:
    larger = sets(*QUICK, "undistort.max_megapixels=0.1")
    splatpipe("run", photos, copy_of_run, *larger, "--until", "undistort")
    dataset = next(path for path in (copy_of_run / "stages").glob("undistort-*/dataset") if is_larger(path))
    told = splatpipe("run", dataset, tmp_path / "other", *sets(*QUICK))
    assert ran(told) == [name for name in STAGES if name not in ("features", "matches", "sparse")]
    metrics = json.loads((tmp_path / "other" / "metrics.json").read_text())
    assert metrics["registered"] == 12


def is_larger(dataset: Path) -> bool:
    with Image.open(next((dataset / "images").iterdir())) as picture:
        return picture.width > 320


def test_status_names_every_stage(undisturbed: Path) -> None:
    told = splatpipe("status", undisturbed)
    assert [(stage["name"], stage["state"]) for stage in told["stages"]] == [(name, "valid") for name in STAGES]  # type: ignore[index,attr-defined]


def test_a_folder_of_another_disk_or_place_gives_the_same_splat(
    photos: Path, undisturbed: Path, tmp_path: Path
) -> None:
    elsewhere = shutil.copytree(photos, tmp_path / "写真 elsewhere")
    for photo in elsewhere.iterdir():
        os.utime(photo, (0, 0))
    out = shutil.copytree(undisturbed, tmp_path / "out")
    assert ran(splatpipe("run", elsewhere, out, *sets(*QUICK))) == []
