"""Test mapping on captures that provoke bent and folded models, and on sound ones.

    bent_captures DEMO_OUT [--others OUT …] [--folds OUT …] [--sound OUT …] [--only NAME …]

Each OUT is a run up to `matches` (``splatpipe run demo/capture/photos OUT --preset preview --until matches``). Ten
variants are derived from the demo's database: the focal length is no longer known (COLMAP's guess of 1.2 times the
longer side, without a prior), and verified pairs are thinned by a rule and a seed until incremental mapping goes wrong:
random trees of pairs, so that no loop closes; trees with a few triangles; the photo sequence with a few bridges;
matches only near the image centre. Of every other capture (castle and fox, of rows of windows and a patterned
wallpaper) five variants are derived.

Each variant is mapped by the pipeline. The error is the RMS distance of the camera centres from the truth after a
least-squares similarity: the demo's known one, otherwise the cameras of the whole capture. The answer is right if nine
tenths of the photos are registered within three times the demo's sound error, or within 0.5 % of the cameras' extent
(RMS distance from their mean), or if the model is reported as bad. No sound capture may be reported as bad.

A folded capture is a sound one whose photos are said to show two places, those of odd numbers one and those of even
numbers the other, that look alike in a part of the scene: of the matches between the two, only those of points in that
part are kept. The model in which the two places are one explains all matches. It has to be reported as bad.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from measure import SilentReporter
from tables import Row, print_table

from splatpipe.demo import capture_path
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.photos.files.photo_list import load_photo_list
from splatpipe.pipeline.sfm.capture import MappingInput
from splatpipe.pipeline.sfm.judging.doubles import doubles_reasons, find_doubles
from splatpipe.pipeline.sfm.judging.judging import judge
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph, read_verified
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.reconstruct import reconstruct
from splatpipe.pipeline.sfm.recovery.ladder import run_ladder
from splatpipe.stages.line import LINE, MATCHES

RELATIVE_FOCAL_GUESS = 1.2  # focal length over the longer side that COLMAP assumes if nothing is known
MIN_PLACED_SHARE = 0.9  # share of the photos
MAX_ERROR_TIMES, SOUND_M = 3.0, 3.6e-3  # times the demo's sound error, metres
MAX_RELATIVE_ERROR = 0.005  # error over the RMS distance of the cameras from their mean, for captures without truth
FOLDED = (0.3, 0.5)  # shares of a scene that look alike
MIN_MATCHES = 15  # fewest matches with which a pair is kept

Pair = tuple[int, int]
Truth = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class ThinnedGraph:
    """Rule by which a view graph is thinned.

    Attributes:
        name: Name in the table.
        pairs: Selects the pairs to keep.
        middle: Share of the image's sides, around its centre, in which matches are kept.
    """

    name: str
    pairs: Callable[[ViewGraph], Collection[Pair]]
    middle: float = 1.0


def tree(seed: int, least: int, triangles: int) -> Callable[[ViewGraph], Collection[Pair]]:
    """Select a random spanning tree of the pairs with at least ``least`` matches, and pairs that close triangles."""

    def choose(verified: ViewGraph) -> Collection[Pair]:
        rng = np.random.default_rng(seed)
        strong = [pair for pair, rows in verified.matches.items() if len(rows) >= least]
        group = {number: number for number in verified.names}
        kept: set[Pair] = set()
        for index in rng.permutation(len(strong)).tolist():
            i, j = strong[index]
            if group[i] != group[j]:
                kept.add((i, j))
                old, new = group[i], group[j]
                group = {number: new if of == old else of for number, of in group.items()}
        beside = {number: {j for pair in kept if number in pair for j in pair} for number in verified.names}
        closing = [pair for pair in strong if pair not in kept and beside[pair[0]] & beside[pair[1]]]
        order = rng.permutation(len(closing))[:triangles]
        return kept | {closing[index] for index in order.tolist()}

    return choose


def sequence(reach: int, bridges: Collection[Pair]) -> Callable[[ViewGraph], Collection[Pair]]:
    """Select pairs of consecutive photos, and a few pairs between the flights."""
    return lambda verified: {pair for pair in verified.matches if pair[1] - pair[0] <= reach or pair in bridges}


BRIDGES = {(7, 22), (16, 17), (31, 32), (1, 16), (12, 26)}
VARIANTS = [
    *(ThinnedGraph(f"tree {seed}", tree(seed, 200, 0)) for seed in (3, 4, 6, 7, 8)),
    *(ThinnedGraph(f"triangles {seed}", tree(seed, 80, 15)) for seed in (3, 5, 7)),
    ThinnedGraph("sequence", sequence(1, BRIDGES)),
    ThinnedGraph("middle", lambda verified: verified.matches, middle=0.3),
]


OTHERS = [
    *(ThinnedGraph(f"tree {seed}", tree(seed, 60, 0)) for seed in (1, 2)),
    *(ThinnedGraph(f"triangles {seed}", tree(seed, 40, 15)) for seed in (1, 2)),
    ThinnedGraph("sequence", sequence(1, ())),
]
COLUMNS = {"capture": "name", "photos": "placed", "mm": "mm:.1f", "attempt": "how", "mappings": "mappings"}
COLUMNS |= {"against": "against", "gain": "gain:.4f", "missing": "missing:.3f", "verdict": "verdict", "is": "is"}
COLUMNS |= {"CPU s": "cpu:.0f", "judging s": "judging:.1f"}


def thin(source: Path, target: Path, variant: ThinnedGraph) -> None:
    """Write a thinned variant of a match database."""
    verified = read_verified(source)
    kept = set(variant.pairs(verified))
    with pycolmap.Database.open(source) as old, pycolmap.Database.open(target) as new:
        for camera in sorted(old.read_all_cameras(), key=lambda camera: camera.camera_id):
            camera.has_prior_focal_length = False
            params = np.array(camera.params)
            params[list(camera.focal_length_idxs())] = RELATIVE_FOCAL_GUESS * max(camera.width, camera.height)
            camera.params = params
            new.write_camera(camera, use_camera_id=True)
        for rig in sorted(old.read_all_rigs(), key=lambda rig: rig.rig_id):
            new.write_rig(rig, use_rig_id=True)
        for frame in sorted(old.read_all_frames(), key=lambda frame: frame.frame_id):
            new.write_frame(frame, use_frame_id=True)
        for image in sorted(old.read_all_images(), key=lambda image: image.image_id):
            new.write_image(image, use_image_id=True)
            new.write_keypoints(image.image_id, old.read_keypoints(image.image_id))
        for i, j in sorted(kept):
            geometry = old.read_two_view_geometry(i, j)
            rows = np.asarray(geometry.inlier_matches)
            rows = rows[_in_middle(verified, i, rows[:, 0], variant) & _in_middle(verified, j, rows[:, 1], variant)]
            if len(rows) >= MIN_MATCHES:
                geometry.inlier_matches = rows
                new.write_two_view_geometry(i, j, geometry)


def _in_middle(verified: ViewGraph, number: int, rows: np.ndarray, variant: ThinnedGraph) -> np.ndarray:
    camera = verified.cameras[verified.camera_of[number]]
    size = np.array([camera.width, camera.height])
    off = np.abs(verified.keypoints[number][rows] - size / 2.0)
    return np.asarray((off <= variant.middle * size / 2.0).all(axis=1))


def error_m(model: pycolmap.Reconstruction, truth: Truth) -> float:
    """Return the RMS distance of the camera centres from the truth after a least-squares similarity, in metres."""
    images = [model.images[number] for number in sorted(model.reg_image_ids())]
    here = np.array([image.projection_center() for image in images])
    there = np.array([truth[image.name] for image in images])
    middle = here.mean(axis=0), there.mean(axis=0)
    one, two = here - middle[0], there - middle[1]
    u, values, vt = np.linalg.svd(two.T @ one)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((values * signs).sum() / (one**2).sum())
    off = scale * one @ (u @ np.diag(signs) @ vt).T - two
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def open_capture(out: Path, scratch: Path) -> MappingInput:
    """Open a run's capture as the stage `sparse` would see it."""
    folder = open_run_folder(out.resolve(), LINE)
    photos_dir, _ = folder.settings()
    at = {name: part.path for name, part in folder.lineage(MATCHES).items()}
    photos = load_photo_list(at["ingest.photos"])
    numbers = {photo.name: number for number, photo in enumerate(photos.photos, start=1)}
    pairs = json.loads(at["matches.pairs"].read_text(encoding="utf-8"))["pairs"]
    return MappingInput(
        database=at["matches.database"],
        features=at["features.database"],
        colours=np.load(at["features.colours"]),
        photos=photos,
        photos_part=at["ingest.photos"],
        photos_dir=photos_dir,
        positions=json.loads(at["ingest.positions"].read_text(encoding="utf-8"))["positions"],
        cameras=json.loads(at["ingest.cameras"].read_text(encoding="utf-8"))["cameras"],
        scratch=scratch,
        tried=frozenset((numbers[first], numbers[second]) for first, second, _ in pairs),
    )


