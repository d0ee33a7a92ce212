"""The tracks that decide on lenses and shutters: few enough for trial adjustments, some in every photo."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pycolmap
from jaxtyping import Int64

from splatpipe.pipeline.sfm.lenses.held_out import MIN_VIEWS
from splatpipe.pipeline.sfm.lenses.lens_model import is_known, widen

MIN_TRACKS = 400  # tracks used for the decision; fewer are inconclusive
MAX_TRACKS = 6000  # some 30,000 observations for a dozen unknowns per camera
WANTED_PER_PHOTO = 80  # tracks used for the decision
MIN_PER_PHOTO = 20  # adjusted tracks: six unknowns need more than three points


def decision_tracks(model: pycolmap.Reconstruction, seed: int) -> Int64[np.ndarray, " k"]:
    """Choose the points used for the decision, in a seeded order.

    Only points seen by three photos or more; up to ``MAX_TRACKS``, and beyond that only those of photos that still
    have too few.
    """
    numbers = np.array(
        sorted(number for number, point in model.points3D.items() if point.track.length() >= MIN_VIEWS), np.int64
    )
    mixed = np.random.default_rng(seed).permutation(numbers)
    if len(mixed) <= MAX_TRACKS:
        return np.asarray(mixed)
    seen: Counter[int] = Counter()
    taken = []
    for place, number in enumerate(mixed.tolist()):
        photos = {element.image_id for element in model.points3D[number].track.elements}
        if place < MAX_TRACKS or any(seen[photo] < WANTED_PER_PHOTO for photo in photos):
            seen.update(photos)
            taken.append(number)
    return np.random.default_rng(seed).permutation(np.array(taken, np.int64))


def with_only(model: pycolmap.Reconstruction, points: set[int]) -> pycolmap.Reconstruction:
    """Return a copy with only some of the points, the photos with enough of them, and cameras of the wide models."""
    copy = pycolmap.Reconstruction(model)
    for number in sorted(copy.points3D):
        if number not in points:
            copy.delete_point3D(number)
    seen = Counter(element.image_id for point in copy.points3D.values() for element in point.track.elements)
    observations = pycolmap.ObservationManager(copy)
    for number in sorted(copy.reg_image_ids()):
        if seen[number] < MIN_PER_PHOTO:
            observations.deregister_frame(copy.images[number].frame_id)
    copy.tear_down()  # COLMAP's covariance needs a pose for every photo in the model
    for number, camera in sorted(model.cameras.items()):
        if not copy.exists_camera(number):
            copy.add_camera_with_trivial_rig(camera)
    for camera in copy.cameras.values():
        if is_known(camera.model_name):
            widen(camera)
    return copy
