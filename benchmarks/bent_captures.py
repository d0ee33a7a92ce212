"""Test mapping on captures that provoke bent models, and on sound ones.

    bent_captures.py DEMO_OUT [--sound OUT …] [--only NAME …]

DEMO_OUT is a run of the demo up to `matches` (``splatpipe demo OUT --until matches``). Ten variants are derived from
its database: the focal length is no longer known (COLMAP's guess of 1.2 times the longer side, without a prior), and
verified pairs are thinned by a rule and a seed until incremental mapping goes wrong: random trees of pairs, so that no
loop closes; trees with a few triangles; the photo sequence with a few bridges; matches only near the image centre.

Each variant is mapped twice: as splatpipe did before this benchmark (COLMAP's incremental mapper with its defaults, on
one thread, and again with lower thresholds if it registered less than half of the photos), and by the pipeline. The
error is the RMS distance of the camera centres from the demo's truth after a least-squares similarity. A model is bent
if nine tenths of the photos are registered but the error is more than three times that of the sound run, and incomplete
if fewer are registered. The pipeline's answer is right if nine tenths are registered within three times the error, or
if it reports the model as bad. No sound capture may be reported as bad.
"""

from __future__ import annotations

import argparse
import json
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
from splatpipe.pipeline.engine.run_folder import open_run_folder
from splatpipe.pipeline.photos.photo_list import load_photo_list
from splatpipe.pipeline.sfm.capture import MappingInput
from splatpipe.pipeline.sfm.judging import judge
from splatpipe.pipeline.sfm.ladder import run_ladder
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.reconstruct import reconstruct
from splatpipe.pipeline.sfm.view_graph import ViewGraph, read_verified
from splatpipe.stages.line import LINE, MATCHES

GUESS = 1.2  # of the longer side: COLMAP's guess if nothing is known
PLACED = 0.9  # share of the photos
TIMES = 3.0  # times the sound run's error
MIN_MATCHES = 15  # of a pair that is kept

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


def thin(source: Path, target: Path, variant: ThinnedGraph) -> None:
    """Write a thinned variant of a match database."""
    verified = read_verified(source)
    kept = set(variant.pairs(verified))
    with pycolmap.Database.open(source) as old, pycolmap.Database.open(target) as new:
        for camera in sorted(old.read_all_cameras(), key=lambda camera: camera.camera_id):
            camera.has_prior_focal_length = False
            params = np.array(camera.params)
            params[list(camera.focal_length_idxs())] = GUESS * max(camera.width, camera.height)
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


def map_as_before(database: Path, scratch: Path) -> pycolmap.Reconstruction | None:
    """Run COLMAP's incremental mapper with its defaults; again with lower thresholds if it registers under half."""
    total = len(read_verified(database).names)
    best = None
    for relaxed in (False, True):
        options = pycolmap.IncrementalPipelineOptions()
        options.min_model_size, options.num_threads, options.extract_colors = 3, 1, False
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
        if relaxed:
            options.mapper.init_min_num_inliers, options.mapper.init_min_tri_angle = 50, 6.0
            options.mapper.abs_pose_min_num_inliers, options.mapper.abs_pose_min_inlier_ratio = 15, 0.15
        pycolmap.set_random_seed(0)
        with tempfile.TemporaryDirectory(dir=scratch) as folder:
            found = pycolmap.incremental_mapping(database, folder, folder, options)
        for model in found.values():
            if best is None or model.num_reg_images() > best.num_reg_images():
                best = model
        if best is not None and best.num_reg_images() >= total / 2:
            break
    return best


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
    folder = open_run_folder(out, LINE)
    photos_dir, _ = folder.settings()
    at = {name: part.path for name, part in folder.lineage(MATCHES).items()}
    return MappingInput(
        database=at["matches.database"],
        features=at["features.database"],
        colours=np.load(at["features.colours"]),
        photos=load_photo_list(at["ingest.photos"]),
        photos_part=at["ingest.photos"],
        photos_dir=photos_dir,
        positions=json.loads(at["ingest.positions"].read_text(encoding="utf-8"))["positions"],
        cameras=json.loads(at["ingest.cameras"].read_text(encoding="utf-8"))["cameras"],
        scratch=scratch,
    )