def answer(capture: MappingInput) -> tuple[pycolmap.Reconstruction, Row]:
    """Return the pipeline's reconstruction and its verdict."""
    began = time.process_time()
    config, report = SparseConfig(), SilentReporter()
    found = run_ladder(capture, reconstruct(capture, config, report), config, report)
    took = time.process_time() - began
    began = time.process_time()
    verdict = judge(found.model, found.verified, capture.cameras)
    doubles = find_doubles(found.model, capture.tried.union(found.verified.matches))
    judging = time.process_time() - began
    verdict = verdict.joined(doubles_reasons(found.verified, doubles))
    chosen = next(row["how"] for row in found.tried if row["chosen"])
    row = {
        "how": chosen,
        "mappings": sum(not row["adjusted"] for row in found.tried),
        "placed": found.model.num_reg_images(),
        "verdict": verdict.level,
        "against": f"{verdict.contradicted}/{verdict.pairs}",
        "gain": verdict.reachable - verdict.score,
        "missing": doubles.ratio,
        "cpu": took,
        "judging": judging,
        "focal": found.model.cameras[min(found.model.cameras)].mean_focal_length(),
    }
    return found.model, row


def demo_truth() -> Truth:
    """Return the demo's camera centres, metres."""
    truth_file = json.loads((capture_path().parent / "truth.json").read_text(encoding="utf-8"))
    return {photo["name"]: np.array(photo["centre_m"]) for photo in truth_file["photos"]}


