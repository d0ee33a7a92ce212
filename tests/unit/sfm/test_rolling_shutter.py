"""A film's readout time is found where its frames tell it, and only there; cameras come nearer to the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from film_scene import FRAME_S, HEIGHT, WIDTH, FilmScene, along, around, centre_errors_m, film_scene

from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.sfm.shutter.film_motion import MAX_GAP_S, FrameMotion, frame_motions
from splatpipe.pipeline.sfm.shutter.frame_shutter import load_film_shutter, save_film_shutter
from splatpipe.pipeline.sfm.shutter.readout import regress
from splatpipe.pipeline.sfm.shutter.rolling_shutter import correct_rolling_shutter, film_shutter
from splatpipe.pipeline.sfm.shutter.row_shift import row_shifts
from splatpipe.pipeline.survey.placing.model import model_of

READOUT_S = 1.0 / 60.0
TIMES_S = [1.25 * k for k in range(24)]
POINTS = 1500
MAX_NOISE_PX = 2.5  # the keypoints' noise is 0.4
MAX_OFF = 0.2  # of the readout: four times its standard deviation in these scenes


def rms_m(scene: FilmScene, model: pycolmap.Reconstruction) -> float:
    return float(np.sqrt(np.mean(centre_errors_m(scene, model) ** 2)))


@pytest.mark.parametrize("readout_s", [READOUT_S, -READOUT_S])
def test_the_readout_is_found_with_its_sign_and_the_centres_come_nearer(readout_s: float) -> None:
    scene = film_scene(around, TIMES_S, readout_s, 0, points=POINTS)
    found = correct_rolling_shutter(scene.model, scene.verified, scene.film)
    assert found.readout.determined and found.readout.frames == len(TIMES_S)
    assert found.readout.estimate_s == pytest.approx(readout_s, rel=MAX_OFF)
    still = film_scene(around, TIMES_S, 0.0, 0, points=POINTS)
    assert rms_m(scene, scene.model) > 1.6 * rms_m(still, still.model)
    assert rms_m(scene, found.model) < 1.3 * rms_m(still, still.model)
    shifted = [found.verified.keypoints[number] - scene.verified.keypoints[number] for number in scene.centres]
    assert np.abs(np.concatenate(shifted)).max() > 1.0
    for number in scene.centres:
        image = found.model.images[number]
        places = np.array([point.xy for point in image.points2D])
        np.testing.assert_array_equal(places, found.verified.keypoints[number].astype(np.float64))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("poses_at", [around, along])
def test_a_global_shutter_leaves_the_very_model(poses_at: object, seed: int) -> None:
    size_m = (25.0, 25.0, 4.0) if poses_at is around else (35.0, 150.0, 5.0)
    scene = film_scene(poses_at, TIMES_S, 0.0, seed, points=POINTS, size_m=size_m)  # type: ignore[arg-type]
    found = correct_rolling_shutter(scene.model, scene.verified, scene.film)
    assert found.model is scene.model and found.verified is scene.verified
    assert not found.readout.determined
    assert abs(found.readout.estimate_s) < 5.0 * found.readout.sigma_s < MAX_OFF * 5.0 * FRAME_S


def test_distortion_is_not_taken_for_a_shutter() -> None:
    brown = (1382.0, 1382.0, 970.0, 532.0, -0.04459, 0.00887, 0.00145, -0.001905, -0.01955, 0.0, 0.0, 0.0)
    scene = film_scene(around, TIMES_S, 0.0, 0, lens=brown, model_name="FULL_OPENCV", points=POINTS)
    assert not correct_rolling_shutter(scene.model, scene.verified, scene.film).readout.determined


def test_frames_far_apart_or_few_determine_nothing() -> None:
    scene = film_scene(around, [4.0 * MAX_GAP_S * k for k in range(10)], READOUT_S, 0, points=POINTS)
    found = correct_rolling_shutter(scene.model, scene.verified, scene.film)
    assert found.model is scene.model and found.readout.frames == 0


def test_speeds_of_a_circle_are_those_of_its_formula() -> None:
    times_s = np.linspace(0.0, 10.0, 41)
    poses = dict(enumerate(around(times_s)))
    found = frame_motions(poses, dict(enumerate(times_s.tolist())), dict.fromkeys(poses, 0))
    for number, time_s in enumerate(times_s.tolist()):
        before, after = around(np.array([time_s - 1e-4, time_s + 1e-4]))
        centres = [-pose[:, :3].T @ pose[:, 3] for pose in (before, after)]
        turn = (after[:, :3] @ before[:, :3].T - np.eye(3)) / 2e-4
        size = 0.01 if number in (0, len(times_s) - 1) else 0.003  # at the ends, from one side
        np.testing.assert_allclose(found[number].velocity, (centres[1] - centres[0]) / 2e-4, atol=size * 5.0)
        np.testing.assert_allclose(found[number].turning, [turn[2, 1], turn[0, 2], turn[1, 0]], atol=size * 0.3)


def test_a_gap_or_a_cut_is_no_motion() -> None:
    times = {0: 0.0, 1: 1.0, 2: 2.0, 3: 2.0 + 2.0 * MAX_GAP_S, 4: 3.0 + 2.0 * MAX_GAP_S, 5: 4.0 + 2.0 * MAX_GAP_S}
    poses = {number: around(np.array([time_s]))[0] for number, time_s in times.items()}
    found = frame_motions(poses, times, dict.fromkeys(times, 0) | {5: 1})
    assert sorted(found) == [0, 1, 2, 3, 4]
    straight = (pose_centre(poses[4]) - pose_centre(poses[3])) / 1.0
    np.testing.assert_allclose(found[3].velocity, straight)
    np.testing.assert_allclose(found[4].velocity, straight)


def test_marks_are_corrected_as_the_keypoints_around_them_and_back(tmp_path: Path) -> None:
    scene = film_scene(around, TIMES_S, READOUT_S, 0, points=POINTS)
    found = correct_rolling_shutter(scene.model, scene.verified, scene.film).model
    save_film_shutter(film_shutter(found, scene.film, READOUT_S), tmp_path)
    assert load_film_shutter(tmp_path / "elsewhere") is None
    film = load_film_shutter(tmp_path)
    assert film is not None and film.readout_s == READOUT_S and len(film.motions) == len(TIMES_S)
    model = model_of(found, [], film)
    view = model.view(11, WIDTH)
    image = found.images[model.image_ids[11]]
    seen = [point for point in image.points2D if point.has_point3D()][::20]
    for point in seen:
        place = found.points3D[point.point3D_id].xyz
        taken = view.pixel(place)
        plain, _ = project_through_lens(view.camera, view.cam_from_model, place[None])
        raw = scene.verified.keypoints[image.image_id]
        assert np.linalg.norm(raw - taken, axis=1).min() < MAX_NOISE_PX  # as the frame shows it
        np.testing.assert_allclose(view.still(taken), plain[0], atol=1.0)  # the depths around it differ a little
    lying = model_of(found, []).view(11, WIDTH)
    assert lying.shutter is None and (lying.still(np.ones(2)) == 1.0).all()


def pose_centre(pose: np.ndarray) -> np.ndarray:
    return np.asarray(-pose[:, :3].T @ pose[:, 3])


def test_rows_shift_with_their_distance_from_the_middle() -> None:
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[1000.0, 1000.0, WIDTH / 2, HEIGHT / 2]
    )
    sideways = FrameMotion(np.array([2.0, 0.0, 0.0]), np.zeros(3))
    points = np.array([[0.0, -4.0, 10.0], [1.0, 0.0, 10.0], [0.0, 5.0, 10.0]])
    pixels = np.asarray(camera.img_from_cam(points))
    shifts = row_shifts(camera, np.eye(3), sideways, points, pixels, 0.1)
    rows = pixels[:, 1] / HEIGHT - 0.5
    np.testing.assert_allclose(shifts, np.stack([-20.0 * rows, 0.0 * rows], axis=1), atol=1e-9)
    assert (row_shifts(camera, np.eye(3), sideways, points, pixels, 0.0) == 0.0).all()


def test_the_regressions_deviation_covers_errors_that_a_frame_shares() -> None:
    rng = np.random.default_rng(0)
    frames = np.repeat(np.arange(40), 50)
    effect = rng.normal(1.0, 0.2, (len(frames), 2))
    off = []
    for _ in range(200):
        noise = 0.02 * rng.normal(size=(40, 2))[frames] + 0.02 * rng.normal(size=(len(frames), 2))
        step, sigma = regress(noise - 0.01 * effect, effect, frames, 0)
        off.append((step - 0.01) / sigma)
    assert 0.8 < float(np.std(off)) < 1.2


def test_the_same_film_gives_the_same_bits() -> None:
    scene = film_scene(around, TIMES_S, READOUT_S, 1, points=POINTS)
    models = [correct_rolling_shutter(scene.model, scene.verified, scene.film).model for _ in range(2)]
    poses = [np.stack([m.images[n].cam_from_world().matrix() for n in sorted(scene.centres)]) for m in models]
    np.testing.assert_array_equal(*poses)