def answer(capture: MappingInput) -> tuple[pycolmap.Reconstruction, Row]:
    """Return the pipeline's reconstruction and its verdict."""
    began = time.process_time()
    config, report = SparseConfig(), SilentReporter()
    found = run_ladder(capture, reconstruct(capture, config, report), config, report)
    took = time.process_time() - began
    verdict = judge(found.model, found.verified, capture.cameras)
    chosen = next(row["how"] for row in found.tried if row["chosen"])
    row = {
        "how": chosen,
        "placed": found.model.num_reg_images(),
        "verdict": verdict.level,
        "against": f"{verdict.contradicted}/{verdict.pairs}",
        "cpu": took,
        "focal": found.model.cameras[min(found.model.cameras)].mean_focal_length(),
    }
    return found.model, row


def try_variants(out: Path, only: Sequence[str], sound_mm: float) -> list[Row]:
    """Return a row for the sound capture, unless its error is given, and one for each variant."""
    truth_file = json.loads((capture_path().parent / "truth.json").read_text(encoding="utf-8"))
    truth = {photo["name"]: np.array(photo["centre_m"]) for photo in truth_file["photos"]}
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        capture = open_capture(out, scratch)
        sound = 1e-3 * sound_mm
        if not sound:
            before = map_as_before(capture.database, scratch)
            assert before is not None
            sound = error_m(before, truth)
            model, row = answer(capture)
            first = {"name": "sound", "before_placed": before.num_reg_images(), "before_mm": 1e3 * sound}
            rows.append({**first, **row, "mm": 1e3 * error_m(model, truth), "is": _verdict(row, 0.0, 1.0, len(truth))})
        for variant in VARIANTS:
            if only and variant.name not in only:
                continue
            database = scratch / f"{variant.name}.db"
            thin(capture.database, database, variant)
            before = map_as_before(database, scratch)
            cameras = [{**camera, "has_prior": False, "focal_source": "guess"} for camera in capture.cameras]
            model, row = answer(replace(capture, database=database, cameras=cameras))
            error = error_m(model, truth)
            result = {"name": variant.name, **row, "mm": 1e3 * error, "is": _verdict(row, error, sound, len(truth))}
            if before is not None:
                result |= _before(before, error_m(before, truth), sound, len(truth))
            rows.append(result)
            print(variant.name, result["is"], flush=True)
    return rows


def _before(model: pycolmap.Reconstruction, error: float, sound: float, total: int) -> Row:
    placed = model.num_reg_images()
    what = "incomplete" if placed < PLACED * total else "bent" if error > TIMES * sound else "right"
    return {"before_placed": placed, "before_mm": 1e3 * error, "before": what}


def _verdict(row: Row, error: float, sound: float, total: int) -> str:
    if row["verdict"] == "bad":
        return "called bad"
    return "right" if row["placed"] >= PLACED * total and error <= TIMES * sound else "WRONG"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--sound", type=Path, nargs="*", default=[])
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--sound-mm", type=float, default=0.0, help="the sound run's error before, where it is known")
    options = parser.parse_args()
    columns = {"capture": "name", "before": "before_placed", "mm": "before_mm:.1f", "": "before"}
    columns |= {"now": "placed", "now mm": "mm:.1f", "mapper": "how", "against": "against", "verdict": "verdict"}
    columns |= {"is": "is", "CPU s": "cpu:.0f"}
    print_table(
        "Captures made to bend, of 40 photos", try_variants(options.out, options.only, options.sound_mm), columns
    )
    sound = []
    for out in options.sound:
        with tempfile.TemporaryDirectory() as folder:
            _, row = answer(open_capture(out, Path(folder)))
        sound.append({"name": out.name, **row})
    if sound:
        columns = {"capture": "name", "photos": "placed", "focal px": "focal:.0f", "mapper": "how"}
        columns |= {"against": "against", "verdict": "verdict", "CPU s": "cpu:.0f"}
        print_table("Sound captures", sound, columns)


if __name__ == "__main__":
    main()
