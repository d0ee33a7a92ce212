"""Map verified matches to cameras and points with COLMAP's incremental or global mapper, bitwise reproducibly.

Both run in a thread of their own, so that the calling thread can report progress and be interrupted.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import pycolmap

from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.parallel import run_in_thread
from splatpipe.pipeline.sfm.mapping.completion import MIN_MATCHES, Progress, complete
from splatpipe.pipeline.sfm.mapping.placing import GROWTH, Placement
from splatpipe.pipeline.sfm.matching.reduction import best_keypoints, write_reduced
from splatpipe.pipeline.sfm.model.view_graph import read_verified

Model: TypeAlias = pycolmap.Reconstruction

BEST_KEYPOINTS = 400  # per photo; 700 placed no more photos in any capture, and took up to twice the time
MAX_REDUCED_SHARE = 0.9  # share of the matches left by the reduction, above which it saves nothing
GLOBAL_BA_TOLERANCE = 1e-4  # relative change of the cost at which these adjustments end
ONE_THREAD = 1  # with several, COLMAP's and Ceres' sums depend on which thread finishes first


@dataclass(frozen=True)
class MappingOptions:
    """Options of the mappers.

    Attributes:
        seed: For all random choices.
        min_model_size: Models with fewer photos are dropped.
        relaxed: Accept fewer inliers and a lower inlier ratio for a photo's pose (incremental only).
        hold_focal: Keep focal lengths at the database's values.
        pixel_tolerance_scale: Factor by which pixel thresholds are wider than usual (incremental only).
    """

    seed: int = 0
    min_model_size: int = 3
    relaxed: bool = False
    hold_focal: bool = False
    pixel_tolerance_scale: float = 1.0


def map_incremental(database: Path, scratch: Path, options: MappingOptions, on_progress: Progress) -> list[Model]:
    """Run COLMAP's incremental mapper.

    Cameras are estimated from each photo's best keypoints; then all verified matches are added and everything is
    adjusted.

    Args:
        database: Cameras, images, keypoints and verified two-view geometries; only read.
        scratch: An existing folder for temporary files.
        options: Mapping options.
        on_progress: Called a few times a second from the calling thread.

    Returns:
        All sub-models, the largest first.
    """
    now = (0, _photos(database), "choosing keypoints", "photos")
    stop = pycolmap.CancellationToken()

    def report_step(done: int, of: int, what: str, unit: str) -> None:
        nonlocal now
        now = (done, of, what, unit)

    placement = Placement(incremental_options(options), stop, report_step)

    def work() -> list[Model]:
        pycolmap.set_random_seed(options.seed)  # thread-local
        with tempfile.TemporaryDirectory(prefix="mapping-", dir=scratch, ignore_cleanup_errors=True) as folder:
            found = placement.run(*_reduced(database, Path(folder)), Path(folder))
        for model in found:
            complete(model, database, incremental_options(options), stop, on_progress=report_step)
        return_free_heap()  # of this thread, which no other would use
        return largest_first(found)

    return run_in_thread(work, lambda: on_progress(*now), placement.cancel)


def map_global(database: Path, scratch: Path, options: MappingOptions, on_progress: Progress) -> list[Model]:
    """Run COLMAP's global mapper (GLOMAP; Pan et al., ECCV 2024).

    COLMAP cannot be stopped here: if the calling thread is interrupted, the mapper runs on in the background.

    Args:
        database: Cameras, images, keypoints and verified two-view geometries; only read.
        scratch: An existing folder for temporary files.
        options: Mapping options.
        on_progress: Called a few times a second from the calling thread.

    Returns:
        All sub-models, the largest first.
    """
    total = _photos(database)

    def work() -> list[Model]:
        pycolmap.set_random_seed(options.seed)
        with tempfile.TemporaryDirectory(prefix="mapping-", dir=scratch, ignore_cleanup_errors=True) as folder:
            return largest_first(pycolmap.global_mapping(database, folder, folder, global_options(options)).values())

    return run_in_thread(work, lambda: on_progress(0, total, "placing all photos at once", "photos"), lambda: None)


def _reduced(database: Path, folder: Path) -> tuple[Path, int]:
    """Write a database of the best keypoints' matches; return it, or the whole one if that drops hardly any matches.

    Also returns the number of photos that COLMAP's mapper would place.
    """
    target = folder / "best.db"
    verified = read_verified(database)
    connected = {photo for pair, rows in verified.matches.items() if len(rows) >= MIN_MATCHES for photo in pair}
    kept, total = write_reduced(database, target, best_keypoints(verified, BEST_KEYPOINTS))
    return target if kept < MAX_REDUCED_SHARE * total else database, len(connected)


def incremental_options(options: MappingOptions) -> pycolmap.IncrementalPipelineOptions:
    """Return COLMAP's options for incremental mapping."""
    result = pycolmap.IncrementalPipelineOptions()
    result.min_model_size = options.min_model_size
    result.extract_colors = False  # the keypoints have colours already
    result.random_seed = options.seed
    result.mapper.random_seed = options.seed
    result.triangulation.random_seed = options.seed
    result.num_threads = ONE_THREAD
    # The final adjustment runs to convergence; until then cameras need only be good enough to place the next photo.
    result.ba_global_frames_ratio = result.ba_global_points_ratio = GROWTH
    result.ba_global_max_refinements, result.ba_local_max_refinements = 2, 1
    result.ba_global_max_num_iterations = 20
    result.ba_global_function_tolerance = result.ba_local_function_tolerance = GLOBAL_BA_TOLERANCE
    result.mapper.ba_global_ignore_redundant_points3D = True
    result.mapper.init_max_error *= options.pixel_tolerance_scale
    result.mapper.filter_max_reproj_error *= options.pixel_tolerance_scale
    result.triangulation.complete_max_reproj_error *= options.pixel_tolerance_scale
    result.triangulation.merge_max_reproj_error *= options.pixel_tolerance_scale
    if options.relaxed:
        result.mapper.init_min_num_inliers = 50
        result.mapper.init_min_tri_angle = 6.0
        result.mapper.abs_pose_min_num_inliers = 15
        result.mapper.abs_pose_min_inlier_ratio = 0.15
    if options.hold_focal:
        result.ba_refine_focal_length = False
        result.mapper.abs_pose_refine_focal_length = False
    return result


def global_options(options: MappingOptions) -> pycolmap.GlobalPipelineOptions:
    """Return COLMAP's options for global mapping."""
    result = pycolmap.GlobalPipelineOptions()
    result.multiple_models = True
    result.min_model_size = options.min_model_size
    result.num_threads = ONE_THREAD
    result.mapper.num_threads = ONE_THREAD
    for part in (result, result.mapper, result.mapper.rotation_averaging, result.mapper.global_positioning):
        part.random_seed = options.seed
    result.mapper.retriangulation.random_seed = options.seed
    result.mapper.bundle_adjustment.ceres.solver_options.num_threads = ONE_THREAD
    result.mapper.bundle_adjustment.refine_focal_length = not options.hold_focal
    return result


def largest_first(models: Iterable[Model]) -> list[Model]:
    """Sort models by photos, then by points, largest first; COLMAP's first model may not be the largest."""
    return sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _photos(database: Path) -> int:
    with pycolmap.Database.open(database) as opened:
        return int(opened.num_images())
