"""The ladder on a room with known cameras: unregistered photos are placed correctly, or not at all."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import corner_photos
import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.photos.files.photo_list import load_photo_list
from splatpipe.pipeline.sfm.capture import MappingInput, MappingResult
from splatpipe.pipeline.sfm.mapping.mapping import MappingOptions, map_incremental
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph, read_verified
from splatpipe.pipeline.sfm.options import FeaturesConfig, MatchesConfig, SparseConfig
from splatpipe.pipeline.sfm.recovery.ladder import LadderContext, register_until_stable, run_ladder, without
from splatpipe.pipeline.sfm.recovery.ladder_joins import join
from splatpipe.pipeline.sfm.recovery.ladder_pairs import match_more, propose_pairs
from splatpipe.stages import features, matches

COUNT = 8
FAST = FeaturesConfig(extractor="opencv-sift", max_features=1500)


def matched(inputs: Inputs, folder: Path) -> MappingInput:
    """Return the output of `features` and `matches` for a capture."""
    recorder = corner_photos.Recorder()
    for stage in ("features", "matches", "scratch"):
        (folder / stage).mkdir(parents=True)
    features.run(FAST, inputs, folder / "features", recorder)
    inputs = corner_photos.with_parts(inputs, features__database=folder / "features" / "database.db")
    matches.run(MatchesConfig(), inputs, folder / "matches", recorder)
    return MappingInput(
        database=folder / "matches" / "database.db",
        features=folder / "features" / "database.db",
        colours=np.load(folder / "features" / "colours.npy"),
        photos=load_photo_list(inputs["ingest.photos"]),
        photos_part=inputs["ingest.photos"],
        photos_dir=inputs.photos_dir,
        positions=[],
        cameras=json.loads(inputs["ingest.cameras"].read_text())["cameras"],
        scratch=folder / "scratch",
    )


def thinned(capture: MappingInput, keep: Callable[[int, int], bool], name: str) -> MappingInput:
    """Return the capture with only some of its verified pairs."""
    target = capture.scratch / f"{name}.db"
    with pycolmap.Database.open(capture.database) as source, pycolmap.Database.open(target) as database:
        for camera in source.read_all_cameras():
            database.write_camera(camera, use_camera_id=True)
        for rig in source.read_all_rigs():
            database.write_rig(rig, use_rig_id=True)
        for frame in source.read_all_frames():
            database.write_frame(frame, use_frame_id=True)
        for image in source.read_all_images():
            database.write_image(image, use_image_id=True)
            database.write_keypoints(image.image_id, source.read_keypoints(image.image_id))
        for number, geometry in zip(*source.read_two_view_geometries(), strict=True):
            i, j = pycolmap.pair_id_to_image_pair(number)
            if keep(i, j):
                database.write_two_view_geometry(i, j, geometry)
    return replace(capture, database=target)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> MappingInput:
    folder = tmp_path_factory.mktemp("room")
    names = [f"{number}.png" for number in range(COUNT)]
    return matched(corner_photos.write_capture(folder / "in", corner_photos.room(names)), folder)


@pytest.fixture(scope="module")
def whole(room: MappingInput) -> tuple[pycolmap.Reconstruction, ViewGraph]:
    model = map_incremental(room.database, room.scratch, MappingOptions(), lambda *_: None)[0]
    assert model.num_reg_images() == COUNT
    return model, read_verified(room.database)


def test_overlapping_pairs_are_proposed_and_verified(
    room: MappingInput, whole: tuple[pycolmap.Reconstruction, ViewGraph]
) -> None:
    model, verified = whole
    assert propose_pairs(model, verified, 10) == []  # all that overlap were matched
    missing = {(2, 3), (4, 6)}
    sparse = thinned(room, lambda i, j: (i, j) not in missing, "proposals")
    proposed = propose_pairs(model, read_verified(sparse.database), 10)
    avoided = propose_pairs(model, read_verified(sparse.database), 10, {proposed[0]})
    assert proposed[0] not in avoided and set(proposed[1:]) <= set(avoided)
    assert set(proposed) == missing
    grown = read_verified(match_more(sparse, sparse.database, proposed, 0, corner_photos.Recorder()))
    assert grown.matches.keys() == verified.matches.keys()
    for pair, rows in verified.matches.items():
        np.testing.assert_array_equal(grown.matches[pair], rows)


def found_without(
    capture: MappingInput, whole: tuple[pycolmap.Reconstruction, ViewGraph], left: set[int], **more: object
) -> MappingResult:
    """A model that lacks photos, on the view graph of a capture."""
    verified = read_verified(capture.database)
    model = without(whole[0], left)
    assert model.num_reg_images() == COUNT - len(left)
    return MappingResult(model, (), capture.database, verified, capture.colours, **more)


def centre_errors(model: pycolmap.Reconstruction) -> dict[int, float]:
    """Distance of each camera from the truth after a similarity fit, over the size of the scene."""
    poses = corner_photos.poses(COUNT)
    true = {number: -pose[:3, :3].T @ pose[:3, 3] for number, pose in enumerate(poses, start=1)}
    placed = sorted(model.reg_image_ids())
    fit = pycolmap.estimate_sim3d(
        np.array([model.images[number].projection_center() for number in placed]), np.array([true[n] for n in placed])
    )
    size = np.linalg.norm(np.ptp(np.array(list(true.values())), axis=0))
    return {n: float(np.linalg.norm(fit * model.images[n].projection_center() - true[n]) / size) for n in placed}


def assert_all_right(found: MappingResult, rung: str) -> None:
    assert found.model.num_reg_images() == COUNT
    assert max(centre_errors(found.model).values()) < 0.01  # small photos, focal length not known
    assert [row["rung"] for row in found.rungs if row["placed"]] == [rung]
    for number, places in found.verified.keypoints.items():
        points = found.model.images[number].points2D
        assert len(points) == len(places)
        np.testing.assert_allclose([point.xy for point in points], places)
    assert len(found.colours) == sum(len(places) for places in found.verified.keypoints.values())


def test_photos_are_registered_to_the_finished_model(
    room: MappingInput, whole: tuple[pycolmap.Reconstruction, ViewGraph]
) -> None:
    found = run_ladder(room, found_without(room, whole, {1, 5}), SparseConfig(), corner_photos.Recorder())
    assert_all_right(found, "registration")
    assert found.model.num_points3D() > 0.9 * whole[0].num_points3D()


def test_photos_that_a_model_has_without_a_pose_are_registered(
    room: MappingInput, whole: tuple[pycolmap.Reconstruction, ViewGraph]
) -> None:
    """As COLMAP's global mapper leaves them."""
    model = pycolmap.Reconstruction(whole[0])
    for number in (1, 5):
        pycolmap.ObservationManager(model).deregister_frame(model.images[number].frame_id)
    assert model.exists_image(5) and model.num_reg_images() == COUNT - 2
    found = replace(found_without(room, whole, {1, 5}), model=model)
    assert_all_right(run_ladder(room, found, SparseConfig(), corner_photos.Recorder()), "registration")


