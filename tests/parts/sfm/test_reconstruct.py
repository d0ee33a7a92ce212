"""Two mappers, one judge: auto takes the better answer, and new pairs prove a bend that the old ones permit."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import corner_photos
import numpy as np
import pycolmap
import pytest
from view_graph import Ring, add_points, make_ring, model_of, moved, turn_up, write_database, write_descriptors

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.photo_list import PhotoList
from splatpipe.pipeline.sfm.capture import MappingInput, MappingResult
from splatpipe.pipeline.sfm.judging.judging import judge
from splatpipe.pipeline.sfm.mapping.mapping import MappingOptions
from splatpipe.pipeline.sfm.model.view_graph import read_verified
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.reconstruct import MappingAttempt, Reconstructor, reconstruct
from splatpipe.pipeline.sfm.recovery.probing import alike_pairs, predicted_pairs, probe


def capture_of(ring: Ring, folder: Path, reach: int = 99) -> MappingInput:
    """Matches of photos up to ``reach`` places apart, the ring left open; descriptors of all."""
    folder.mkdir()
    write_database(ring.verified, folder / "matches.db", lambda i, j: j - i <= reach)
    write_database(ring.verified, folder / "features.db", lambda i, j: False)
    write_descriptors(ring, folder / "features.db")
    colours = np.zeros((sum(map(len, ring.rows.values())), 3), np.uint8)
    camera = {"has_prior": True, "focal_source": "sensor-table"}
    scratch = folder / "scratch"
    scratch.mkdir()
    databases = folder / "matches.db", folder / "features.db"
    return MappingInput(*databases, colours, PhotoList(()), folder, folder, [], [camera], scratch)


def far_off(ring: Ring, model: pycolmap.Reconstruction) -> float:
    """Root mean square distance of the cameras from where they were, after a similarity, over the ring's radius."""
    images = [model.images[number] for number in model.reg_image_ids()]
    true = [ring.centre(image.image_id) for image in images]
    names = [image.name for image in images]
    fit = pycolmap.align_reconstruction_to_locations(model, names, true, 3, pycolmap.RANSACOptions())
    off = [fit * image.projection_center() - place for image, place in zip(images, true, strict=True)]
    return float(np.sqrt(np.mean(np.sum(np.square(off), axis=1)))) / 20.0


def answers(found: MappingResult) -> list[tuple[object, ...]]:
    """All bits of a result except the time that it took."""
    rows = [tuple((key, str(row[key])) for key in sorted(row) if key != "cpu_s") for row in found.tried]
    poses = [found.model.images[number].cam_from_world().matrix().tobytes() for number in found.model.reg_image_ids()]
    return [*rows, tuple(poses), tuple(found.model.cameras[1].params)]


@pytest.fixture(scope="module")
def weak(tmp_path_factory: pytest.TempPathFactory) -> tuple[Ring, MappingInput]:
    """Forty matches per pair: too few for incremental mapping to begin with, enough for all photos at once."""
    ring = make_ring(most=45)
    return ring, capture_of(ring, tmp_path_factory.mktemp("weak") / "capture")


def test_auto_uses_the_other_mapper_if_the_first_one_fails(weak: tuple[Ring, MappingInput]) -> None:
    ring, capture = weak
    found = reconstruct(capture, SparseConfig(), corner_photos.Recorder())
    assert found.model.num_reg_images() == 24
    assert far_off(ring, found.model) < 0.005
    first, second = found.tried[0], next(row for row in found.tried if row["chosen"])
    assert (first["mapper"], second["mapper"]) == ("incremental", "global")
    assert "doubtful" in first["why"] and first["placed"] < 12


