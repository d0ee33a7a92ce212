"""The whole pipeline on a few photos at a small size, and the digests of what it leaves."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from splatpipe.stages.line import LINE

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
STAGES = [stage.name for stage in LINE]
# Stages that QUICK runs for surfaces: what is turned off reads nothing, and is not made again.
SURFACES = ["dsm", "dtm", "ortho", "publish"]


def sets(*assignments: str) -> list[str]:
    """Return assignments as options of the command line."""
    return [part for text in assignments for part in ("--set", text)]


def sha256(path: Path) -> str:
    """Return the digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def part_digests(out: Path) -> dict[str, str]:
    """Return the digest of every part, by name: what "the same bits" means."""
    digests = {}
    for manifest in sorted((out / "stages").glob("*/manifest.json")):
        found = json.loads(manifest.read_text())
        digests |= {f"{found['stage']}.{name}": part["digest"] for name, part in found["parts"].items()}
    return digests