def truth_of(model: pycolmap.Reconstruction) -> Truth:
    """Return a model's camera centres over their RMS distance from their mean."""
    images = [model.images[number] for number in sorted(model.reg_image_ids())]
    centres = np.array([image.projection_center() for image in images])
    centres = (centres - centres.mean(axis=0)) / np.sqrt(centres.var(axis=0).sum())
    return {image.name: centre for image, centre in zip(images, centres, strict=True)}


def try_variants(out: Path, only: Sequence[str], variants: Sequence[ThinnedGraph], sound_m: float) -> list[Row]:
    """Return a row for each variant of the demo, if its sound run's error is given, or of another capture."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        capture = open_capture(out, scratch)
        truth = demo_truth() if sound_m else truth_of(answer(capture)[0])
        bound = MAX_ERROR_TIMES * sound_m or MAX_RELATIVE_ERROR
        for variant in variants:
            if only and variant.name not in only:
                continue
            database = scratch / f"{variant.name}.db"
            thin(capture.database, database, variant)
            cameras = [{**camera, "has_prior": False, "focal_source": "guess"} for camera in capture.cameras]
            kept = frozenset(read_verified(database).matches)
            model, row = answer(replace(capture, database=database, cameras=cameras, tried=kept))
            error = error_m(model, truth)
            result = {"name": f"{out.name} {variant.name}", **row, "mm": 1e3 * error}
            rows.append({**result, "is": _verdict(row, error, bound, len(truth))})
            print({key: rows[-1][key] for key in rows[-1] if key != "focal"}, flush=True)
    return rows


def _verdict(row: Row, error: float, bound: float, total: int) -> str:
    if row["verdict"] == "bad":
        return "called bad"
    return "right" if row["placed"] >= MIN_PLACED_SHARE * total and error <= bound else "WRONG"


def looks_alike(model: pycolmap.Reconstruction, share: float) -> set[int]:
    """Return the ids of a share of a model's points: those on one side along the scene's longest extent."""
    numbers = sorted(model.points3D)
    points = np.array([model.points3D[number].xyz for number in numbers])
    middle = np.median(points, axis=0)
    near = points[np.linalg.norm(points - middle, axis=1) <= np.quantile(np.linalg.norm(points - middle, axis=1), 0.9)]
    along = (points - middle) @ np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][0]
    return {number for number, place in zip(numbers, along, strict=True) if place <= np.quantile(along, share)}


def fold(source: Path, target: Path, model: pycolmap.Reconstruction, share: float) -> None:
    """Write a capture of two places that look alike in a part of the scene.

    Args:
        source: The database of a sound capture.
        target: The database to write.
        model: Its sound model.
        share: Of the model's points, that look alike: those on one side along the scene's longest direction.
    """
    alike = looks_alike(model, share)

    def kept(image: int, rows: np.ndarray) -> np.ndarray:
        if image not in model.images:
            return np.zeros(len(rows), bool)
        points2d = model.images[image].points2D
        return np.array([points2d[int(row)].point3D_id in alike for row in rows], bool)

    shutil.copyfile(source, target)
    with pycolmap.Database.open(source) as old, pycolmap.Database.open(target) as new:
        for i, j in sorted(read_verified(source).matches):
            if (i - j) % 2:
                geometry = old.read_two_view_geometry(i, j)
                rows = np.asarray(geometry.inlier_matches)
                geometry.inlier_matches = rows[kept(i, rows[:, 0]) & kept(j, rows[:, 1])]
                new.delete_two_view_geometry(i, j)
                if len(geometry.inlier_matches) >= MIN_MATCHES:
                    new.write_two_view_geometry(i, j, geometry)


def try_folds(out: Path, shares: Sequence[float]) -> list[Row]:
    """Return a row for each share of a scene that looks alike."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        capture = open_capture(out, scratch)
        sound = reconstruct(capture, SparseConfig(), SilentReporter()).model
        for share in shares:
            database = scratch / f"{share}.db"
            fold(capture.database, database, sound, share)
            everything = frozenset((i, j) for j in sound.images for i in sound.images if i < j)
            _, row = answer(replace(capture, database=database, tried=everything))
            what = {"bad": "called bad", "doubt": "called doubtful"}.get(str(row["verdict"]), "WRONG")
            rows.append({"name": f"{out.name}, {100 * share:.0f} % alike", **row, "is": what})
            print({key: rows[-1][key] for key in rows[-1] if key != "focal"}, flush=True)
    return rows


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--others", type=Path, nargs="*", default=[])
    parser.add_argument("--folds", type=Path, nargs="*", default=[])
    parser.add_argument("--shares", type=float, nargs="*", default=FOLDED)
    parser.add_argument("--sound", type=Path, nargs="*", default=[])
    parser.add_argument("--only", nargs="*", default=[])
    options = parser.parse_args()
    rows = try_variants(options.out, options.only, VARIANTS, SOUND_M)
    for out in options.others:
        rows += try_variants(out, options.only, OTHERS, 0.0)
    print_table("Captures made to bend", rows, COLUMNS)
    folds = [row for out in options.folds for row in try_folds(out, options.shares)]
    if folds:
        print_table("Captures made to fold", folds, {label: key for label, key in COLUMNS.items() if label != "mm"})
    sound = []
    for out in options.sound:
        with tempfile.TemporaryDirectory() as folder:
            _, row = answer(open_capture(out, Path(folder)))
        sound.append({"name": out.name, **row})
        print(sound[-1], flush=True)
    if sound:
        kept = {label: key for label, key in COLUMNS.items() if label not in ("mm", "is")}
        print_table("Sound captures", sound, {**kept, "focal px": "focal:.0f"})


if __name__ == "__main__":
    main()
