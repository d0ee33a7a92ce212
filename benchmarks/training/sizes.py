"""Compare held-out quality and CPU time at several sizes: ``sizes PHOTOS --work FOLDER 0.5:7000 4:12000 …``.

Each SIZE:ITERATIONS is a separate training (schedules follow from the length) by the pipeline itself on photos of at
most SIZE megapixels, with the same cameras, photos and start; all are evaluated at the same size, min(photo, 2 MP). The
stages before training run once. Runs already in FOLDER are not repeated; their OUT stays there, for images and for
`texture_contrast`. CPU time is that of training alone.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

from commands import run_all, splatpipe
from finished import ResultLog
from tables import Row, print_table

from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.stages.line import EVALUATE, LINE, TRAIN

COLUMNS = {
    "MP": "megapixels:.2f",
    "iterations": "iterations:,",
    "CPU min": "cpu_min:.1f",
    "wall min": "wall_min:.1f",
    "Gaussians": "gaussians:,",
    "peak MB": "peak_bytes:MB",
    "judged MP": "judged_megapixels:.2f",
    "PSNR dB": "psnr:.2f",
    "PSNR cc": "psnr_cc:.2f",
    "SSIM": "ssim:.4f",
    "sharpness": "sharpness:.3f",
    "depth off": "depth:.4f",
}


def prepared(photos: Path, work: Path, given: list[str]) -> Path:
    """Return the OUT that all trainings start from: everything up to `initialize`.

    Raises:
        SystemExit: if a stage fails.
    """
    base = work / "base"
    command = splatpipe("base", ["run", str(photos), str(base), "--until", "initialize", *given], work / "base.log")
    for end in run_all([command], 1):
        if end.failure:
            raise SystemExit(end.failure)
    return base


def train(base: Path, photos: Path, arm: str, given: list[str]) -> Row:
    """Run one training and evaluate it.

    Args:
        base: OUT from ``prepared``.
        photos: The capture.
        arm: SIZE:ITERATIONS.
        given: Options of all runs.

    Raises:
        SystemExit: if it fails.
    """
    size, _, iterations = arm.partition(":")
    out = base.with_name(arm.replace(":", "mp-"))
    if not out.exists():
        shutil.copytree(base, out)
    mine = ["--set", f"train.max_megapixels={size}", "--set", f"train.iterations={iterations}"]
    words = ["run", str(photos), str(out), "--until", "evaluate", *given, *mine]
    for end in run_all([splatpipe(arm, words, out.with_name(f"{out.name}.log"))], 1):
        if end.failure:
            raise SystemExit(end.failure)
    return judged(out)


def judged(out: Path) -> Row:
    """Return what a run's training took, and its quality."""
    folder = open_run_folder(out, LINE)
    metrics = json.loads(folder.lineage(EVALUATE, EVALUATE)["evaluate.metrics"].path.read_text(encoding="utf-8"))
    manifest = json.loads(
        (folder.lineage(TRAIN, TRAIN)["train.model"].path.parent / "manifest.json").read_text("utf-8")
    )
    summary = manifest["summary"]
    return {
        "megapixels": summary["train_megapixels"],
        "iterations": summary["iterations"],
        "cpu_min": manifest["cpu_seconds"] / 60.0,
        "wall_min": manifest["seconds"] / 60.0,
        "gaussians": summary["gaussians"],
        "peak_bytes": summary["peak_memory_bytes"],
        "judged_megapixels": metrics["judged_megapixels"],
        **{name: metrics["mean"][name] for name in ("psnr", "psnr_cc", "ssim", "sharpness")},
        "depth": metrics["floaters"]["depth_disagreement"]["median"],
    }


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("photos", type=Path)
    options.add_argument("arms", nargs="+", metavar="SIZE:ITERATIONS")
    options.add_argument("--work", type=Path, required=True, help="folder that keeps the runs")
    options.add_argument("--option", action="append", default=[], help="of all runs: --option=--preset=standard")
    arguments = options.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    base, finished = prepared(arguments.photos, arguments.work, arguments.option), ResultLog(arguments.work)
    for arm in arguments.arms:
        if arm not in finished.rows:
            finished.add(arm, train(base, arguments.photos, arm, arguments.option))
    print_table(arguments.photos.name, [finished.rows[arm] for arm in arguments.arms], COLUMNS)


if __name__ == "__main__":
    main()
