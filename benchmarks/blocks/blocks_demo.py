"""Compare the demo capture trained in blocks and in one piece, at equal Gaussians: ``blocks_demo WORK``.

Reports quality and time of both; seams on the borders between blocks, by ``seam_detector`` against the training in
one piece; and whether the blocks come out bit-identical if they are made one by one in another order, on another number
of threads, each killed with -9 during training and restarted. WORK keeps the runs, so the same call again resumes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from commands import benchmark
from tables import Row, print_table

from splatpipe.demo import capture_path

COLUMNS = {
    "run": "run:",
    "blocks": "blocks:",
    "PSNR": "psnr:.2f",
    "colours fitted": "psnr_cc:.2f",
    "SSIM": "ssim:.4f",
    "Gaussians": "gaussians:,",
    "iterations": "iterations:,",
    "CPU s of training": "cpu:.0f",
    "memory MB": "memory:MB",
    "coarse pass's": "before:MB",
}
KILLED_AT = 0.3  # share of a block's iterations after which its process is killed


def splatpipe(*words: object) -> list[str]:
    """Return the words of a splatpipe command."""
    return [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", *map(str, words)]


def run(photos: Path, out: Path, sets: Sequence[str], *more: object) -> None:
    """Run the pipeline; its output goes to this terminal."""
    given = [word for each in sets for word in ("--set", each)]
    subprocess.run(splatpipe("run", photos, out, *given, *more), check=True)


def begun(one: Path, out: Path) -> Path:
    """Create an OUT with everything that ``one`` has before training."""
    if not out.is_dir():
        shutil.copytree(one, out, ignore=shutil.ignore_patterns("train-*", "blocks-*", "*.jsonl"))
    return out


def manifest(out: Path, stage: str) -> dict[str, Any]:
    """Return the manifest of a stage's newest artifact."""
    found = sorted(out.glob(f"stages/{stage}-*/manifest.json"), key=lambda path: path.stat().st_mtime)
    return dict(json.loads(found[-1].read_text(encoding="utf-8")))


def file_of(out: Path, stage: str, name: str) -> Path:
    """Return the path of a file of a stage's newest artifact."""
    return max(out.glob(f"stages/{stage}-*/{name}"), key=lambda path: path.stat().st_mtime)


def figures(name: str, out: Path) -> Row:
    """Return a row of the table."""
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    train, before = manifest(out, "train"), manifest(out, "blocks")
    row: Row = {key: metrics[key] for key in ("psnr", "psnr_cc", "ssim", "gaussians", "iterations")}
    cpu = train["cpu_seconds"] + before["cpu_seconds"]
    return row | {
        "run": name,
        "blocks": train["summary"].get("blocks", 1),
        "cpu": cpu,
        "memory": train["peak_memory_bytes"],
        "before": before["peak_memory_bytes"],
    }


def made_one_by_one(photos: Path, out: Path, sets: Sequence[str], how: Sequence[object], threads: int) -> None:
    """Train the blocks from the highest number down, each killed once, on ``threads`` threads; then merge them."""
    run(photos, out, sets, *how, "--until", "blocks", "--threads", threads)
    blocks = json.loads(file_of(out, "blocks", "blocks.json").read_text(encoding="utf-8"))["shards"]
    for number in range(blocks, 0, -1):
        command = splatpipe("stage", "train", out, "--shard", number, "--threads", threads)
        if not list(out.glob(f"stages/train.{number}-*")):
            _kill_midway(command, out / "stages" / ".shards" / f"train.{number}.jsonl")
        subprocess.run(command, check=True)
    run(photos, out, sets, *how, "--until", "train", "--threads", threads)


def _kill_midway(command: Sequence[str], events: Path) -> None:
    before = events.stat().st_size if events.is_file() else 0
    with subprocess.Popen(command, start_new_session=True) as process:
        while process.poll() is None:
            try:
                process.wait(0.5)
            except subprocess.TimeoutExpired:
                if _share(events, before) >= KILLED_AT:
                    os.killpg(process.pid, signal.SIGKILL)
    print(f"ended with {process.returncode}", flush=True)


def _share(events: Path, before: int) -> float:
    """Return a training's progress according to the events after a position in its file."""
    if not events.is_file():
        return 0.0
    with events.open("rb") as file:
        file.seek(before)
        lines = [json.loads(line) for line in file.read().split(b"\n")[:-1] if b'"iterations"' in line]
    steps = [each["data"] for each in lines if each["kind"] == "progress"]
    return float(steps[-1]["done"]) / float(steps[-1]["total"]) if steps else 0.0


def digest(path: Path) -> str:
    """Return the digest of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def seams_found(out: Path, one: Path, work: Path, plant: bool, threads: int) -> None:
    """Run `seams` on the borders between blocks and print what it finds."""
    plan = json.loads(file_of(out, "blocks", "blocks.json").read_text(encoding="utf-8"))
    (work / "partition.json").write_text(json.dumps(plan["partition"]), encoding="utf-8")
    words = [out, file_of(one, "train", "model.ply"), "--partition", work / "partition.json", "--threads", threads]
    words += ["--plant"] if plant else []
    subprocess.run([sys.executable, *benchmark("seams", *words)], check=True)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("work", type=Path)
    options.add_argument("--photos", type=Path, default=None, help="instead of the demo's")
    options.add_argument("--blocks", type=int, default=4)
    options.add_argument("--gaussians", type=int, default=90_000)
    options.add_argument("--preset", default="standard")
    options.add_argument("--set", nargs="*", default=[], metavar="SECTION.OPTION=VALUE")
    options.add_argument("--threads", type=int, default=2)
    options.add_argument("--plant", action="store_true", help="seams, too, to see that they would be found")
    options.add_argument("--no-kill", action="store_true", help="leave out what is made one by one")
    arguments = options.parse_args()
    photos, work = arguments.photos or capture_path(), arguments.work
    sets = [f"train.max_gaussians={arguments.gaussians}", "flythrough.seconds=0.0", *arguments.set]
    in_blocks = [*sets, f"blocks.least={arguments.blocks}"]
    how = ("--preset", arguments.preset, "--device", "cpu")
    run(photos, work / "one", sets, *how, "--threads", arguments.threads)
    run(photos, begun(work / "one", work / "blocks"), in_blocks, *how, "--threads", arguments.threads)
    print_table("in one and in blocks", [figures("one", work / "one"), figures("blocks", work / "blocks")], COLUMNS)
    seams_found(work / "blocks", work / "one", work, arguments.plant, arguments.threads)
    if arguments.no_kill:
        return
    other = 1 if arguments.threads > 1 else 2
    made_one_by_one(photos, begun(work / "one", work / "one_by_one"), in_blocks, how, other)
    each = [digest(file_of(work / name, "train", "model.ply")) for name in ("blocks", "one_by_one")]
    print("the same bits" if each[0] == each[1] else f"OTHER BITS: {each[0][:16]} and {each[1][:16]}")
    sys.exit(each[0] != each[1])


if __name__ == "__main__":
    main()
