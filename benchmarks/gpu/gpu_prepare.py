"""``make gpu-visit``: prepare a visit to a GPU on a machine with the whole pipeline, and print its commands.

Packs the compiled libraries, wheels that the other machine lacks, a capture with a trained scene, the figures of the
CPU's trainings, and the peers' sources. What is there already is kept, so that it can be repeated.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import cv2
import gpu_libraries
import gpu_peer_sources
import gpu_proofs
import gpu_scenes
from gpu_parts import Row
from gpu_visit import BUILT_PEERS, SEEDS, VisitScale
from measure import DEFAULT_START, InitialSettings, prepare, size_factor

from splatpipe.pipeline.photos.options import SplitConfig
from splatpipe.pipeline.photos.pixels.dataset import IMAGES, Split, split_views

ROOT = Path(__file__).resolve().parents[2]
DATASET, POINTS = "bench_sceaux", "sparse"
DENSE_POINTS = "sparse_100k"  # initial points of the trained scene, which gets no more Gaussians: 24 MB
JPEG_QUALITY = 90  # JPEG quality of the transferred photos: a third of PNG's size, and both devices train on them
TRAINED_ITERATIONS, MAX_TRAINED_GAUSSIANS = 1500, 100_000  # training length and Gaussians of the trained scene
MEBIBYTE = 1 << 20
MAX_MEBIBYTES = 64  # limit for the tree and everything carried
MAX_COMMAND_LETTERS = 2000  # characters
# Missing on that machine: pydantic with what it needs, and what the engine's configuration imports.
WHEELS = ("pydantic", "pydantic-core", "annotated-types", "typing-inspection", "tomli-w")
PLATFORMS = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014", "manylinux1")


def main(data: Path, pack: Path, peers: Path | None, first: Path | None) -> None:
    """Write the pack, and print what it holds and the commands.

    Args:
        data: The folder of real captures.
        pack: A git-ignored folder, to be carried.
        peers: Folder with the peers' sources, see ``gpu_peer_sources.pack_peers``; None for none.
        first: The first call's file, for the second; None before that.
    """
    pack.mkdir(parents=True, exist_ok=True)
    scale = VisitScale()
    said: Row = {"commit": _commit()}
    for what, made in (
        ("libraries", lambda: gpu_libraries.compile_beforehand(pack / "libraries", ROOT / "build" / "gpu_visit")),
        ("wheels", lambda: fetch_wheels(pack / "wheels")),
        ("capture", lambda: pack_capture(data / DATASET, pack / "captures" / gpu_scenes.CAPTURE)),
        ("trained scene", lambda: train_scene(data / DATASET, pack)),
        ("trainings on the CPU", lambda: train_on_cpu(pack, scale.iterations)),
        ("peers", lambda: gpu_peer_sources.pack_peers(peers, pack / "peers")),
    ):
        print(f"== {what}", flush=True)
        said[what] = made()
        print("\n".join(f"   {name}: {text}" for name, text in said[what].items()), flush=True)
    (pack / "first.jsonl").unlink(missing_ok=True)
    if first is not None:
        shutil.copyfile(first, pack / "first.jsonl")
    (pack / "pack.json").write_text(json.dumps(said, indent=1) + "\n")
    print_commands(pack, first is not None)


def pack_capture(dataset: Path, target: Path) -> Row:
    """Pack an undistorted dataset at the measured size, with every eighth photo held out as the pipeline does."""
    if not target.exists():
        with tempfile.TemporaryDirectory() as scratch:
            made, split = made_dataset(dataset, POINTS, Path(scratch))
            split_file = Path(scratch) / "split.json"
            split_file.write_text(split.to_json())
            shutil.rmtree(made / "whole")
            start_file = (made / "init.ply").rename(Path(scratch) / "init.ply")
            (made / "split.json").unlink()
            copy_parts({"undistort.dataset": made, "split.views": split_file, "initialize.splat": start_file}, target)
    return {DATASET: f"{_mebibytes(target):.1f} MiB at {gpu_scenes.MEGAPIXELS} MP"}


def made_dataset(dataset: Path, points: str, scratch: Path) -> tuple[Path, Split]:
    """Write a dataset at the measured size, with initial Gaussians from some of its points; and its split."""
    names = [path.name for path in sorted((dataset / IMAGES).iterdir())]
    split = split_views(names, SplitConfig().every, "")
    start = InitialSettings(DEFAULT_START.options, split.held_out)
    return prepare(dataset, points, size_factor(dataset, gpu_scenes.MEGAPIXELS), scratch / "made", start=start), split


def copy_parts(parts: dict[str, Path], target: Path) -> None:
    """Copy parts under the pipeline's names; photos become JPEG whatever their names say: readers go by content."""
    scratch = target.with_name(f"{target.name}.new")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    for name, path in parts.items():
        if path.is_dir():
            shutil.copytree(path, scratch / name)
        else:
            shutil.copy2(path, scratch / name)
    for photo in filter(Path.is_file, (scratch / "undistort.dataset" / IMAGES).rglob("*")):
        picture = cv2.imread(str(photo), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if len(data) < photo.stat().st_size:
            photo.unlink()  # not overwritten: it may be a link into the store
            photo.write_bytes(data.tobytes())
    scratch.rename(target)


def train_scene(dataset: Path, pack: Path) -> Row:
    """Train the capture from many points, on the CPU, for the scene that is measured beside made ones."""
    target = pack / "captures" / gpu_scenes.CAPTURE / gpu_scenes.TRAINED
    if not target.exists():
        options = {"iterations": TRAINED_ITERATIONS, "max_gaussians": MAX_TRAINED_GAUSSIANS, "densify": False}
        with tempfile.TemporaryDirectory() as scratch:
            made, _ = made_dataset(dataset, DENSE_POINTS, Path(scratch))
            options["max_megapixels"] = gpu_proofs.TRAINING_MP
            gpu_proofs.train_capture("cpu", Path(scratch), start=made / "init.ply", **options)
            shutil.move(Path(scratch) / "model.ply", target)
    return {"model": f"{target.stat().st_size / MEBIBYTE:.1f} MiB"}


def train_on_cpu(pack: Path, iterations: int) -> Row:
    """Run the trainings that the device's are compared with; each that is done is kept."""
    rows = [row for row in gpu_proofs.carried_trainings() if row["iterations"] == iterations]
    for seed in SEEDS:
        if not any(row["seed"] == seed for row in rows):
            rows += gpu_proofs.training(seed, iterations, on="cpu")
            (pack / "cpu.json").write_text(json.dumps(rows, indent=1) + "\n")
    return {f"seed {row['seed']}": f"{row['psnr_cc']:.2f} dB, {row['train_seconds']:.0f} s" for row in rows}


def fetch_wheels(folder: Path) -> Row:
    """Fetch wheels for Python 3.12 on the GPU machine, in our versions."""
    platforms = [word for name in PLATFORMS for word in ("--platform", f"{name}_x86_64")]
    said: Row = {}
    for name in WHEELS:
        known = version(name)
        if not any(folder.glob(f"{name.replace('-', '_')}-{known}-*.whl")):
            for old in folder.glob(f"{name.replace('-', '_')}-*.whl"):
                old.unlink()
            words = ["download", "-q", "--no-deps", "--only-binary=:all:", "--python-version", "3.12", *platforms]
            words += ["--implementation", "cp", "-d", str(folder), f"{name}=={known}"]
            subprocess.run([sys.executable, "-m", "pip", "--disable-pip-version-check", *words], check=True)
        said[name] = known
    return said


def print_commands(pack: Path, again: bool) -> None:
    """Print the pack's size, and the calls of the device machine.

    Raises:
        SystemExit: if it is too much to be carried.
    """
    for path in sorted(pack.rglob("*")):
        if path.is_dir() and path.parent == pack:
            print(f"   {path.name}: {_mebibytes(path):.1f} MiB")
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    tree = sum((ROOT / name).stat().st_size for name in listed.split("\0") if name and (ROOT / name).is_file())
    size = tree / MEBIBYTE + _mebibytes(pack)
    print(f"== carried: {size:.1f} of {MAX_MEBIBYTES} MiB, the tree's {tree / MEBIBYTE:.1f} among them")
    if size > MAX_MEBIBYTES:
        raise SystemExit("That is too much to be carried.")
    missing = [peer for peer in BUILT_PEERS if not (pack / "peers" / peer).is_dir()]
    if missing:
        print(f"   left out: {', '.join(missing)} (PEERS=FOLDER packs them)")
    relative = os.path.relpath(pack, ROOT)
    for call, limit in (("second", 200),) if again else (("first", 420),):
        command = f"python3 benchmarks gpu_visit {call} --pack {relative} --out $OUT"
        assert len(command) < MAX_COMMAND_LETTERS
        print(f"== the {call} call: carry {json.dumps([relative])}, timeout_s {limit}, in the repository's root:")
        print(f"   {command}")
    if not again:
        print("   then `make gpu-visit FIRST=.../first.jsonl` for the second call")


def _mebibytes(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / MEBIBYTE


def _commit() -> str:
    words = ["git", "describe", "--always", "--dirty"]
    return subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT).stdout.strip() or "unknown"
