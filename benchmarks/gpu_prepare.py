"""Prepare a GPU session on a machine with the whole pipeline: pack captures, and wheels that the other one lacks."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import cv2
from gpu_scenes import PARTS
from measure import DEFAULT_START, InitialSettings, prepare, size_factor

from splatpipe.demo import capture_path
from splatpipe.pipeline.engine.run_folder import open_run_folder
from splatpipe.pipeline.photos.dataset import IMAGES, split_views
from splatpipe.pipeline.photos.options import SplitConfig
from splatpipe.stages.line import INITIALIZE, LINE

ROOT = Path(__file__).resolve().parents[1]
PROVED = ("sceaux", "ochota")  # captures that `prove` trains on; `measure` uses the others
BENCHES = {  # name: dataset, its points, megapixels
    "sceaux": ("bench_sceaux", "sparse", 0.4),
    "ochota": ("bench_ochota", "sparse", 0.4),
    "speed": ("bench_sceaux", "sparse", 1.6),
}
LINES = {"demo": None, "ochota": "ochota/photos"}  # run up to initialize; None: the bundled demo capture
QUALITY = 90  # of the transferred JPEGs: a third of PNG's size, and both devices train on the same
MEBIBYTE = 1 << 20
MAX_MEBIBYTES = 64  # limit for the tree and everything carried
WHEELS = ("pydantic", "pydantic-core", "annotated-types", "typing-inspection", "beartype")  # missing on that machine
PEERS = ("gsplat==1.5.3",)
PLATFORMS = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014", "manylinux1")


def main(data: Path, pack: Path, lines: list[str], peers: list[Path]) -> None:
    """Write the pack.

    Args:
        data: The folder of real captures.
        pack: A git-ignored folder, to be carried.
        lines: Runs of the pipeline to pack, as ``demo-standard``.
        peers: Folders with the peers' sources, each with a ``setup.py``.
    """
    captures = pack / "captures"
    for name, (dataset, points, megapixels) in BENCHES.items():
        if not (captures / name).exists() and (data / dataset).is_dir():
            print(f"== {name}: {dataset} at {megapixels} MP", flush=True)
            pack_bench(data / dataset, points, megapixels, captures / name)
    for name in lines:
        capture, _, preset = name.partition("-")
        if not (captures / name).exists():
            print(f"== {name}: the line up to initialize", flush=True)
            pack_line(None if LINES[capture] is None else data / str(LINES[capture]), preset, captures / name)
    fetch_wheels(pack / "wheels")
    for source in peers:
        shutil.copytree(source, pack / "peers" / source.name, dirs_exist_ok=True)
    report_size(pack)


def pack_bench(dataset: Path, points: str, megapixels: float, target: Path) -> None:
    """Pack an undistorted dataset at another size, with every eighth photo held out as the pipeline does."""
    names = [path.name for path in sorted((dataset / IMAGES).iterdir())]
    split = split_views(names, SplitConfig().every, "")
    with tempfile.TemporaryDirectory() as scratch:
        start = InitialSettings(DEFAULT_START.options, split.held_out)
        made = prepare(dataset, points, size_factor(dataset, megapixels), Path(scratch) / "made", start=start)
        split_file = Path(scratch) / "split.json"
        split_file.write_text(split.to_json())
        shutil.rmtree(made / "whole")
        start_file = (made / "init.ply").rename(Path(scratch) / "init.ply")
        (made / "split.json").unlink()
        copy_parts({"undistort.dataset": made, "split.views": split_file, "initialize.splat": start_file}, target)


def pack_line(photos: Path | None, preset: str, target: Path) -> None:
    """Pack a run of the pipeline up to the start of training."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out"
        command = [
            "run",
            str(photos or capture_path()),
            str(out),
            "--until",
            "initialize",
            "--preset",
            preset,
            "--json",
        ]
        words = [sys.executable, "-m", "splatpipe.pipeline.app.cli", *command]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        parts = open_run_folder(out, LINE).lineage(INITIALIZE)
        copy_parts({name: part.path for name, part in parts.items()}, target)


def copy_parts(parts: dict[str, Path], target: Path) -> None:
    """Copy parts under the pipeline's names; photos become JPEG whatever their names say: readers go by content."""
    scratch = target.with_name(f"{target.name}.new")
    shutil.rmtree(scratch, ignore_errors=True)
    for name in PARTS:
        if name not in parts:
            continue
        if parts[name].is_dir():
            shutil.copytree(parts[name], scratch / name)
        else:
            scratch.mkdir(parents=True, exist_ok=True)
            shutil.copy2(parts[name], scratch / name)
    for photo in filter(Path.is_file, (scratch / "undistort.dataset" / IMAGES).rglob("*")):
        picture = cv2.imread(str(photo), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        if len(data) < photo.stat().st_size:
            photo.unlink()  # not overwritten: it may be a link into the store
            photo.write_bytes(data.tobytes())
    scratch.rename(target)


def fetch_wheels(folder: Path) -> None:
    """Fetch wheels for Python 3.12 on the GPU machine: our versions, and gsplat, which compiles itself there."""
    wanted = [f"{name}=={version(name)}" for name in WHEELS]
    platforms = [word for name in PLATFORMS for word in ("--platform", f"{name}_x86_64")]
    for one in (*wanted, *PEERS):
        if any(folder.glob(f"{one.replace('-', '_').replace('==', '-')}-*.whl")):
            continue
        words = ["download", "-q", "--no-deps", "--only-binary=:all:", "--python-version", "3.12", *platforms]
        done = subprocess.run(
            [sys.executable, "-m", "pip", *words, "--implementation", "cp", "-d", str(folder), one], check=False
        )
        print(f"== wheel {one}: {'there' if done.returncode == 0 else 'not to be had'}", flush=True)


def report_size(pack: Path) -> None:
    """Report what each call carries beside the tree, and the limit.

    Raises:
        SystemExit: if it is too much.
    """
    listed = subprocess.run(["git", "ls-files", "-z"], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    tree = sum((ROOT / name).stat().st_size for name in listed.split("\0") if name and (ROOT / name).is_file())
    shared = [folder for folder in (pack / "wheels", pack / "peers") if folder.is_dir()]
    captures = [path for path in sorted((pack / "captures").iterdir()) if path.is_dir()]
    for call, mine in (
        ("prove", [path for path in captures if path.name in PROVED]),
        ("measure", [path for path in captures if path.name not in PROVED]),
    ):
        carried = [*shared, *mine]
        size = tree + sum(file.stat().st_size for path in carried for file in path.rglob("*") if file.is_file())
        print(f"== {call}: {size / MEBIBYTE:.1f} of {MAX_MEBIBYTES} MiB with", *carried)
        if size > MAX_MEBIBYTES * MEBIBYTE:
            raise SystemExit(f"That is too much for {call}: take fewer --lines.")
