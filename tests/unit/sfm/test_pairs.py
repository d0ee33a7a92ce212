"""Selection of photo pairs: by position, order or similarity, and always a connected graph."""

import json
import math

import numpy as np
import pytest

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.sfm.pairing.layout import make_layout, viewing_direction
from splatpipe.pipeline.sfm.pairing.pairs import (
    Costs,
    Layout,
    choose_pairing,
    components,
    connect,
    has_informative_positions,
    select_pairs,
    sequences,
)
from splatpipe.pipeline.sfm.pairing.retrieval import codebook, look_alike_costs

UNKNOWN = float("nan")


def layout(
    positions: np.ndarray | None = None,
    directions: np.ndarray | None = None,
    times: np.ndarray | None = None,
    names: list[str] | None = None,
    sigma_m: float = 3.0,
) -> Layout:
    given = next(each for each in (names, positions, times) if each is not None)
    count = len(given)
    return Layout(
        names if names is not None else [f"DJI_{number:04d}.JPG" for number in range(count)],
        np.full(count, UNKNOWN) if times is None else times.astype(np.float64),
        np.full((count, 3), UNKNOWN) if positions is None else positions.astype(np.float64),
        np.full(count, UNKNOWN if positions is None else sigma_m),
        np.full((count, 3), UNKNOWN) if directions is None else directions.astype(np.float64),
    )


def never() -> Costs:
    raise AssertionError("the photos' content is not needed")


def strips(rows: int, columns: int, step_m: float = 10.0) -> np.ndarray:
    return np.array([[step_m * x, step_m * y, 40.0] for y in range(rows) for x in range(columns)])


def test_few_photos_are_matched_exhaustively() -> None:
    photos = layout(strips(2, 3))
    assert choose_pairing(photos, 6) == "exhaustive"
    assert len(select_pairs(photos, "exhaustive", 3, never)) == 15


def test_positions_give_the_neighbours_of_a_grid() -> None:
    photos = layout(strips(8, 10))
    assert choose_pairing(photos, 30) == "spatial"
    pairs = select_pairs(photos, "spatial", 8, never)
    inner = 3 * 10 + 4
    partners = {j if i == inner else i for i, j in pairs if inner in (i, j)}
    assert partners == {inner + dx + 10 * dy for dx in (-1, 0, 1) for dy in (-1, 0, 1)} - {inner}
    assert pairs == sorted(set(pairs))
    assert all(i < j for i, j in pairs)


def test_views_of_opposite_walls_are_no_neighbours() -> None:
    """A ring of cameras that look inwards, with another that looks outwards from the same places."""
    angles = np.radians(np.arange(0, 360, 10))
    ring = np.column_stack([30 * np.cos(angles), 30 * np.sin(angles), np.full(36, 10.0)])
    inwards = -ring * [1, 1, 0] / 30
    photos = layout(np.concatenate([ring, ring]), np.concatenate([inwards, -inwards]))
    # Neighbours are 10° apart on the ring, so 6 of them look at most 30° away.
    for i, j in select_pairs(photos, "spatial", 6, never):
        if (i < 36) == (j < 36):
            assert float(photos.directions[i] @ photos.directions[j]) > math.cos(math.radians(31))
    across = [pair for pair in select_pairs(photos, "spatial", 6, never) if (pair[0] < 36) != (pair[1] < 36)]
    assert len(across) <= 2  # only those that connect the graph


def test_distant_groups_are_joined_by_the_nearest_photos() -> None:
    offsets = np.array([[1000.0, 0.0, 0.0], [0.0, 5000.0, 0.0]])
    positions = np.concatenate([strips(3, 4), strips(3, 4) + offsets[0], strips(1, 2) + offsets[1]])
    pairs = select_pairs(layout(positions), "spatial", 2, never)
    assert components(pairs, len(positions)).max() == 0
    assert min(j for i, j in pairs if i < 12 <= j) == 12


def test_positions_no_wider_than_their_noise_are_not_used() -> None:
    photos = layout(strips(5, 8, step_m=1.0), sigma_m=5.0)
    assert not has_informative_positions(photos)
    assert choose_pairing(photos, 30) == "retrieval"
    assert has_informative_positions(layout(strips(5, 8, step_m=1.0), sigma_m=0.02))


def test_identical_positions_are_not_used() -> None:
    positions = np.repeat([[0.0, 0.0, 10.0], [500.0, 0, 10.0]], 20, axis=0)
    assert not has_informative_positions(layout(positions))


def test_photos_without_position_are_paired_by_similarity() -> None:
    positions = strips(5, 8)
    positions[7] = UNKNOWN
    alike = np.full((40, 40), 9.0)
    alike[7, [20, 31]] = [1.0, 2.0]
    photos = layout(positions)
    assert choose_pairing(photos, 30) == "spatial"
    pairs = select_pairs(photos, "spatial", 2, lambda: lambda i: alike[i])
    assert {pair for pair in pairs if 7 in pair} == {(7, 20), (7, 31)}