def test_a_photo_without_pairs_gets_new_ones(
    room: MappingInput, whole: tuple[pycolmap.Reconstruction, ViewGraph]
) -> None:
    capture = thinned(room, lambda i, j: 8 not in (i, j), "no pairs")
    found = run_ladder(capture, found_without(capture, whole, {8}), SparseConfig(), corner_photos.Recorder())
    assert_all_right(found, "more pairs")
    assert any(8 in pair for pair in found.verified.matches)


def test_weak_keypoints_are_made_stronger(room: MappingInput, whole: tuple[pycolmap.Reconstruction, ViewGraph]) -> None:
    weak = thinned(room, lambda i, j: 8 not in (i, j), "weak")
    with pycolmap.Database.open(weak.database) as database:
        few = database.read_keypoints(8)[:40]
        lost = database.num_keypoints_for_image(8) - len(few)
        database.update_keypoints(8, few)
    every = frozenset((i, j) for i in range(1, COUNT + 1) for j in range(i + 1, COUNT + 1))
    capture = replace(weak, tried=every, colours=room.colours[:-lost])
    before = found_without(capture, whole, {8})
    found = run_ladder(capture, before, SparseConfig(), corner_photos.Recorder())
    assert_all_right(found, "stronger keypoints")
    assert found.rungs[-1]["keypoints_added"] == len(found.colours) - len(before.colours) > 0


