"""What the stages of a finished run must take at least: operations counted from its records, over what a core can do.

An operation is one lane of a vector instruction; a core's ceiling is its multiply-adds, two vectors a cycle on most.
Counted is what the algorithms in use cannot leave out. Not counted: starting and importing, reading and writing files,
RANSAC, and whatever is not named at a stage below. Stages whose work a run does not record have no limit: bundle
adjustment (`sparse`, `georef`), training in blocks, films and maps.
"""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from ceilings import measure_ceilings
from jaxtyping import UInt8
from rasterizing import contributing_pairs

from splatpipe.pipeline.edit.options import SEEN_MEGAPIXELS
from splatpipe.pipeline.engine.events import parse_event
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.engine.runs.store import Artifact, Store
from splatpipe.pipeline.mvs import dense, depth_maps
from splatpipe.pipeline.mvs.patch_match import ITERATIONS
from splatpipe.pipeline.photos.files.photo_list import load_photo_list, photo_path
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.photos.pixels.images import reduced_camera
from splatpipe.pipeline.photos.pixels.jpeg_strips import OPTIONS
from splatpipe.pipeline.photos.pixels.resampling import ONE_TO_ONE
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.render.consistency import MAX_PAIRS
from splatpipe.pipeline.render.floater_metric import MAX_MEGAPIXELS
from splatpipe.pipeline.sfm.matching.keypoints import single_threaded_opencv
from splatpipe.pipeline.sfm.matching.nearest_descriptors import NEAR_WORDS
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.train.iteration import render_options
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.stages.clean import FEW_PHOTOS
from splatpipe.stages.line import LINE

Numbers = Mapping[str, float]
MEGA = 1e6
TRIES = 5  # the fastest counts
SAMPLED_VIEWS = 4  # training photos in which the finished splat's pairs are counted
MOST_COPIED = 256e6  # bytes

# Operations, as the kernels for AVX-512 have them (raster_blend.cpp, loss_cpu.cpp, patch_match_cpu.cpp).
OCTAVE = (
    2 * (11 + 13 + 17 + 21 + 27) + 5
)  # a pixel of SIFT's octave: five separable blurs of 11 to 27 taps, differences
SCALE_SPACE = 4 * (4 / 3 * OCTAVE + 2 * 11)  # a pixel of a photo, which is doubled at first; octaves add a third
KEYPOINT = (
    2200 * 25
)  # gradients of its orientation and descriptor: samples within 9 and 21 pixels, each weighted, binned
DESCRIPTOR = 128  # products of bytes in one comparison
BLENDED, BLENDED_DEPTH = 24, 32  # a pixel-Gaussian pair, forward: exponent, exp2, weight, colour; with depths
PULLED_BACK = 43  # the same, backward
LOSS = 3 * (4 * 22 + 3 * 22 + 40)  # a pixel: seven separable blurs of 11 taps and SSIM's terms, for three channels
COMPARED = 3 * (5 * 22 + 15)  # a pixel of a held-out photo: SSIM without gradient
PROJECTED = 330 + 600  # a visible Gaussian of SH degree 3, forward and backward
FLOATS = 59  # of a Gaussian
ADAM, ADAM_BYTES = 11 * FLOATS, 28 * FLOATS  # a visible Gaussian's step: value and two means read and written, gradient
WINDOW = 32 * 38  # a PatchMatch window: samples of one photo, each projected, interpolated and summed
CHANGES = (
    6  # random ones tried at a pixel in an iteration; of its neighbours' planes, those nearly the same are skipped
)
BEST_VIEWS = 4  # photos in which planes are tried
BILINEAR, CUBIC = 3 * 5, 3 * 20  # a sample of three channels, with its share of a mean


def last_artifacts(out: Path) -> dict[str, Artifact]:
    """Return the artifact of each stage's last finished attempt, by stage; those that were removed are missing."""
    with (out / "events.jsonl").open("rb") as file:
        finished = [event for event in filter(None, map(parse_event, file)) if event.kind == "stage_finished"]
    keys, store = {event.stage: event.data["key"] for event in finished}, Store(out)
    found = {stage: [each for each in store.artifacts(stage) if each.key == key] for stage, key in keys.items()}
    return {stage: artifacts[0] for stage, artifacts in found.items() if artifacts}


