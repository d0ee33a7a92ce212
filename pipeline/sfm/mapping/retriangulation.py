"""Retriangulate tracks with improved cameras, including matches that mapping left out or filtered."""

from __future__ import annotations

import pycolmap

from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

MAX_ERROR_PX = 4.0  # COLMAP's own limits of mapping
MIN_ANGLE_DEG = 1.5


def retriangulate(model: pycolmap.Reconstruction, verified: ViewGraph, seed: int) -> None:
    """Add the verified matches that a model's cameras explain, in place, and filter observations that they do not.

    Args:
        model: A model with the keypoints of ``verified``.
        verified: The view graph.
        seed: For the triangulation.
    """
    graph = pycolmap.CorrespondenceGraph()
    placed = sorted(model.reg_image_ids())
    for number in placed:
        graph.add_image(number, len(verified.keypoints[number]))
    inside = set(placed)
    for (first, second), rows in sorted(verified.matches.items()):
        if first in inside and second in inside:
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = rows
            graph.add_two_view_geometry(first, second, geometry)
    graph.finalize()
    observations = pycolmap.ObservationManager(model, graph)
    observations.filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)
    triangulator = pycolmap.IncrementalTriangulator(graph, model, observations)
    options = pycolmap.IncrementalTriangulatorOptions()
    options.random_seed = seed
    pycolmap.set_random_seed(seed)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    for number in placed:
        triangulator.triangulate_image(options, number)
    observations.filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)