def test_sub_models_are_joined_by_common_points(
    room: MappingInput, whole: tuple[pycolmap.Reconstruction, ViewGraph]
) -> None:
    model, verified = whole
    first, second = without(model, {5, 6, 7, 8}), without(model, {1, 2, 3})
    turn = pycolmap.Rotation3d(np.array([0.5, -0.5, 0.5, 0.5]))
    second.transform(pycolmap.Sim3d(2.5, turn, np.array([3.0, -7.0, 11.0])))
    united = join(first, second, verified, seed=0)
    assert united is not None
    assert united.num_reg_images() == COUNT
    assert max(centre_errors(united).values()) < 0.01
    apart = without(model, {1, 2, 3, 4})
    apart.transform(pycolmap.Sim3d(0.4, turn, np.array([3.0, -7.0, 11.0])))
    found = run_ladder(
        room,
        MappingResult(first, (apart,), room.database, verified, room.colours),
        SparseConfig(),
        corner_photos.Recorder(),
    )
    assert_all_right(found, "registration")
    assert found.others == ()


def test_models_that_share_nothing_but_chance_stay_apart(
    whole: tuple[pycolmap.Reconstruction, ViewGraph],
) -> None:
    model, verified = whole
    first, second = without(model, {5, 6, 7, 8}), without(model, {1, 2, 3, 4})
    generator = np.random.default_rng(0)
    shuffled = {
        (i, j): np.column_stack([rows[:, 0], generator.permutation(rows[:, 1])]) if i <= 4 < j else rows
        for (i, j), rows in verified.matches.items()
    }
    assert join(first, second, replace(verified, matches=shuffled), seed=0) is None


def test_a_photo_of_another_place_is_not_placed(
    room: MappingInput, whole: tuple[pycolmap.Reconstruction, ViewGraph]
) -> None:
    """Nothing in it matches except a poster that also hangs in the room."""
    before = found_without(room, whole, {8})
    generator = np.random.default_rng(0)
    count = len(before.verified.keypoints[8])
    matches = {pair: rows for pair, rows in before.verified.matches.items() if 8 not in pair}
    for other in (4, 5, 6):
        theirs = generator.permutation(len(before.verified.keypoints[other]))[:60]
        matches[other, 8] = np.column_stack([theirs, generator.permutation(count)[:60]]).astype(np.uint32)
    poster = [row for row in before.verified.matches[7, 8] if before.verified.keypoints[7][row[0]][0] < 160.0][:25]
    assert len(poster) == 25
    matches[7, 8] = np.array(poster, np.uint32)
    wrong = replace(before, verified=replace(before.verified, matches=matches))
    work = LadderContext(room, MappingOptions(), corner_photos.Recorder())
    assert register_until_stable(work, wrong).model.num_reg_images() == COUNT - 1


def test_if_all_photos_are_registered_nothing_changes(
    room: MappingInput, whole: tuple[pycolmap.Reconstruction, ViewGraph]
) -> None:
    complete = MappingResult(whole[0], (), room.database, whole[1], room.colours)
    assert run_ladder(room, complete, SparseConfig(), corner_photos.Recorder()) is complete
    lacking = found_without(room, whole, {2})
    assert run_ladder(room, lacking, SparseConfig(ladder=False), corner_photos.Recorder()) is lacking