def counts(out: Path) -> dict[str, float]:
    """Count what the stages of a finished run had to do; what a missing artifact would tell is left out."""
    found, numbers = last_artifacts(out), {}
    readers: Mapping[Callable[[Mapping[str, Artifact]], dict[str, float]], Sequence[str]] = {
        _photos: ("ingest", "features"),
        _pairs: ("features", "matches"),
        _resampled: ("ingest", "undistort"),
        _dense: ("undistort", "split", "initialize"),
        _depths: ("undistort", "depths"),
        _trained: ("undistort", "split", "train"),
        _cleaned: ("undistort", "split", "clean"),
        _judged: ("undistort", "evaluate"),
        _exported: ("export",),
    }
    for reader, stages in readers.items():
        if all(stage in found for stage in stages):
            numbers |= reader(found)
    return numbers


def _photos(found: Mapping[str, Artifact]) -> dict[str, float]:
    summary, most = found["ingest"].summary, _option(found["features"], "max_image_size")
    sizes = [(group["photos"], *group["size"]) for group in summary["camera_groups"]]
    searched = sum(n * w * h * min(1.0, most / max(w, h)) ** 2 for n, w, h in sizes)
    keypoints = found["features"].summary["keypoints"]
    return {"read_pixels": MEGA * summary["megapixels"], "searched_pixels": searched, "keypoints": keypoints}


def _pairs(found: Mapping[str, Artifact]) -> dict[str, float]:
    """Products of bytes: with the words of a photo, in the cells, and of each verified match with both photos' all."""
    with sqlite3.connect(
        f"{(found['features'].folder / 'database.db').as_uri()}?mode=ro&immutable=1", uri=True
    ) as base:
        listed = base.execute("SELECT name, rows FROM images JOIN keypoints USING (image_id)").fetchall()
    base.close()
    keypoints, products = dict(listed), 0.0
    pairs = read_json(found["matches"].folder / "pairs.json")["pairs"]
    for first, second, inliers in pairs:
        a, b = keypoints[first], keypoints[second]
        products += DESCRIPTOR * (a * (1 + NEAR_WORDS) * math.sqrt(b) + inliers * (a + b))
    return {"pairs": len(pairs), "products": products}


def _resampled(found: Mapping[str, Artifact]) -> dict[str, float]:
    photos, made = found["ingest"].summary, found["undistort"].summary
    source, target = photos["megapixels"] * made["photos"] / photos["photos"], made["megapixels"]
    reduction = math.sqrt(source / target)  # of whole photos: the crop to no blank borders is not recorded
    work = CUBIC if reduction <= ONE_TO_ONE else BILINEAR * math.ceil(reduction) ** 2
    return {"undistorted_from": MEGA * source, "undistorted": MEGA * target, "resampling": MEGA * target * work}


def _windows(neighbours: int) -> float:
    """PatchMatch windows a pixel of the finest size: all neighbours' to choose photos, random changes in those."""
    each = [rounds * (neighbours + CHANGES * min(BEST_VIEWS, neighbours)) for rounds in ITERATIONS]
    return sum(work / 4**level for level, work in enumerate(reversed(each)))


def _dense(found: Mapping[str, Artifact]) -> dict[str, float]:
    options = found["initialize"]
    photos = _used(options, found["split"].summary["trained_on"], dense.FEW_PHOTOS)
    size = min(_option(options, "max_megapixels"), _megapixels_each(found)) * _option(options, "dense")
    return {"dense_windows": MEGA * photos * size * _windows(min(dense.NEIGHBOURS, photos - 1))}


def _depths(found: Mapping[str, Artifact]) -> dict[str, float]:
    maps = found["depths"].summary
    return {"depth_windows": MEGA * maps["megapixels"] * _windows(min(depth_maps.MAX_MATCHED, maps["maps"] - 1))}


def _trained(found: Mapping[str, Artifact]) -> dict[str, float]:
    """Pixels and Gaussians of all iterations; pairs and visible Gaussians as in the finished splat, in a few photos."""
    folder = found["train"].folder
    history = read_json(folder / "history.json")
    plan = TrainingPlan.from_json((folder / "plan.json").read_text("utf-8")).after(history.get("sizes_ended", ()))
    sizes = plan.schedule.training_sizes_until(found["train"].summary["iterations"])
    ends = [0, *(point["iteration"] for point in history["curve"])]
    lengths = zip(np.diff(ends), history["curve"], strict=True)
    views = [view for view in load_views(found["undistort"].folder / "dataset") if view.camera.name in plan.train_views]
    gaussians, pairs, pixels, visible = read_splat(folder / "model.ply"), 0, 0, 0
    chosen = views[:: math.ceil(len(views) / SAMPLED_VIEWS)]
    for camera in (reduced_camera(view.camera, plan.megapixels) for view in chosen):
        pairs += contributing_pairs(gaussians, camera, plan, plan.schedule.iterations)
        pixels += camera.width * camera.height
        with torch.no_grad():
            seen = rasterizer.render(gaussians, camera, render_options(plan, plan.schedule.at(plan.last_iteration)))
        visible += int(seen.visible.sum())
    share = visible / len(chosen) / len(gaussians)
    return {
        "trained_pixels": sum(plan.footage.pixels(size) for size in sizes),
        "stepped": share * sum(int(length) * int(point["gaussians"]) for length, point in lengths),
        "decoded_to_train": MEGA * len(views) * _megapixels_each(found),
        "pairs_a_pixel": pairs / pixels,
        "stepped_bytes": ADAM_BYTES * share * len(gaussians),
    }