def test_spatial_without_positions_is_refused() -> None:
    with pytest.raises(SplatpipeError, match="positions"):
        select_pairs(layout(names=["a", "b", "c"]), "spatial", 2, never)


def test_a_sequence_needs_names_and_times_that_agree() -> None:
    names = [f"IMG_{number}.JPG" for number in range(1, 41)]  # 10 sorts before 2 by characters
    times = np.arange(40.0)
    ordered = sorted(range(40), key=lambda i: names[i])
    by_name = layout(names=[names[i] for i in ordered], times=times[ordered])
    assert choose_pairing(by_name, 30) == "sequential"
    assert [by_name.names[i] for i in sequences(by_name)[0]] == names
    assert sequences(layout(names=names, times=times[::-1])) == []
    assert sequences(layout(names=names, times=np.zeros(40))) == []
    assert sequences(layout(names=names)) == []


def test_a_sequence_matches_neighbours_and_closes_loops() -> None:
    photos = layout(times=np.arange(40.0))
    alike = np.full((40, 40), 5.0)
    alike[0, 39] = alike[39, 0] = 0.0
    pairs = select_pairs(photos, "sequential", 8, lambda: lambda i: alike[i])
    assert {(i, i + step) for i in range(36) for step in range(1, 5)} <= set(pairs)
    assert (0, 39) in pairs
    assert len(pairs) < 40 * 8


def test_folders_are_sequences_of_their_own() -> None:
    names = [f"{folder}/{number:02d}.jpg" for folder in ("a", "b") for number in range(10)]
    times = np.concatenate([np.arange(10.0) + 100, np.arange(10.0)])
    found = sequences(layout(names=names, times=times))
    assert found == [list(range(10)), list(range(10, 20))]


def test_connecting_works_without_any_information() -> None:
    pairs = connect({(0, 1)}, 4, lambda _: np.full(4, np.inf))
    assert components(pairs, 4).max() == 0
    assert len(pairs) == 3


def scenes(seed: int) -> list[np.ndarray]:
    """Descriptors of 4 photos each of 3 scenes; photos of a scene share most of theirs."""
    rng = np.random.default_rng(seed)
    photos = []
    for _ in range(3):
        common = rng.integers(0, 120, (600, 128))
        for _ in range(4):
            chosen = common[rng.permutation(600)[:400]] + rng.integers(-4, 5, (400, 128))
            photos.append(np.clip(np.concatenate([chosen, rng.integers(0, 120, (100, 128))]), 0, 255).astype(np.uint8))
    return photos


def test_photos_of_one_scene_are_similar() -> None:
    costs = look_alike_costs(scenes(0), seed=0)
    for i in range(12):
        row = costs(i).copy()
        row[i] = np.inf
        assert {int(j) // 4 for j in np.argsort(row)[:3]} == {i // 4}


def test_retrieval_survives_photos_without_descriptors() -> None:
    photos = [*scenes(1), np.zeros((0, 128), np.uint8)]
    pairs = select_pairs(layout(names=[str(i) for i in range(13)]), "retrieval", 3, lambda: look_alike_costs(photos, 0))
    assert components(pairs, 13).max() == 0
    assert len(codebook([np.zeros((0, 128), np.uint8)], 0)) == 1


def test_the_seed_chooses_the_codebook() -> None:
    assert (codebook(scenes(0), 3) == codebook(scenes(0), 3)).all()
    assert (codebook(scenes(0), 3) != codebook(scenes(0), 4)).any()


def test_metres_and_directions_come_from_positions() -> None:
    photos = [Photo(f"{i}.jpg", "", 10, 10, 0, time="2024-05-01T10:00:0" + str(i)) for i in range(4)]
    entry = {"altitude_m": 50.0, "relative_altitude_m": None, "sigma_horizontal_m": 3.0, "yaw_deg": 90.0}
    positions = [
        {**entry, "name": "0.jpg", "latitude": -17.0, "longitude": 179.9999, "pitch_deg": -90.0},
        {**entry, "name": "2.jpg", "latitude": -17.0, "longitude": -179.9999, "pitch_deg": 0.0},
        {**entry, "name": "gone.jpg", "latitude": 0.0, "longitude": 0.0, "pitch_deg": 0.0},
    ]
    made = make_layout(photos, json.loads(json.dumps(positions)))
    east = made.positions_m[2] - made.positions_m[0]
    assert east[0] == pytest.approx(0.0002 * 111_195 * math.cos(math.radians(17)), rel=1e-3)  # across the date line
    assert east[1:] == pytest.approx([0.0, 0.0])
    assert made.located().tolist() == [True, False, True, False]
    assert made.directions[0] == pytest.approx([0, 0, -1], abs=1e-12)
    assert made.directions[2] == pytest.approx([1, 0, 0], abs=1e-12)
    assert np.diff(made.times).tolist() == [1, 1, 1]
    assert viewing_direction(0.0, -45.0) == pytest.approx([0, math.sqrt(0.5), -math.sqrt(0.5)])
