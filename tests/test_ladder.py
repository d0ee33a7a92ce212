"""The ladder on a room whose cameras are known: photos left on purpose come in where they were, or not at all."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.scene.photos import load_photo_list
from splatpipe.pipeline.sfm.capture import Capture
from splatpipe.pipeline.sfm.ladder_pairs import match_more, propose_pairs
from splatpipe.pipeline.sfm.mapping import MappingOptions, map_incremental
from splatpipe.pipeline.sfm.options import FeaturesConfig, MatchesConfig
from splatpipe.pipeline.sfm.verified import Verified, read_verified
from splatpipe.stages import features, matches

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
import corner_photos

COUNT = 8
FAST = FeaturesConfig(extractor="opencv-sift", max_features=1500)


def matched(inputs: Inputs, folder: Path) -> Capture:
    """What `features` and `matches` leave of a capture."""
    recorder = corner_photos.Recorder()
    for stage in ("features", "matches", "scratch"):
        (folder / stage).mkdir(parents=True)
    features.run(FAST, inputs, folder / "features", recorder)
    inputs = corner_photos.with_parts(inputs, features__database=folder / "features" / "database.db")
    matches.run(MatchesConfig(), inputs, folder / "matches", recorder)
    return Capture(
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


def thinned(capture: Capture, keep: Callable[[int, int], bool], name: str) -> Capture:
    """The same capture with only some of its verified pairs."""
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
def room(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("room")
    names = [f"{number}.png" for number in range(COUNT)]
    return matched(corner_photos.write_capture(folder / "in", corner_photos.room(names)), folder)


@pytest.fixture(scope="module")
def whole(room: Capture) -> tuple[pycolmap.Reconstruction, Verified]:
    model = map_incremental(room.database, room.scratch, MappingOptions(), lambda *_: None)[0]
    assert model.num_reg_images() == COUNT
    return model, read_verified(room.database)


def test_pairs_that_show_the_same_thing_are_proposed_and_hold(
    room: Capture, whole: tuple[pycolmap.Reconstruction, Verified]
) -> None:
    model, verified = whole
    assert propose_pairs(model, verified, 10) == []  # all that overlap were matched
    missing = {(2, 3), (4, 6)}
    sparse = thinned(room, lambda i, j: (i, j) not in missing, "proposals")
    proposed = propose_pairs(model, read_verified(sparse.database), 10)
    assert set(proposed) == missing
    grown = read_verified(match_more(sparse, sparse.database, proposed, 0, corner_photos.Recorder()))
    assert grown.matches.keys() == verified.matches.keys()
    for pair, rows in verified.matches.items():
        np.testing.assert_array_equal(grown.matches[pair], rows)