def _cleaned(found: Mapping[str, Artifact]) -> dict[str, float]:
    """Visibility in every training photo; if floaters were found, one pass over those compared, and one to confirm."""
    photos, size = found["split"].summary["trained_on"], _megapixels_each(found)
    compared = _used(found["clean"], photos, FEW_PHOTOS) * (found["clean"].summary["reasons"].get("floating", 0) > 0)
    seen = MEGA * min(SEEN_MEGAPIXELS, size)
    return {
        "visibility_pixels": seen * photos,
        "suspects_pixels": 2 * seen * compared,
        "decoded_to_clean": MEGA * size * compared,
    }


def _judged(found: Mapping[str, Artifact]) -> dict[str, float]:
    photos, size = found["undistort"].summary["photos"], _megapixels_each(found)
    judged = read_json(found["evaluate"].folder / "metrics.json")["per_view"]
    return {
        "decoded_to_judge": MEGA * len(judged) * size,
        "judged_pixels": sum(view["width"] * view["height"] for view in judged),
        "floater_pixels": MEGA * min(photos, MAX_PAIRS) * min(size, MAX_MEGAPIXELS),
    }


def _exported(found: Mapping[str, Artifact]) -> dict[str, float]:
    parts = found["export"].manifest["parts"].values()
    return {"exported_bytes": sum(file["size"] for part in parts for file in part["files"])}


def _option(artifact: Artifact, name: str) -> Any:
    return artifact.manifest["inputs"]["config"][name]


def _used(artifact: Artifact, photos: int, few: int) -> int:
    """Least number of photos that a stage uses of all; as ``covering_photos`` chooses."""
    return photos if _option(artifact, "photos") == "all" else math.ceil(math.sqrt(min(photos, few) * photos))


def _megapixels_each(found: Mapping[str, Artifact]) -> float:
    made = found["undistort"].summary
    return float(made["megapixels"] / made["photos"])


