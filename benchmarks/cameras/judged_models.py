"""Bend and fold sound models by known amounts, and list what the judge says: false alarms against misses.

    judged_models OUT …

Each OUT is a run up to `sparse` whose model is right. Nothing is mapped again. Of each model

- half of the cameras, on one side along their longest extent, are turned by some degrees about the one next to the
  others, and scaled about it by as many hundredths: the joint of an incremental mapper;
- the photos are said to show two places, those of odd numbers one and those of even numbers the other, which look alike
  only in a part of the scene (``bent_captures.fold``): points elsewhere are split between the two, and so are matches.

The thresholds in ``judging`` and ``doubles`` are fitted on the captures of the first table and tried on the second's:
every second capture of the command line.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from bent_captures import looks_alike
from tables import Row, print_table

from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.sfm.judging.doubles import RATIO_BAD, RATIO_DOUBT, find_doubles
from splatpipe.pipeline.sfm.judging.judging import GAIN_BAD, GAIN_DOUBT, judge
from splatpipe.pipeline.sfm.model.structure import Structure, cameras_of, make_model, poses_of, read_structure
from splatpipe.pipeline.sfm.model.view_graph import read_verified
from splatpipe.stages.line import LINE, SPARSE

BENDS_DEG = (0.0, 0.1, 0.25, 0.5, 1.0, 4.0)
SHARES = (1.0, 0.95, 0.9, 0.8, 0.7, 0.5, 0.3)  # that look alike


def bent(model: pycolmap.Reconstruction, degrees: float) -> dict[int, pycolmap.Rigid3d]:
    """Return the poses of a model, half of them turned and scaled about one of them."""
    images = [model.images[number] for number in sorted(model.reg_image_ids())]
    centres = np.array([image.projection_center() for image in images])
    main = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)[2]
    along = (centres - centres.mean(axis=0)) @ main[0]
    joint = centres[np.argsort(along)[len(along) // 2]]
    turn = pycolmap.Rotation3d(np.radians(degrees) * main[2]).matrix()
    scale = 1.0 + degrees / 100.0
    poses = {}
    for image, at in zip(images, along, strict=True):
        pose = image.cam_from_world().matrix()
        if at > np.median(along):
            turned = pose[:, :3] @ turn.T
            pose = np.column_stack([turned, -turned @ (joint + scale * turn @ (image.projection_center() - joint))])
        poses[image.image_id] = pycolmap.Rigid3d(pose)
    return poses


def folded(model: pycolmap.Reconstruction, share: float) -> Structure:
    """Return a model's points, those outside of a part of the scene split between odd and even photos."""
    structure, alike = read_structure(model), looks_alike(model, share)
    numbers = {
        tuple(sorted((element.image_id, element.point2D_idx) for element in model.points3D[number].track.elements))
        for number in alike
    }
    points, tracks = [], []
    for point, track in zip(structure.points, structure.tracks, strict=True):
        parts = [track] if tuple(track) in numbers else [[it for it in track if it[0] % 2 == odd] for odd in (0, 1)]
        points += [point for part in parts if len(part) >= 2]
        tracks += [part for part in parts if len(part) >= 2]
    return Structure(np.array(points), tracks)


def judged(out: Path) -> list[Row]:
    """Return what the judge says of a capture's model, bent and folded by each amount."""
    at = {name: part.path for name, part in open_run_folder(out.resolve(), LINE).lineage(SPARSE).items()}
    model, verified = pycolmap.Reconstruction(at["sparse.model"]), read_verified(at["matches.database"])
    if any(len(model.images[number].points2D) != len(verified.keypoints[number]) for number in model.reg_image_ids()):
        return []  # the ladder added keypoints to its own database
    cameras = [{"has_prior": False} for _ in verified.cameras]
    photos = sorted(model.reg_image_ids())
    rows: list[Row] = []
    for degrees in BENDS_DEG:
        moved = make_model(cameras_of(model).values(), bent(model, degrees), verified, Structure(np.zeros((0, 3)), []))
        found = judge(moved, verified, cameras)
        rows.append({"capture": out.name, "kind": "bend", "strength": degrees, "value": found.reachable - found.score})
    everything = [(i, j) for j in photos for i in photos if i < j]
    for share in SHARES:
        parts = make_model(cameras_of(model).values(), poses_of(model), verified, folded(model, share))
        known = everything if share < 1.0 else sorted(verified.matches)
        rows.append({"capture": out.name, "kind": "fold", "strength": share, "value": find_doubles(parts, known).ratio})
    for row in rows:
        print(row, flush=True)
    return rows


def curve(rows: Sequence[Row]) -> list[Row]:
    """Return, for each kind and strength, how many captures are called doubtful or bad, and the least value."""
    table = []
    for kind, doubt, bad in (("bend", GAIN_DOUBT, GAIN_BAD), ("fold", RATIO_DOUBT, RATIO_BAD)):
        of_kind = [row for row in rows if row["kind"] == kind]
        for strength in dict.fromkeys(row["strength"] for row in of_kind):
            values = [float(row["value"]) for row in of_kind if row["strength"] == strength]
            counts = {"good": sum(value < doubt for value in values), "bad": sum(value >= bad for value in values)}
            counts["doubt"] = len(values) - counts["good"] - counts["bad"]
            table.append({"kind": kind, "strength": strength, **counts, "least": min(values), "most": max(values)})
    return table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("outs", type=Path, nargs="+")
    options = parser.parse_args()
    columns = {name: name for name in ("kind", "strength", "good", "doubt", "bad")}
    columns |= {"least": "least:.4f", "most": "most:.4f"}
    for title, outs in (("Fitted on", options.outs[::2]), ("Tried on", options.outs[1::2])):
        rows = [row for out in outs for row in judged(out)]
        names = ", ".join(dict.fromkeys(str(row["capture"]) for row in rows))
        print_table(f"{title} {names}", curve(rows), columns)


if __name__ == "__main__":
    main()