def test_the_other_mappers_focal_length_is_held_as_well_if_the_photos_do_not_determine_it(
    weak: tuple[Ring, MappingInput], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatpipe.pipeline.sfm.lenses.focal.UNOBSERVED", 1e-12)
    monkeypatch.setattr("splatpipe.pipeline.sfm.reconstruct.MAX_UNOBSERVED_DEVIATION", 1e-6)
    found = reconstruct(weak[1], SparseConfig(), corner_photos.Recorder())
    assert [(row["how"], row["chosen"]) for row in found.tried] == [
        ("incremental", False),
        ("global", False),
        ("global, focal length held", True),
    ]
    assert far_off(weak[0], found.model) < 0.005


def test_a_reliable_focal_length_is_held_only_if_it_explains_the_matches_as_well(tmp_path: Path) -> None:
    ring = make_ring(count=12, points=500, most=300)
    capture = capture_of(ring, tmp_path / "capture")
    with pycolmap.Database.open(capture.database) as database:
        [lens] = database.read_all_cameras()
        true = lens.focal_length
        lens.params = np.array([1.15 * true, *lens.params[1:]])
        database.update_camera(lens)
    found = reconstruct(capture, SparseConfig(), corner_photos.Recorder())
    assert [(row["how"], row["chosen"]) for row in found.tried] == [
        ("incremental", True),
        ("incremental, focal length held", False),
    ]
    assert abs(found.model.cameras[1].focal_length - true) < 0.01 * true


def test_photos_from_one_spot_are_not_placed_without_points(tmp_path: Path) -> None:
    ring = make_ring(count=16, reach=3, points=3000, most=120, one_spot=True)
    with pytest.raises(SplatpipeError, match="None of 16 photos could be placed") as refused:
        reconstruct(capture_of(ring, tmp_path / "spot"), SparseConfig(mapper="global"), corner_photos.Recorder())
    assert "from different positions" in refused.value.hint


def test_a_requested_mapper_is_not_replaced(weak: tuple[Ring, MappingInput]) -> None:
    found = reconstruct(weak[1], SparseConfig(mapper="global"), corner_photos.Recorder())
    assert [row["how"] for row in found.tried] == ["global"]
    with pytest.raises(SplatpipeError, match="of 24 photos could be placed"):
        reconstruct(weak[1], SparseConfig(mapper="incremental"), corner_photos.Recorder())


def test_the_number_of_threads_changes_no_bit_of_the_result(weak: tuple[Ring, MappingInput]) -> None:
    one, two = (
        answers(reconstruct(replace(weak[1], threads=threads), SparseConfig(), corner_photos.Recorder()))
        for threads in (1, 2)
    )
    assert one == two


def test_nothing_is_mapped_twice_if_nothing_is_doubtful(tmp_path: Path) -> None:
    ring = make_ring(count=12, points=500, most=300)
    found = reconstruct(capture_of(ring, tmp_path / "capture"), SparseConfig(), corner_photos.Recorder())
    assert [(row["how"], row["chosen"]) for row in found.tried] == [("incremental", True)]
    assert far_off(ring, found.model) < 0.002


def test_new_pairs_prove_that_a_model_is_bent(tmp_path: Path) -> None:
    """A chain whose joint no pair spans: nothing contradicts the bend before new pairs are matched."""
    ring = make_ring(reach=3)
    capture = capture_of(ring, tmp_path / "capture", reach=1)
    verified = read_verified(capture.database)
    turn, about = turn_up(4.0), ring.centre(13)
    right, bent = model_of(ring), model_of(ring, moved(ring, range(14, 25), about, turn, 1.05))
    still = np.eye(3, 4)
    shifted = np.column_stack([1.05 * turn, about - 1.05 * turn @ about])
    for photos, world in ((range(1, 14), still), (range(14, 25), shifted)):
        add_points(right, ring, photos, still)
        add_points(bent, ring, photos, world)
    graph = capture.database, verified
    alike = alike_pairs(capture, graph, 0)
    assert alike and not set(alike) & set(verified.matches)
    everything = frozenset(combinations(sorted(verified.names), 2))
    assert alike_pairs(replace(capture, tried=everything), graph, 0) == []
    for pairs in ([predicted_pairs(capture, model, graph, many=True)[:48] for model in (right, bent)], [alike, alike]):
        notes = [
            probe(capture, model, graph, more, 0, corner_photos.Recorder())
            for model, more in zip((right, bent), pairs, strict=True)
        ]
        assert notes[0].held > 20 and notes[0].contradicting == 0
        assert notes[1].contradicting >= 3
        assert len(notes[1].verified.matches) == len(verified.matches) + notes[1].held
        levels = [judge(model, note.verified, [{}]).level for model, note in zip((right, bent), notes, strict=True)]
        assert levels == ["good", "bad"]


def test_a_thin_chain_gets_more_pairs_and_is_mapped_correctly(tmp_path: Path) -> None:
    ring = make_ring(points=600, most=400)
    thin = capture_of(ring, tmp_path / "capture", reach=1)
    found = reconstruct(thin, SparseConfig(), corner_photos.Recorder())
    assert found.model.num_reg_images() == 24
    assert len(found.verified.matches) >= 2 * len(read_verified(thin.database).matches)
    assert far_off(ring, found.model) < 0.001


def test_an_unknown_focal_length_is_no_reason_to_map_twice(tmp_path: Path) -> None:
    ring = make_ring(count=12, points=500, most=300, prior=False)
    found = reconstruct(capture_of(ring, tmp_path / "capture"), SparseConfig(), corner_photos.Recorder())
    assert [(row["how"], row["chosen"]) for row in found.tried] == [("incremental", True)]


def test_a_bent_model_is_adjusted_to_the_arrangement_that_explains_more(tmp_path: Path) -> None:
    ring = make_ring(points=600, most=400)
    capture = capture_of(ring, tmp_path / "capture")
    work = Reconstructor(capture, SparseConfig(), corner_photos.Recorder())
    bent = model_of(ring, moved(ring, range(13, 25), ring.centre(13), turn_up(8.0), 1.15))
    judgement = judge(bent, work.verified, capture.cameras)
    attempt = MappingAttempt("bent", "incremental", MappingOptions(), [bent], judgement, 0.0)
    assert judgement.level == "bad"
    found = work.adjust(attempt, "rearranged")
    assert found.judgement is not None and found.judgement.level == "good" and found.adjusted
    assert far_off(ring, found.models[0]) < 0.002 < far_off(ring, bent)
    assert work.adjust(found, "rearranged") is found
