"""The demo's points and their marks, and its run without them."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

from command import answered, plain_reports
from finished_run import linked_copy

from splatpipe.demo import CAPTURE, capture_path
from splatpipe.pipeline.survey.files.control_file import read_control_file

TRUTH = {point["name"]: point for point in json.loads((CAPTURE / "truth.json").read_text())["points"]}


POINTS = "EPSG:32633\nname,x,y,z\n" + "".join(
    "{},{:.4f},{:.4f},{:.4f}\n".format(name, *point["utm_m"]) for name, point in TRUTH.items()
)


def by_gps_alone(demo_run: Path, home: Path) -> Path:
    """The demo without its control, georeferenced by GPS; the photos lie in a folder of its own that has none."""
    shutil.copytree(capture_path(), home / "photos of a house")
    (home / "points.csv").write_text(POINTS)
    out = linked_copy(demo_run, home / "out")
    config = re.sub(
        r"(?m)^photos = .*$", f'photos = "{home / "photos of a house"}"', (out / "config.toml").read_text(), count=1
    )
    (out / "config.toml").unlink()
    (out / "config.toml").write_text(config)
    with plain_reports():
        for stage in ("control", "targets", "georef"):
            answered("stage", stage, out, "--set", "georef.control=none", "--set", "export.viewer_megabytes=0.0")
    return out


def marks_in(file: Path) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the pixel of each (point, photo) that a control file has."""
    return {
        (point.name, mark.photo): (mark.x, mark.y) for point in read_control_file(file).points for mark in point.marks
    }


def read_points(file: Path) -> list[Any]:
    """Return the points of a control file, which may still have none."""
    lines = [line for line in file.read_text().splitlines()[1:] if not line.startswith("#")]
    return list(read_control_file(file).points) if lines else []
