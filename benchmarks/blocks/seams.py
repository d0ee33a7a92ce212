"""Detect visible block borders in a splat: ``seams OUT COARSE.ply [--merged MERGED.ply] [--partition FILE]``.

OUT is a run; its splat, or MERGED in its place, is examined along the borders of a partition (JSON as written by
``Partition.facts``; without it, OUT's site is cut into ``--blocks`` cells) against COARSE, a splat in the same frame
without blocks. With ``--plant`` the splat is assumed to be seamless: gaps, doubled surfaces and colour steps of graded
strength are planted on its longest borders, and the table shows which are found. Sizes are in pixels of a camera above
the border, colours 0 to 1.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from block_borders import Border, PlanLine, borders
from opened_run import OpenedRun, open_run
from planted_seams import STRIP, colour_step, doubled, gap
from seam_detector import Seam, border_cameras, find_seams
from tables import Row, print_table

from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.ground_plan import GroundPlan
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.train.blocks.cells.cutting import cut, site, work_map
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import photo_coverages

GRADES = {  # what is planted: pixels empty, pixels higher, of the colour's range
    "gap": (1.0, 2.0, 4.0, 8.0),
    "doubled": (1.0, 2.0, 4.0),
    "colour": (0.01, 0.02, 0.04, 0.08),
}
PLANTED_BORDERS = 2  # the longest
COLUMNS = {
    "border": "border:",
    "length m": "length:.1f",
    "planted": "planted:",
    "strength": "strength:",
    "found": "found:",
    "by": "measure:",
    "size": "size:.3f",
    "score": "score:.1f",
    "from m": "start:.1f",
    "to m": "end:.1f",
}


@dataclass(frozen=True, eq=False)
class SeamScene:
    """Context in which borders are examined.

    Attributes:
        run: The run.
        partition: The run's cells.
        cameras: Cameras of its photos, at training size.
        coarse: The model without blocks.
        metres: Metres per unit of the model's frame.
    """

    run: OpenedRun
    partition: Partition
    cameras: Sequence[Camera]
    coarse: Gaussians
    metres: float

    def seams(self, splat: Gaussians, line: PlanLine) -> list[Seam]:
        """Return the visible seams on a border of a splat."""
        return find_seams((splat, self.coarse), self.partition.plan, line, self.cameras, self.run.options)

    def pixel(self, splat: Gaussians, line: PlanLine) -> float:
        """Return a pixel's size on the surface below the cameras above a border, world units."""
        cameras, height = border_cameras(splat, self.partition.plan, line, self.cameras, self.run.options)
        return height / cameras[0].fx


def open_site(arguments: argparse.Namespace) -> SeamScene:
    """Read what the command line names.

    Raises:
        SplatpipeError: if something is missing or broken.
    """
    run = open_run(arguments.out)
    frame = load_frame(run.parts["georef.frame"].path).world_from_model
    cameras = [run.camera(view) for view in run.views]
    if arguments.partition is not None:
        try:
            partition = Partition.of_facts(json.loads(arguments.partition.read_text(encoding="utf-8")))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(f"{arguments.partition} is no partition: {error}") from error
    else:
        points, tracks = load_points_and_tracks(run.parts["undistort.dataset"].path)
        seen = photo_coverages(cameras, [tracks[camera.name] for camera in cameras], run.median_depth)
        plan = GroundPlan.across(frame.rotation[2])
        partition = cut(work_map(plan, site(plan, seen, points.xyz), seen, points.xyz), arguments.blocks)
    return SeamScene(run, partition, cameras, read_splat(arguments.coarse), frame.scale)


def judged(place: SeamScene, splat: Gaussians, border: Border) -> Iterator[Row]:
    """Yield a row for each seam on a border, or one stating that there is none."""
    facts: Row = {"border": f"{border.blocks[0]}–{border.blocks[1]}", "length": border.line.length * place.metres}
    seams = place.seams(splat, border.line)
    for seam in seams:
        response = seam.response
        row = {"found": seam.kind, "measure": f"{response.measure}, {2 * response.width} px", "size": response.size}
        yield (
            facts
            | row
            | {
                "score": response.score,
                "start": seam.start * place.metres,
                "end": seam.end * place.metres,
            }
        )
    if not seams:
        yield facts | {"found": "-"}


def planted(place: SeamScene, splat: Gaussians, border: Border) -> Iterator[Row]:
    """Yield a row for each seam planted on a border: the detection of its kind, or else the first other one."""
    plan, line = place.partition.plan, border.line
    pixel = place.pixel(splat, line)
    plants: dict[str, Callable[[float], Gaussians]] = {
        "gap": lambda strength: gap(splat, plan, line, strength * pixel),
        "doubled": lambda strength: doubled(splat, plan, line, strength * pixel, STRIP * pixel),
        "colour": lambda strength: colour_step(splat, plan, line, strength),
    }
    for kind, grades in GRADES.items():
        for strength in grades:
            rows = list(judged(place, plants[kind](strength), border))
            row = next((row for row in rows if row["found"] == kind), rows[0])
            unit = "" if kind == "colour" else " px"
            yield row | {"planted": kind, "strength": f"{strength:g}{unit}"}


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path, help="OUT of a run that was trained")
    options.add_argument("coarse", type=Path, help="splat of the same frame without blocks")
    options.add_argument("--merged", type=Path, help="splat in the place of OUT's")
    options.add_argument("--partition", type=Path, help="JSON of the cells")
    options.add_argument("--blocks", type=int, default=4, help="cells without it")
    options.add_argument("--plant", action="store_true", help="put seams of graded strength on the longest borders")
    options.add_argument("--threads", type=int, default=1)
    arguments = options.parse_args()
    try:
        with same_bits(arguments.threads):
            place = open_site(arguments)
            splat = place.run.model[0] if arguments.merged is None else read_splat(arguments.merged)
            inner = borders(place.partition)
            rows = [row for border in inner for row in judged(place, splat, border)]
            longest = sorted(inner, key=lambda border: -border.line.length)[:PLANTED_BORDERS]
            rows += [row for border in longest if arguments.plant for row in planted(place, splat, border)]
    except SplatpipeError as error:
        options.exit(error.exit_code, f"{error.message} {error.hint}\n")
    print_table(f"borders of {len(place.partition.cells)} cells", rows, COLUMNS)
    found = sum(row["found"] != "-" for row in rows if "planted" not in row)
    print(f"{found} seams on {len(inner)} borders")
    if arguments.plant:
        hit = [row for row in rows if "planted" in row and row["found"] == row["planted"]]
        print(f"{len(hit)} of {sum('planted' in row for row in rows)} planted seams found")


if __name__ == "__main__":
    main()
