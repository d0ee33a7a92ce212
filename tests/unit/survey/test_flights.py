"""Flights: separated by the photos' metadata, each with its own offset in the fit."""

import math
from pathlib import Path

import numpy as np
import pytest

from splatpipe.pipeline.geometry.alignment import Correspondences, SharedErrors, robust_similarity
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.survey.positions.flights import Stamp, assign_flights

from .test_georef import Survey, errors_m, georef, grid, survey

TRUTH = Similarity(6.5, rotation_from_vector(np.array([0.4, -0.7, 1.9])), np.array([12.0, -7.0, 3.0]))


def flight(start_s: float, takeoff_m: float, photos: int = 20, noise_m: float = 0.0, device: str = "A") -> list[Stamp]:
    rng = np.random.default_rng(int(start_s))
    return [Stamp((device,), start_s + 3.0 * i, takeoff_m + noise_m * rng.normal()) for i in range(photos)]


def test_photos_taken_in_one_go_are_one_flight() -> None:
    assert assign_flights(flight(0.0, 509.0)) == [0] * 20
    assert assign_flights(flight(0.0, 509.0, noise_m=4.0, photos=60)) == [0] * 60
    assert assign_flights([Stamp(("A",)), Stamp(("A",), 5.0), Stamp(("A",), math.nan, 3.0)]) == [0, 0, 0]
    assert assign_flights([]) == []


def test_a_pause_ends_a_flight_and_slow_photographers_do_not() -> None:
    assert assign_flights(flight(0.0, 509.0) + flight(600.0, 509.0)) == [0] * 20 + [1] * 20
    assert assign_flights([Stamp(("A",), 60.0 * i + (400.0 if i > 5 else 0.0)) for i in range(12)]) == [0] * 12


def test_another_aircraft_is_another_flight_at_the_same_time() -> None:
    pairs = zip(flight(0.0, 509.0), flight(1.0, 509.0, device="B"), strict=True)
    assert assign_flights([stamp for pair in pairs for stamp in pair]) == [0, 1] * 20


def test_a_step_of_the_takeoff_altitude_is_another_flight() -> None:
    assert assign_flights(flight(0.0, 509.0) + flight(62.0, 512.5)) == [0] * 20 + [1] * 20
    assert assign_flights(flight(0.0, 509.0, noise_m=0.2) + flight(62.0, 556.0, noise_m=0.2)) == [0] * 20 + [1] * 20
    assert assign_flights(flight(0.0, 509.0, noise_m=3.0) + flight(62.0, 511.0, noise_m=3.0)) == [0] * 40


def test_flights_are_distinguished_whatever_the_order_of_names() -> None:
    stamps = flight(0.0, 509.0) + flight(600.0, 509.0)
    order = np.random.default_rng(0).permutation(len(stamps))
    flights = assign_flights([stamps[index] for index in order])
    assert len({(number, index >= 20) for number, index in zip(flights, order, strict=True)}) == 2


@pytest.mark.parametrize("step_m", [0.0, 2.0, 47.0])
def test_shared_errors_are_estimated_and_the_shape_is_exact(step_m: float) -> None:
    """Without noise: two flights beside each other, one displaced as a whole."""
    source = np.random.default_rng(3).uniform(-3, 3, (40, 3))
    source[20:] += [9.0, 0.0, 0.0]
    group = np.repeat([0, 1], 20)
    target = TRUTH.apply(source) + np.outer(group, [0.3 * step_m, 0.0, step_m])
    shared = SharedErrors(group, np.array([[3.0, 3.0, 5.0], [3.0, 3.0, 1e4]]))
    fit = robust_similarity(Correspondences(source, target, np.full((40, 3), 1.0), shared), 10.0)
    assert fit.inliers.all()
    pull = 1e-9 + 1e-3 * step_m  # the sigmas of shared errors pull a step towards zero by their share
    np.testing.assert_allclose(fit.offsets[1] - fit.offsets[0], [0.3 * step_m, 0.0, step_m], atol=pull)
    np.testing.assert_allclose(fit.similarity.rotation, TRUTH.rotation, atol=pull / 50.0)
    assert fit.similarity.scale == pytest.approx(TRUTH.scale, rel=pull / 50.0)
    np.testing.assert_allclose(fit.residuals, 0.0, atol=pull)
    # Height: the first flight's, since nothing constrains the second. Across: the mean of two equally constrained ones.
    centre = fit.similarity.apply(source).mean(axis=0) - TRUTH.apply(source).mean(axis=0)
    assert centre[2] == pytest.approx(0.0, abs=1e-3 + 0.01 * step_m)
    assert centre[0] == pytest.approx(0.15 * step_m, abs=1e-3 + 0.01 * step_m)