def ceilings(out: Path, numbers: Numbers) -> dict[str, float]:
    """Measure what one core of this machine can do in a second; OpenCV decodes and codes one of the run's photos.

    Returns:
        ``operations`` (lanes), ``products`` (of bytes), ``copied`` (bytes read and written, of an array as large as the
        last step of Adam), pixels of the photo as it was given that are ``skimmed`` (to an eighth) and ``read``, and of
        the undistorted one that are ``decoded`` and coded as ``jpeg`` and ``png``.
    """
    core = measure_ceilings(1)
    found = {
        "operations": 5e8 * float(core["fma_gflops_per_core"]),
        "products": 1e9 * float(core["gproducts_per_core"]),
    }
    block = np.ones(int(min(MOST_COPIED, max(MEGA, numbers.get("stepped_bytes", MOST_COPIED)))) // 2, np.uint8)
    to = block.copy()
    found["copied"] = _per_s(2 * block.size, lambda: np.copyto(to, block))
    if "undistort" not in (made := last_artifacts(out)):  # not yet, or no longer
        return found
    given, undistorted = (np.fromfile(path, np.uint8) for path in _a_photo(out, made))
    with single_threaded_opencv():
        size = _decoded(given).size / 3
        found["skimmed"] = _per_s(size, lambda: cv2.imdecode(given, cv2.IMREAD_REDUCED_COLOR_8))
        found["read"] = _per_s(size, lambda: _decoded(given))
        picture = _decoded(undistorted)
        size = picture.size / 3
        found["decoded"] = _per_s(size, lambda: _decoded(undistorted))
        found["jpeg"] = _per_s(size, lambda: cv2.imencode(".jpg", picture, OPTIONS))
        found["png"] = _per_s(size, lambda: cv2.imencode(".png", picture))
    return found


def _a_photo(out: Path, found: Mapping[str, Artifact]) -> tuple[Path, Path]:
    """The file of a photo as it was given, and undistorted; twice the latter if the former is gone."""
    photos_dir, _ = open_run_folder(out, LINE).settings()
    undistorted = load_views(found["undistort"].folder / "dataset")[0]
    part = found["ingest"].folder / "photos"
    photo = next(photo for photo in load_photo_list(part).photos if photo.name == undistorted.camera.name)
    given = photo_path(photo, part, photos_dir)
    return given if given.is_file() else undistorted.image_path, undistorted.image_path


def _decoded(data: UInt8[np.ndarray, " n"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _per_s(amount: float, work: Callable[[], object]) -> float:
    times = []
    for _ in range(TRIES):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return amount / max(min(times), 1e-9)


def _ingest(n: Numbers, c: Numbers) -> float:
    """Every photo's coefficients are read; no pixels are computed."""
    return n["read_pixels"] / c["skimmed"]


def _features(n: Numbers, c: Numbers) -> float:
    """Decoding; blurs and differences of the scale space; gradients around each keypoint that was kept."""
    work = SCALE_SPACE * n["searched_pixels"] + KEYPOINT * n["keypoints"]
    return n["read_pixels"] / c["read"] + work / c["operations"]


def _matches(n: Numbers, c: Numbers) -> float:
    """Products of descriptors as bytes: with words, in cells, and the check of what matched; no verification."""
    return n["products"] / c["products"]


def _undistort(n: Numbers, c: Numbers) -> float:
    """Decoding, interpolated samples, coding as JPEG."""
    return n["undistorted_from"] / c["read"] + n["resampling"] / c["operations"] + n["undistorted"] / c["jpeg"]


def _initialize(n: Numbers, c: Numbers) -> float:
    """Windows of PatchMatch, without those of neighbours' planes; what is done with the depths is not counted."""
    return WINDOW * n["dense_windows"] / c["operations"]


def _train(n: Numbers, c: Numbers) -> float:
    """Decoding once; pairs blended and pulled back, loss; visible Gaussians projected, pulled back and stepped."""
    work = n["trained_pixels"] * (LOSS + n["pairs_a_pixel"] * (BLENDED + PULLED_BACK)) + n["stepped"] * PROJECTED
    adam = n["stepped"] * max(ADAM / c["operations"], ADAM_BYTES / c["copied"])
    return n["decoded_to_train"] / c["decoded"] + work / c["operations"] + adam


def _clean(n: Numbers, c: Numbers) -> float:
    """Passes for visibility (with depths) and suspects: pairs blended and pulled back; photos decoded once."""
    seen = n["visibility_pixels"] * (BLENDED_DEPTH + PULLED_BACK) + n["suspects_pixels"] * (BLENDED + PULLED_BACK)
    return n["decoded_to_clean"] / c["decoded"] + seen * n["pairs_a_pixel"] / c["operations"]


def _evaluate(n: Numbers, c: Numbers) -> float:
    """Held-out photos decoded, rendered, compared by SSIM, three PNGs each; depths for floaters, without the veil's."""
    renders = n["pairs_a_pixel"] * (n["judged_pixels"] * BLENDED + n["floater_pixels"] * BLENDED_DEPTH)
    coding = n["decoded_to_judge"] / c["decoded"] + 3 * n["judged_pixels"] / c["png"]
    return coding + (renders + n["judged_pixels"] * COMPARED) / c["operations"]


def _export(n: Numbers, c: Numbers) -> float:
    """Bytes of its files, written once and read once."""
    return 2 * n["exported_bytes"] / c["copied"]


def _depth_maps(n: Numbers, c: Numbers) -> float:
    """Windows of PatchMatch, as for `initialize`."""
    return WINDOW * n["depth_windows"] / c["operations"]


LIMITS: Mapping[str, Callable[[Numbers, Numbers], float]] = {
    "ingest": _ingest,
    "features": _features,
    "matches": _matches,
    "undistort": _undistort,
    "initialize": _initialize,
    "train": _train,
    "clean": _clean,
    "evaluate": _evaluate,
    "export": _export,
    "depths": _depth_maps,
}


def limits(numbers: Numbers, core: Numbers) -> dict[str, float]:
    """Return the least seconds of a core for each stage whose counts are known and not 0."""
    found = {}
    for stage, limit in LIMITS.items():
        try:
            seconds = limit(numbers, core)
        except KeyError:  # not recorded, or without a photo to measure the ceiling with
            continue
        if seconds > 0.0:
            found[stage] = seconds
    return found
