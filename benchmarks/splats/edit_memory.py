"""Measure the memory that edits of a large splat take: peak above that of the bare program, over the splat's size.

    python benchmarks edit_memory FOLDER [--gaussians 5000000] [--edits crop merge …]
    python benchmarks edit_memory FOLDER --steps "--rotate 37 --crop-box …" [--out out.sog]

A synthetic splat of SH degree 3 is written into FOLDER once, and once more in the formats that edits write ("to spz")
before others read them ("from spz"). Each edit runs in a process of its own; the baseline is the same edit of a splat
of a thousand Gaussians.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from splatpipe.pipeline.splat.containers.ply import write_splat_parts
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import SceneFacts, SplatOrigin

BYTES = 236  # per Gaussian of degree 3 in memory
PART = 500_000
FACTS = SceneFacts("z up", False, True, SplatOrigin(52.2, 21.0, 113.25, "EPSG:5773", "EPSG:32634"))
CAMERA_HEIGHT_M, CAMERA_PX = 30.0, (1200, 900)  # height above ground and image size of the photos of the cleaned run
CAMERA_PLACES_M = (-25.0, 0.0, 25.0)  # along both axes


@dataclass(frozen=True)
class MeasuredEdit:
    """An edit to be measured.

    Attributes:
        steps: Steps, as on the command line.
        out: File that is written, in the folder.
        source: File that is edited, in the folder.
    """

    steps: str
    out: str = "out.ply"
    source: str = "{size}.ply"


_CROP = "--local --crop-box -40,-40,40,40"
_READ_BACK = ("spz", "sog", "glb", "compressed.ply")
EDITS = {
    "crop": MeasuredEdit(_CROP),
    "polygon": MeasuredEdit("--crop-polygon {folder}/site.geojson"),
    "motion": MeasuredEdit("--rotate 37 --move 1,2,3"),
    "merge": MeasuredEdit("--merge {folder}/half.ply"),
    "reduce": MeasuredEdit("--reduce {most}"),
    "bytes": MeasuredEdit("--reduce {megabytes}MB", "out.spz"),
    "clean": MeasuredEdit("--clean"),
    "photos": MeasuredEdit("--clean", source="run-{size}.ply"),
    "pictures": MeasuredEdit("--move 0,0,1 --pictures"),
    **{f"to {ending}": MeasuredEdit("--rotate 37", f"{{size}}.{ending}") for ending in _READ_BACK},
    **{f"from {ending}": MeasuredEdit(_CROP, source=f"{{size}}.{ending}") for ending in _READ_BACK},
}


def part(count: int, seed: int) -> Gaussians:
    """Create small Gaussians on hilly ground of 100 by 100 metres."""
    generator = torch.Generator().manual_seed(seed)
    gaussians = Gaussians.empty(count, 3)
    gaussians.means = torch.rand(count, 3, generator=generator) * 100.0 - 50.0
    gaussians.means[:, 2] = 3.0 * torch.sin(gaussians.means[:, 0] / 9.0) + 0.02 * gaussians.means[:, 2]
    gaussians.log_scales = torch.rand(count, 3, generator=generator) - 4.0
    gaussians.quats = torch.randn(count, 4, generator=generator)
    gaussians.opacity_logits = torch.rand(count, generator=generator) * 4.0
    gaussians.sh = 0.2 * torch.randn(count, 16, 3, generator=generator)
    return gaussians


def write(path: Path, count: int) -> None:
    """Write the splat, part by part."""
    if path.exists():
        return
    parts = (part(min(PART, count - start), start) for start in range(0, count, PART))
    write_splat_parts(path, parts, count, 3, [f"splatpipe {FACTS.record()}"])


def write_run(folder: Path, splat: Path) -> None:
    """Write what cleaning accepts as a run: the splat, and cameras that look down on it."""
    (folder / "stages").mkdir(parents=True, exist_ok=True)
    if not (folder / "splat.ply").exists():
        (folder / "splat.ply").hardlink_to(splat)
    down = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    focal = CAMERA_PX[0] / 2.0
    seen = {"width": CAMERA_PX[0], "height": CAMERA_PX[1], "fx": focal, "fy": focal, "rotation": down}
    places = [(x, y, CAMERA_HEIGHT_M) for x in CAMERA_PLACES_M for y in CAMERA_PLACES_M]
    cameras = [{**seen, "id": i, "img_name": f"{i}.jpg", "position": place} for i, place in enumerate(places)]
    (folder / "cameras.json").write_text(json.dumps(cameras))


def measured(command: list[str]) -> tuple[int, float]:
    """Return a command's peak resident memory in bytes, and its seconds."""
    code = f"import resource, subprocess, sys; done = subprocess.run({command!r}, capture_output=True, text=True); "
    code += "print(done.stderr[-2000:], file=sys.stderr) if done.returncode else None; "
    code += "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss); sys.exit(done.returncode)"
    begun = time.monotonic()
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if out.returncode:
        sys.exit(out.stderr)
    return int(out.stdout) * 1024, time.monotonic() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--gaussians", type=int, default=5_000_000)
    parser.add_argument("--edits", nargs="*", default=list(EDITS))
    parser.add_argument("--steps", help="Another edit than those of the list.")
    parser.add_argument("--out", default="out.ply", help="What that writes.")
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    ring = [[20.9995, 52.1997], [21.0005, 52.1997], [21.0005, 52.2003], [20.9995, 52.2003], [20.9995, 52.1997]]
    (folder / "site.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    sizes = {"few": 1000, "many": arguments.gaussians}
    for name, count in sizes.items():
        write(folder / f"{name}.ply", count)
    write_run(folder / "run-many.ply", folder / "many.ply")
    if not (
        folder / "run-few.ply"
    ).exists():  # without a run: photos would make a thousand scattered Gaussians floaters
        (folder / "run-few.ply").hardlink_to(folder / "few.ply")
    asked = {name: EDITS[name] for name in arguments.edits}
    if arguments.steps:
        asked = {"asked": MeasuredEdit(arguments.steps, arguments.out)}
    for name, edit in asked.items():
        peaks = {}
        for size, count in sizes.items():
            half = folder / "half.ply"
            half.unlink(missing_ok=True)
            write(half, count // 2)
            few_enough = {"most": count * 3 // 5, "megabytes": max(1, count * 20 // 1_000_000)}
            command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "edit"]
            command += [str(folder / each.format(size=size)) for each in (edit.source, edit.out)]
            command += ["--threads", "1", "--no-pictures", *shlex.split(edit.steps.format(folder=folder, **few_enough))]
            peaks[size] = measured(command)
        above = peaks["many"][0] - peaks["few"][0]
        share = above / (BYTES * sizes["many"])
        text = f"{above / 1e6:8.0f} MB above, {share:.2f} × the splat, {peaks['many'][1]:.1f} s"
        print(f"{name:20} {text}", flush=True)


if __name__ == "__main__":
    main()
