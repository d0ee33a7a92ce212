"""Complete a model that was built from some of the verified matches: add all of them, and adjust to convergence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import pycolmap

from splatpipe.pipeline.sfm.model.pixel_tolerance_scale import pixel_tolerance_scale

Progress: TypeAlias = Callable[[int, int, str, str], None]
"""Called with what is done, of how many, the current step, and the unit of both."""

MIN_MATCHES = 15  # verified matches of a pair; COLMAP's own minimum
STRICT_PX = 2.0  # filtered observations return only within this error, or they would come and go forever
MAX_FILTERED_SHARE = 2e-3  # share of observations filtered after a robust adjustment: so few had hardly any influence
MAX_ROUNDS = 4
ROUGH_TOLERANCE, ROUGH_ITERATIONS = 1e-4, 10  # relative change of the cost: before wrong observations are filtered
FINE_TOLERANCE, FINE_ITERATIONS = 1e-5, 100
GRADIENT_TOLERANCE = 1e-6  # COLMAP's 1.0 stops while a focal length is still some pixels off
# Photos up to which the cameras' system is factorized. COLMAP iterates above 1,000: of 2,000 photos, the rough
# adjustment takes 132 CPU seconds so, and 77 this way.
MAX_DIRECT = 10_000
# Wrong matches along an epipolar line have no third view to expose them, and bias the cameras. On flights with known
# ground truth Cauchy loss left a third less of that bias than SOFT_L1, and the demo's centres 13 % nearer to the truth.
ADJUSTING = "adjusting everything (at most)"
ROBUST_PX = 1.0  # scale of the loss: twice the keypoint noise


def complete(
    model: pycolmap.Reconstruction,
    database: Path,
    options: pycolmap.IncrementalPipelineOptions,
    stop: pycolmap.CancellationToken,
    place_left: bool = True,
    on_progress: Progress = lambda *_: None,
) -> None:
    """Add all verified matches to a model, in place, and adjust it to convergence, on one thread.

    Every verified match is triangulated with the current cameras, tracks are completed and merged, photos that need
    all matches are placed, and wrong observations are filtered between the adjustments.

    Args:
        model: Some of the database's photos with cameras, in any frame.
        database: The database that the model's keypoint indices refer to.
        options: The mapper's options, with its seeds.
        stop: Ends an adjustment early.
        place_left: Also place photos that need all matches; the ladder, with its own criteria, passes False.
        on_progress: Called from this thread before each photo and each round of adjustment.
    """
    mapper = pycolmap.IncrementalMapper(read_correspondences(database))
    mapper.begin_reconstruction(model)
    triangulation, mapping = options.get_triangulation(), options.get_mapper()
    placed = sorted(model.reg_image_ids())
    for done, number in enumerate(placed):
        on_progress(done, len(placed), "adding all matches", "photos")
        mapper.triangulate_image(triangulation, number)
    mapper.complete_and_merge_tracks(triangulation)
    if place_left:
        _place_left(mapper, mapping, triangulation)
    on_progress(0, 1 + MAX_ROUNDS, ADJUSTING, "rounds")
    _adjust(mapper, options, stop, rough=True)
    mapper.filter_points(mapping)
    triangulation.complete_max_reproj_error = STRICT_PX * pixel_tolerance_scale(model.cameras.values())
    for number in range(1, 1 + MAX_ROUNDS):
        on_progress(number, 1 + MAX_ROUNDS, ADJUSTING, "rounds")
        mapper.complete_and_merge_tracks(triangulation)
        _adjust(mapper, options, stop, rough=False)
        if mapper.filter_points(mapping) <= MAX_FILTERED_SHARE * model.compute_num_observations():
            break
    mapper.filter_frames(mapping)
    mapper.end_reconstruction(False)
    model.update_point_3d_errors()


def settle(
    model: pycolmap.Reconstruction,
    database: Path,
    options: pycolmap.IncrementalPipelineOptions,
    stop: pycolmap.CancellationToken,
) -> None:
    """Adjust a model roughly, in place, on one thread, and filter wrong observations.

    Args:
        model: Some of the database's photos, with cameras and points.
        database: The database that the model was mapped from.
        options: The mapper's options.
        stop: Ends the adjustment early.
    """
    mapper = pycolmap.IncrementalMapper(read_correspondences(database))
    mapper.begin_reconstruction(model)
    mapper.complete_and_merge_tracks(options.get_triangulation())
    _adjust(mapper, options, stop, rough=True)
    mapper.filter_points(options.get_mapper())
    mapper.filter_frames(options.get_mapper())
    mapper.end_reconstruction(False)


def read_correspondences(database: Path) -> pycolmap.DatabaseCache:
    """Read what COLMAP's mapper works on: photos, keypoints and verified matches. It does not change them."""
    options = pycolmap.DatabaseCacheOptions()
    options.min_num_matches = MIN_MATCHES
    with pycolmap.Database.open(database) as opened:
        return pycolmap.DatabaseCache.create(opened, options)


def _place_left(
    mapper: pycolmap.IncrementalMapper,
    mapping: pycolmap.IncrementalMapperOptions,
    triangulation: pycolmap.IncrementalTriangulatorOptions,
) -> None:
    """Place photos that the reduced matches could not; the mapper tries each a few times."""
    candidates = mapper.find_next_images(mapping, False)
    while candidates:
        for number in candidates:
            if mapper.register_next_image(mapping, number):
                mapper.triangulate_image(triangulation, number)
                break
        candidates = mapper.find_next_images(mapping, False)


def _adjust(
    mapper: pycolmap.IncrementalMapper,
    options: pycolmap.IncrementalPipelineOptions,
    stop: pycolmap.CancellationToken,
    rough: bool,
) -> None:
    """Run a global bundle adjustment through COLMAP's function, since the mapper's method holds the GIL throughout."""
    adjustment = adjustment_options(options, pixel_tolerance_scale(mapper.reconstruction.cameras.values()), rough=rough)
    mapper.observation_manager.filter_observations_with_negative_depth()
    pycolmap.bundle_adjustment(mapper.reconstruction, adjustment, stop)


def adjustment_options(
    options: pycolmap.IncrementalPipelineOptions, coarse: float, *, rough: bool
) -> pycolmap.BundleAdjustmentOptions:
    """Return options of an adjustment on one thread: to convergence with a robust loss, or a rough one without.

    Args:
        options: The mapper's.
        coarse: The cameras' ``pixel_tolerance_scale``.
        rough: Before wrong observations are filtered.
    """
    adjustment = options.get_global_bundle_adjustment()
    solver = adjustment.ceres.solver_options
    adjustment.ceres.max_num_images_direct_sparse_cpu_solver = MAX_DIRECT
    solver.num_threads = 1
    solver.gradient_tolerance = GRADIENT_TOLERANCE
    solver.function_tolerance = ROUGH_TOLERANCE if rough else FINE_TOLERANCE
    solver.max_num_iterations = ROUGH_ITERATIONS if rough else FINE_ITERATIONS
    if not rough:
        adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        adjustment.ceres.loss_function_scale = ROBUST_PX * coarse
    return adjustment
