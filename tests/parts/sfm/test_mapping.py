"""Mapping from the strongest keypoints, completed by all: accurate cameras, bit-identical on repetition."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from flight_scene import FOCAL_PX, GSD_M, SyntheticFlight, make_flight, write_database
from mapped_apart import centre_errors, centres, oracle

from splatpipe.pipeline.sfm.mapping import completion, placing
from splatpipe.pipeline.sfm.mapping.completion import complete
from splatpipe.pipeline.sfm.mapping.mapping import MappingOptions, incremental_options, map_global, map_incremental
from splatpipe.pipeline.sfm.matching.reduction import PAIR_FLOOR, best_keypoints, write_reduced
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph, read_verified

PHOTOS, SEED, OBSERVATIONS = 48, 1, 500


@pytest.fixture(scope="module")
def flight() -> SyntheticFlight:
    return make_flight(PHOTOS, SEED, OBSERVATIONS)


@pytest.fixture(scope="module")
def database(flight: SyntheticFlight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "database.db"
    write_database(flight, path, SEED)
    return path


@pytest.fixture(scope="module")
def mapped(database: Path, tmp_path_factory: pytest.TempPathFactory) -> list[pycolmap.Reconstruction]:
    return map_incremental(database, tmp_path_factory.mktemp("scratch"), MappingOptions(), lambda *_: None)


def error_gsd(model: pycolmap.Reconstruction, flight: SyntheticFlight) -> float:
    numbers, found = centres(model)
    errors, _ = centre_errors(found, flight.centres_m[np.array(numbers) - 1])
    return float(np.sqrt(np.mean(errors**2))) / GSD_M


def test_cameras_are_accurate_despite_wrong_matches_and_focal_length(
    mapped: list[pycolmap.Reconstruction], flight: SyntheticFlight
) -> None:
    """Although a fifth of the matches is wrong and the focal length starts 3 % off."""
    assert [model.num_reg_images() for model in mapped] == [PHOTOS]
    camera = mapped[0].cameras[1]
    assert camera.mean_focal_length() == pytest.approx(FOCAL_PX, rel=0.005)
    # Without wrong matches, starting at the truth, noise leaves some; wrong ones that only two views see add to it.
    assert error_gsd(mapped[0], flight) < 2.0 * error_gsd(oracle(flight), flight)


def test_all_true_tracks_are_in_the_final_model(mapped: list[pycolmap.Reconstruction], flight: SyntheticFlight) -> None:
    model = mapped[0]
    starts = np.searchsorted(flight.photo, np.arange(PHOTOS))
    votes, observed = [], 0
    for point in model.points3D.values():
        rows = [int(starts[each.image_id - 1]) + each.point2D_idx for each in point.track.elements]
        observed += len(rows)
        numbers, counts = np.unique(flight.point[rows], return_counts=True)
        votes.append((int(numbers[counts.argmax()]), int(counts.max()), len(rows)))
    right = sum(vote for _, vote, _ in votes)
    assert right > 0.97 * observed
    lengths = np.bincount(flight.point, minlength=len(flight.points_m))
    long = set(np.flatnonzero(lengths >= 4).tolist())
    assert len(long & {number for number, _, _ in votes}) > 0.97 * len(long)
    assert observed > 0.9 * lengths[lengths >= 3].sum()


def test_mapping_starts_from_a_subset_of_the_matches(database: Path, tmp_path: Path) -> None:
    chosen = best_keypoints(read_verified(database), 100)
    kept, total = write_reduced(database, tmp_path / "best.db", chosen)
    whole, part = read_verified(database), read_verified(tmp_path / "best.db")
    assert kept == sum(len(rows) for rows in part.matches.values()) < 0.7 * total
    assert set(part.matches) == set(whole.matches)
    for pair, rows in whole.matches.items():
        assert len(part.matches[pair]) >= min(PAIR_FLOOR, len(rows))
        assert set(map(tuple, part.matches[pair].tolist())) <= set(map(tuple, rows.tolist()))
    for number, places in whole.keypoints.items():
        assert (part.keypoints[number] == places).all()  # under the same numbers


def test_the_best_keypoints_are_spread_and_bring_their_partners() -> None:
    side = np.arange(40) + 0.5
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2).astype(np.float32)
    matches = {(1, 2): np.stack([np.arange(1600), np.arange(1600)[::-1]], axis=1).astype(np.uint32)}
    matches[1, 3] = matches[1, 2][700:720]  # these are verified twice: in the middle, and the first in their cells
    chosen = best_keypoints(ViewGraph({}, {}, {}, {1: places, 2: places, 3: places}, matches), 128)
    cells = np.bincount((places[chosen[1]] // 5).astype(int) @ [1, 8], minlength=64)
    assert cells.min() == 2
    assert chosen[1][700:720].all()
    assert chosen[1].sum() < 200  # out of 1600; more than requested, since photo 2 has its own cells
    with_partner = chosen[2][::-1] >= chosen[1]
    with_partner[700:720] = True  # photo 3 brought some of these in
    assert with_partner.all()
    assert set(np.flatnonzero(chosen[3])) == set(matches[1, 3][:, 1].tolist())


def test_photos_without_matches_have_none_chosen() -> None:
    places = np.zeros((3, 2), np.float32)
    chosen = best_keypoints(ViewGraph({}, {}, {}, {1: places, 2: places[:0]}, {}), 10)
    assert chosen[1].tolist() == [False, False, False] and len(chosen[2]) == 0


@pytest.mark.parametrize("mapper", [map_incremental, map_global])
def test_the_same_seed_gives_the_same_bits(mapper: object, tmp_path: Path) -> None:
    small = make_flight(10, 2, 500)
    write_database(small, tmp_path / "database.db", 2)
    found = []
    for name in ("once", "again"):
        (tmp_path / name).mkdir()
        models = mapper(tmp_path / "database.db", tmp_path, MappingOptions(seed=3), lambda *_: None)  # type: ignore[operator]
        models[0].write(tmp_path / name)
        found.append([(tmp_path / name / f"{part}.bin").read_bytes() for part in ("cameras", "images", "points3D")])
    assert found[0] == found[1]
    assert not list(tmp_path.glob("mapping-*"))


def test_progress_is_reported_and_an_interruption_ends_it(database: Path, tmp_path: Path) -> None:
    reports: list[tuple[int, int, str, str]] = []

    def tell(*report: Any) -> None:
        reports.append(report)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        map_incremental(database, tmp_path, MappingOptions(), tell)
    assert reports[0][1] == PHOTOS


def test_the_adjustment_reports_photos_and_rounds(database: Path, mapped: list[pycolmap.Reconstruction]) -> None:
    reports: list[tuple[int, int, str, str]] = []
    model, stop = pycolmap.Reconstruction(mapped[0]), pycolmap.CancellationToken()
    options = incremental_options(MappingOptions())
    complete(model, database, options, stop, on_progress=lambda *report: reports.append(report))
    photos = [report for report in reports if report[3] == "photos"]
    rounds = [report for report in reports if report[3] == "rounds"]
    assert [done for done, *_ in photos] == list(range(PHOTOS)) and {of for _, of, *_ in photos} == {PHOTOS}
    assert [done for done, *_ in rounds] == list(range(len(rounds))) and 2 <= len(rounds) <= rounds[0][1]


def test_many_photos_are_placed_in_legs_with_an_adjustment_after_each(
    database: Path, flight: SyntheticFlight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached: list[int] = []

    def settle(model: pycolmap.Reconstruction, *rest: Any) -> None:
        reached.append(model.num_reg_images())
        completion.settle(model, *rest)

    monkeypatch.setattr(placing, "MAX_FACTORIZED", 20)
    monkeypatch.setattr(placing, "settle", settle)
    (model,) = map_incremental(database, tmp_path, MappingOptions(), lambda *_: None)
    assert reached == [20, 30, 45, PHOTOS] and model.num_reg_images() == PHOTOS
    assert error_gsd(model, flight) < 2.0 * error_gsd(oracle(flight), flight)


@pytest.mark.parametrize(("times", "placed"), [(1, PHOTOS), (99, PHOTOS - 1)])
def test_photos_that_were_dropped_are_tried_again_as_long_as_that_helps(
    times: int, placed: int, database: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = 0

    def settle(model: pycolmap.Reconstruction, *_: Any) -> None:
        nonlocal calls
        calls += 1
        if calls <= times:
            model.deregister_frame(model.image(max(model.reg_image_ids())).frame_id)

    monkeypatch.setattr(placing, "settle", settle)
    placement = placing.Placement(incremental_options(MappingOptions()), pycolmap.CancellationToken(), lambda *_: None)
    (model,) = placement.run(database, PHOTOS, tmp_path)
    assert model.num_reg_images() == placed and calls == 2


def test_a_second_model_is_found_after_a_leg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two flights that no match ties: the first is placed in two legs, then the second from its own first pair."""
    flight = make_flight(24, 3, 500)
    write_database(flight, tmp_path / "whole.db", 3)
    verified = read_verified(tmp_path / "whole.db")
    apart = {number: np.full(len(places), True) for number, places in verified.keypoints.items()}
    write_reduced(tmp_path / "whole.db", tmp_path / "apart.db", apart)
    with pycolmap.Database.open(tmp_path / "apart.db") as opened:
        for first, second in verified.matches:
            if (first <= 12) != (second <= 12):
                opened.delete_two_view_geometry(first, second)
    monkeypatch.setattr(placing, "MAX_FACTORIZED", 8)
    models = map_incremental(tmp_path / "apart.db", tmp_path, MappingOptions(), lambda *_: None)
    photos = [set(model.reg_image_ids()) for model in models]
    assert sorted(map(sorted, photos)) == [list(range(1, 13)), list(range(13, 25))]


def test_placing_that_is_cancelled_between_two_legs_ends(database: Path, tmp_path: Path) -> None:
    stop = pycolmap.CancellationToken()
    placement = placing.Placement(incremental_options(MappingOptions()), stop, lambda *_: placement.cancel())
    with pytest.raises(InterruptedError):
        placement.run(database, PHOTOS, tmp_path)
    assert stop.is_cancelled
