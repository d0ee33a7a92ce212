"""Points and tracks of a model: photos that only one other photo ties to the rest, and models without some photos."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pycolmap
import pytest
from view_graph import Ring, make_ring, model_of

from splatpipe.pipeline.sfm.model.structure import (
    Structure,
    cameras_of,
    loosely_tied,
    make_model,
    poses_of,
    read_observations,
    read_structure,
    without,
)
from splatpipe.pipeline.sfm.recovery.ladder_growth import observations


@pytest.fixture(scope="module")
def ring() -> Ring:
    return make_ring()


def with_tracks(ring: Ring, tracks: Sequence[Sequence[int]]) -> pycolmap.Reconstruction:
    """Return a model of the photos that are in tracks, each track a point of its own keypoints."""
    used: Counter[int] = Counter()
    elements = []
    for photos in tracks:
        elements.append([(photo, used[photo]) for photo in sorted(photos)])
        used.update(photos)
    model = model_of(ring, photos=sorted(used))
    structure = Structure(np.zeros((len(tracks), 3)), elements)
    return make_model(cameras_of(model).values(), poses_of(model), ring.verified, structure)


def test_a_photo_whose_points_one_other_observes_is_loose(ring: Ring) -> None:
    sound = [(1, 2, 3), (2, 3, 4), (1, 4)]
    assert loosely_tied(with_tracks(ring, sound)) == set()
    assert loosely_tied(with_tracks(ring, [*sound, (4, 5), (4, 5)])) == {5}
    assert loosely_tied(with_tracks(ring, [*sound, (4, 5), (3, 5)])) == set()
    assert loosely_tied(with_tracks(ring, [*sound, (3, 4, 5)])) == set()


def test_a_structure_is_read_as_it_was_written_sorted_by_track(ring: Ring) -> None:
    tracks = [[(2, 7), (3, 0)], [(1, 5), (2, 3), (4, 1)], [(1, 4), (3, 2)], [(1, 0), (2, 4)]]
    points = np.arange(12.0).reshape(4, 3)
    model = model_of(ring, photos=[1, 2, 3, 4])
    model = make_model(cameras_of(model).values(), poses_of(model), ring.verified, Structure(points, tracks))
    found = read_structure(model)
    assert found.tracks == sorted(tracks)
    np.testing.assert_array_equal(found.points, points[[3, 2, 1, 0]])
    empty = read_structure(pycolmap.Reconstruction())
    assert empty.tracks == [] and empty.points.shape == (0, 3)


def test_two_photos_alone_are_not_loose(ring: Ring) -> None:
    assert loosely_tied(with_tracks(ring, [(1, 2), (1, 2)])) == set()


def test_a_photo_that_was_dropped_is_in_no_track_and_observes_nothing(ring: Ring) -> None:
    smaller = without(with_tracks(ring, [(1, 2, 3), (2, 3, 4), (4, 5)]), {5, 6})  # 6 was dropped before
    assert sorted(smaller.reg_image_ids()) == [1, 2, 3, 4]
    assert smaller.num_points3D() == 2  # what 4 alone observes is no point
    assert observations(smaller, [1, 2, 3, 4, 5]) == {1: 1, 2: 2, 3: 2, 4: 1, 5: 0}


def test_observations_name_the_point_of_every_keypoint(ring: Ring) -> None:
    model = with_tracks(ring, [(1, 2, 3), (2, 3, 4), (1, 4)])
    found = read_observations(model)
    assert found.structure().tracks == sorted(found.structure().tracks)
    rows = found.rows(dict.fromkeys((1, 2, 3, 4), 6))
    assert rows[1].tolist() == [0, 1, -1, -1, -1, -1]  # points in the order of their tracks
    assert rows[2].tolist() == [0, 2, -1, -1, -1, -1]
    for photo, keypoint, row in zip(found.photo.tolist(), found.keypoint.tolist(), found.row.tolist(), strict=True):
        assert model.images[photo].points2D[keypoint].point3D_id == found.ids[row]


def test_observations_of_some_photos_leave_out_what_only_others_observe(ring: Ring) -> None:
    model = with_tracks(ring, [(1, 2, 3), (2, 3, 4), (1, 4), (3, 4)])
    found = read_observations(model, {1})
    assert set(found.photo.tolist()) == {1} and len(found.ids) == len(found.points) == 2
    assert len(read_observations(model, ()).ids) == 0
