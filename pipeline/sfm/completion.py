"""A model that stands on some of the verified matches gets all of them, and one last adjustment over everything."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from splatpipe.pipeline.sfm.coarseness import coarseness

LEAST_MATCHES = 15  # verified ones of a pair; COLMAP's own bound
STRICT_PX = 2.0  # observations that were thrown out come back only within it, or they would come and go for ever
SETTLED = 2e-3  # of the observations: thrown out after a robust adjustment, so few had hardly pulled
MOST_ROUNDS = 4
ROUGH_TOLERANCE, ROUGH_ITERATIONS = 1e-4, 10  # relative change of the cost: before the wrong observations are out
FINE_TOLERANCE, FINE_ITERATIONS = 1e-6, 100
GRADIENT_TOLERANCE = 1e-6  # COLMAP's 1.0 ends where a focal length still has some pixels to go
# Wrong matches along an epipolar line have no third view that betrays them, and pull at the cameras. Cauchy's loss left
# a third less of their pull than SOFT_L1 on flights whose truth is known, and the demo's centres 13 % nearer to theirs.
ROBUST_PX = 1.0  # residuals from which on it counts far less than squares: twice what keypoints scatter


def complete(
    model: pycolmap.Reconstruction,
    database: Path,
    options: pycolmap.IncrementalPipelineOptions,
    stop: pycolmap.CancellationToken,
    place_left: bool = True,
) -> None:
    """Bring all verified matches into a model, in place, and adjust it to convergence, on one thread.

    Every verified match is triangulated against the cameras as they stand, tracks are completed and merged, photos
    that only all matches can place are placed, and wrong observations are filtered between the adjustments.

    Args:
        model: Some of the database's photos with cameras, in any frame.
        database: Whose keypoint indices the model refers to.
        options: The mapper's, with its seeds.
        stop: Ends an adjustment early.
        place_left: Place photos that only all matches can place; the ladder has demands of its own.
    """
    cache_options = pycolmap.DatabaseCacheOptions()
    cache_options.min_num_matches = LEAST_MATCHES
    with pycolmap.Database.open(database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, cache_options)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    triangulation, mapping = options.get_triangulation(), options.get_mapper()
    for number in sorted(model.reg_image_ids()):
        mapper.triangulate_image(triangulation, number)
    mapper.complete_and_merge_tracks(triangulation)
    if place_left:
        _place_left(mapper, mapping, triangulation)
    _adjust(mapper, options, stop, rough=True)
    mapper.filter_points(mapping)
    triangulation.complete_max_reproj_error = STRICT_PX * coarseness(model.cameras.values())
    for _ in range(MOST_ROUNDS):
        mapper.complete_and_merge_tracks(triangulation)
        _adjust(mapper, options, stop, rough=False)
        if mapper.filter_points(mapping) <= SETTLED * model.compute_num_observations():
            break
    mapper.filter_frames(mapping)
    mapper.end_reconstruction(False)
    model.update_point_3d_errors()


def _place_left(
    mapper: pycolmap.IncrementalMapper,
    mapping: pycolmap.IncrementalMapperOptions,
    triangulation: pycolmap.IncrementalTriangulatorOptions,
) -> None:
    """Place the photos that some matches could not; the mapper tries each a few times."""
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
    """Adjust over everything; COLMAP's own call, since the mapper's holds Python's lock all the time."""
    adjustment = options.get_global_bundle_adjustment()
    solver = adjustment.ceres.solver_options
    solver.num_threads = 1
    solver.gradient_tolerance = GRADIENT_TOLERANCE
    solver.function_tolerance = ROUGH_TOLERANCE if rough else FINE_TOLERANCE
    solver.max_num_iterations = ROUGH_ITERATIONS if rough else FINE_ITERATIONS
    if not rough:
        adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        adjustment.ceres.loss_function_scale = ROBUST_PX * coarseness(mapper.reconstruction.cameras.values())
    mapper.observation_manager.filter_observations_with_negative_depth()
    pycolmap.bundle_adjustment(mapper.reconstruction, adjustment, stop)
