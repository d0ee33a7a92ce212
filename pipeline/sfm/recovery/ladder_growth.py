"""Extend a model after photos were added: triangulate points from their matches, and measure the result."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import pycolmap

from splatpipe.pipeline.sfm.mapping.completion import adjustment_options
from splatpipe.pipeline.sfm.mapping.mapping import MappingOptions, incremental_options
from splatpipe.pipeline.sfm.model.pixel_tolerance_scale import pixel_tolerance_scale

MIN_OBSERVATIONS = 15  # points that an added photo must still observe after the adjustment


class ModelMapper:
    """COLMAP's mapper on an existing model; the correspondences must be of the model's keypoints."""

    def __init__(
        self, correspondences: pycolmap.DatabaseCache, model: pycolmap.Reconstruction, options: MappingOptions
    ) -> None:
        pycolmap.set_random_seed(options.seed)
        self._options = incremental_options(options)
        self._triangulation = self._options.get_triangulation()
        self._triangulation.random_seed = options.seed
        self._mapper = pycolmap.IncrementalMapper(correspondences)
        self._mapper.begin_reconstruction(model)
        self._model = model

    def triangulate(self, photos: Sequence[int]) -> None:
        """Triangulate points from the matches of placed photos, then complete and merge tracks."""
        for number in photos:
            self._mapper.triangulate_image(self._triangulation, number)
        self._mapper.complete_and_merge_tracks(self._triangulation)

    def place_by_pairs(self, photos: Sequence[int]) -> list[int]:
        """Place photos by matches with placed ones that have no points yet, and triangulate these.

        COLMAP's structure-less registration: the pose that most matches' rays agree with, over several placed photos.

        Returns:
            The photos that were placed; the caller must still check them against their matches.
        """
        mapping, placed = self._options.get_mapper(), []
        for number in photos:
            known = self._model.exists_image(number)  # False for a photo without matches
            if known and self._mapper.register_next_structure_less_image(mapping, number):
                self._mapper.triangulate_image(self._triangulation, number)
                placed.append(number)
        self._mapper.complete_and_merge_tracks(self._triangulation)
        return placed

    def adjust(self, photos: Collection[int]) -> None:
        """Adjust some photos and the points that they observe to the other photos, which stay; then filter points.

        The camera of a photo is adjusted too if no other photo has it.
        """
        moved = sorted(photos)
        for rough in (True, False):
            options = adjustment_options(
                self._options, pixel_tolerance_scale(self._model.cameras.values()), rough=rough
            )
            problem = _only(self._model, moved)
            pycolmap.create_default_bundle_adjuster(options, problem, self._model).solve()
            self._mapper.filter_points(self._options.get_mapper())
        self._mapper.complete_and_merge_tracks(self._triangulation)

    def end(self) -> None:
        """Detach the mapper from the model, keeping all of it."""
        self._mapper.end_reconstruction(False)


def _only(model: pycolmap.Reconstruction, photos: Sequence[int]) -> pycolmap.BundleAdjustmentConfig:
    """The parameters of some photos: their poses, points, and the cameras that no other photo has."""
    config = pycolmap.BundleAdjustmentConfig()
    for number in photos:
        config.add_image(number)
        for keypoint in model.images[number].get_observation_points2D():
            config.add_variable_point(keypoint.point3D_id)
    others = set(model.reg_image_ids()).difference(photos)
    for camera in sorted({model.images[number].camera_id for number in others}):
        config.set_constant_cam_intrinsics(camera)
    return config


def observations(model: pycolmap.Reconstruction, photos: Collection[int]) -> dict[int, int]:
    """Count the keypoints of each photo that observe a point; none if an adjustment has dropped the photo."""
    return {
        number: int(model.images[number].num_points3D) if number in model.images else 0 for number in sorted(photos)
    }


def mean_error_px(model: pycolmap.Reconstruction) -> float:
    """Return the mean reprojection error over all observations, pixels; infinite without points."""
    model.update_point_3d_errors()
    if model.num_points3D() == 0:
        return float(np.inf)
    return float(model.compute_mean_reprojection_error())
