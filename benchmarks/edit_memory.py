"""What an edit of a large splat takes of memory: its peak above that of the bare program, over the splat's size.

    python benchmarks/edit_memory.py FOLDER [--gaussians 5000000] [--steps "--rotate 37 --crop-box …"]

A synthetic splat of SH degree 3 is written into FOLDER once. Each edit runs in a process of its own; the baseline is
the same edit of a splat of a thousand Gaussians.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import time
from pathlib import Path

import torch

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.ply import write_splat_parts
from splatpipe.pipeline.splat.scene import Place, SceneFacts

BYTES = 236  # of a Gaussian of degree 3 in memory
PART = 500_000
FACTS = SceneFacts("z up", False, True, Place(52.2, 21.0, 113.25, "EPSG:5773", "EPSG:32634"))
EDITS = {
    "crop": "--local --crop-box -40,-40,40,40",
    "polygon": "--crop-polygon {folder}/site.geojson",
    "motion": "--rotate 37 --move 1,2,3",
    "merge": "--merge {folder}/half.ply",
    "pictures": "--move 0,0,1 --pictures",
}


def part(count: int, seed: int) -> Gaussians:
    """Small Gaussians on a hilly ground of 100 by 100 metres."""
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


def measured(command: list[str]) -> tuple[int, float]:
    """Peak of its resident memory in bytes, and seconds."""
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
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    ring = [[20.9995, 52.1997], [21.0005, 52.1997], [21.0005, 52.2003], [20.9995, 52.2003], [20.9995, 52.1997]]
    (folder / "site.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    sizes = {"few": 1000, "many": arguments.gaussians}
    for name, count in sizes.items():
        write(folder / f"{name}.ply", count)
    asked = {"asked": arguments.steps} if arguments.steps else {name: EDITS[name] for name in arguments.edits}
    for name, steps in asked.items():
        peaks = {}
        for size, count in sizes.items():
            half = folder / "half.ply"
            half.unlink(missing_ok=True)
            write(half, count // 2)
            command = [sys.executable, "-m", "splatpipe.pipeline.app.cli", "edit", str(folder / f"{size}.ply")]
            command += [str(folder / "out.ply"), "--threads", "1", "--no-pictures"]
            peaks[size] = measured([*command, *shlex.split(steps.format(folder=folder))])
        above = peaks["many"][0] - peaks["few"][0]
        share = above / (BYTES * sizes["many"])
        print(f"{name:9} {above / 1e6:8.0f} MB above, {share:.2f} × the splat, {peaks['many'][1]:.1f} s")


if __name__ == "__main__":
    main()