def test_accuracy_with_shared_errors_agrees_with_repeated_fits() -> None:
    """The stated sigma of the scale against the scatter of 25 fits, shared errors drawn again in each."""
    rng = np.random.default_rng(8)
    source = rng.uniform(-3, 3, (30, 3))
    source[15:] += [6.0, 0.0, 0.0]
    group = np.repeat([0, 1], 15)
    shared = SharedErrors(group, np.full((2, 3), 2.0))
    scales, stated = [], []
    for _ in range(25):
        noise = rng.normal(size=(30, 3)) * 0.3 + (rng.normal(size=(2, 3)) * 2.0)[group]
        points = Correspondences(source, TRUTH.apply(source) + noise, np.full((30, 3), 0.3), shared)
        fit = robust_similarity(points, 10.0)
        scales.append(fit.similarity.scale / TRUTH.scale - 1.0)
        stated.append(fit.sigma_scale)
    assert np.std(scales) == pytest.approx(np.median(stated), rel=0.4)  # 25 fits determine a sigma to 14 %


def two_flights(step: tuple[float, float, float], sigma: tuple[float, float] = (0.3, 0.5)) -> Survey:
    scene = survey(grid(8, 6), sigma)
    moved = scene.centres.copy()
    moved[24:] += step
    other = survey(moved, sigma)
    for index, record in enumerate(scene.positions):
        record["flight"] = int(index >= 24)
        if index >= 24:
            keys = ("latitude", "longitude", "altitude_m")
            record |= {key: other.positions[index][key] for key in keys}
    return scene


def test_flights_in_two_vertical_datums_are_reported_and_aligned(tmp_path: Path) -> None:
    scene = two_flights((0.0, 0.0, 47.0))
    frame, summary, warnings = georef(scene, tmp_path)
    assert summary["positions_left_out"] == 0
    first, second = frame.residuals["flights"]
    assert second["offset_m"][2] - first["offset_m"][2] == pytest.approx(47.0, abs=0.5)
    assert second["apart"] == [False, True]
    assert any("flight 2 (24 photos" in warning and "above" in warning for warning in warnings)
    assert np.abs(errors_m(frame, scene)).max() < 1.0


def test_flights_with_their_own_errors_fit_within_their_noise(tmp_path: Path) -> None:
    scene = two_flights((0.9, -0.6, 1.2))
    frame, _, warnings = georef(scene, tmp_path)
    first, second = frame.residuals["flights"]
    step = np.subtract(second["offset_m"], first["offset_m"])
    np.testing.assert_allclose(step, [0.9, -0.6, 1.2], atol=0.35)
    assert first["apart"] == second["apart"] == [False, False]
    assert warnings == []
    assert frame.residuals["rmse_horizontal_m"] == pytest.approx(0.3 * math.sqrt(2), rel=0.2)


def test_one_flight_has_no_offset(tmp_path: Path) -> None:
    assert georef(survey(grid()), tmp_path)[0].residuals["flights"] == []


def test_a_wrong_position_in_a_displaced_flight_is_still_reported(tmp_path: Path) -> None:
    scene = two_flights((0.9, -0.6, 47.0))
    scene.positions[30]["altitude_m"] = float(scene.positions[30]["altitude_m"]) - 47.0  # type: ignore[arg-type]
    frame, _, _ = georef(scene, tmp_path)
    assert frame.left_out == (scene.names[30],)


def test_swapped_latitude_and_longitude_of_all_photos_is_reported(tmp_path: Path) -> None:
    scene = survey(grid(), (0.5, 1.0))
    for record in scene.positions:
        record["latitude"], record["longitude"] = float(str(record["longitude"])) + 100.0, record["latitude"]
    frame, _, warnings = georef(scene, tmp_path)
    assert frame.kind == "arbitrary"
    assert any("latitude and longitude swapped" in warning for warning in warnings)


def test_the_frame_has_the_datum_that_its_leading_positions_declare(tmp_path: Path) -> None:
    scene = two_flights((0.0, 0.0, 47.0))
    for index, record in enumerate(scene.positions):
        record["vertical"] = "ellipsoidal" if index >= 24 else "unknown"
        if index >= 24:
            record |= {"sigma_horizontal_m": 0.2, "sigma_vertical_m": 0.3}
    frame, _, _ = georef(scene, tmp_path)
    assert frame.vertical_datum == "ellipsoidal"
    assert frame.residuals["flights"][1]["apart"] == [False, False]
    lifted = errors_m(frame, scene)
    np.testing.assert_allclose(lifted, 47.0, atol=1.0)


def test_a_declared_datum_takes_precedence_over_the_photos(tmp_path: Path) -> None:
    scene = survey(grid())
    for record in scene.positions:
        record["vertical"] = "ellipsoidal"
    frame, _, _ = georef(scene, tmp_path, vertical="EPSG:5773")
    assert frame.vertical_datum == "EPSG:5773"
