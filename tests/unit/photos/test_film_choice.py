"""Which frames of a film become photos: sharp ones, overlapping by 70 to 80 %, none twice, at most so many."""

import cv2
import numpy as np
import pytest

from splatpipe.pipeline.photos.video.choice import choose, overlaps_with
from splatpipe.pipeline.photos.video.motion import MAX_LOST_FRAMES, FilmMeter, Measures, motion, sharpness

FPS = 15.0


def measures(shifts: np.ndarray, sharp: np.ndarray | float = 10.0) -> Measures:
    """A camera whose picture moves by shares of its width from frame to frame."""
    count = len(shifts)
    steps = np.tile(np.eye(3), (count, 1, 1))
    steps[:, 0, 2] = shifts
    steps[0] = np.nan
    return Measures(
        np.arange(count) * 2, np.arange(count) / FPS, np.broadcast_to(np.asarray(sharp, float), count), steps
    )


def textured(seed: int = 0, size: tuple[int, int] = (900, 1600)) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 255, size, dtype=np.uint8)
    return np.asarray(cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), None, 0, 255, cv2.NORM_MINMAX), np.uint8)


def measured(pictures: list[np.ndarray]) -> Measures:
    meter = FilmMeter()
    for k, picture in enumerate(pictures):
        meter.add(k, k / FPS, cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    return meter.measures()


def test_frames_of_a_steady_flight_overlap_by_70_to_80_percent() -> None:
    choice = choose(measures(np.full(400, 0.01)), 300)
    assert len(choice.chosen) > 10
    assert ((choice.overlaps[1:-1] >= 0.7) & (choice.overlaps[1:-1] <= 0.8)).all()
    assert len(choice.blurred) == 0 and choice.cuts_s == ()


def test_a_hovering_camera_gives_no_two_alike() -> None:
    shifts = np.concatenate([np.full(60, 0.01), np.tile([0.004, -0.004], 500), np.full(60, 0.01)])
    choice = choose(measures(shifts), 300)
    assert len(choice.chosen) <= 7
    assert (choice.overlaps[1:] <= 0.9).all()


def test_the_sharpest_frames_are_used() -> None:
    sharp = np.where(np.arange(400) % 4 == 1, 10.0, 7.0)
    assert (choose(measures(np.full(400, 0.01), sharp), 300).chosen % 4 == 1).all()


def test_a_blurred_window_is_replaced_by_nearer_frames_and_a_blurred_stretch_is_told() -> None:
    sharp = np.full(400, 10.0)
    first = int(choose(measures(np.full(400, 0.01), sharp), 300).chosen[1])
    sharp[first - 2 : first + 14] = 1.0  # all frames with 70 to 80 %
    choice = choose(measures(np.full(400, 0.01), sharp), 300)
    assert len(choice.blurred) == 0 and 0.8 < choice.overlaps[1] < 0.95
    sharp[40:400] = np.tile(np.repeat([1.0, 10.0], [42, 6]), 8)[:360]
    choice = choose(measures(np.full(400, 0.01), sharp), 300)
    assert 0 < len(choice.blurred) < len(choice.chosen)


def test_a_limit_thins_evenly() -> None:
    whole, few = (choose(measures(np.full(2000, 0.01)), most) for most in (300, 20))
    assert len(few.chosen) == 20 and few.found == len(whole.chosen) > 40
    assert (few.chosen[0], few.chosen[-1]) == (whole.chosen[0], whole.chosen[-1])
    assert np.ptp(np.diff(few.chosen)) <= 50


def test_a_cut_parts_the_film_and_a_leap_is_taken() -> None:
    shifts = np.full(300, 0.01)
    shifts[150] = np.nan
    cut = measures(np.nan_to_num(shifts))
    cut.steps[150] = np.nan
    choice = choose(cut, 300)
    assert choice.cuts_s == (10.0,) and np.isnan(choice.overlaps).sum() == 2
    assert {149 - 30 < at < 150 for at in choice.chosen} == {True, False}
    assert len(choose(measures(np.full(10, 0.5)), 300).chosen) == 10


def test_turning_and_climbing_count_as_motion() -> None:
    turn, climb = np.eye(3), np.eye(3)
    angle = np.radians(30.0)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn[:2, 2] = 0.5 - turn[:2, :2] @ [0.5, 0.5]
    climb[:2, :2], climb[:2, 2] = 0.7 * np.eye(2), 0.15
    assert (overlaps_with(np.stack([np.eye(3), turn, climb])) < [1.01, 0.6, 0.7]).all()
    shift = np.eye(3)
    shift[0, 2] = 0.25
    assert overlaps_with(shift[None])[0] == pytest.approx(0.75)


def test_motion_is_measured_to_a_fraction_of_a_pixel() -> None:
    picture = textured()
    step = motion(picture[100:370, 100:580], picture[103:373, 107:587])
    assert step is not None
    assert step[:2, 2] * [480, 270] == pytest.approx([-7.0, -3.0], abs=0.1)
    assert motion(picture[:270, :480], textured(1)[:270, :480]) is None
    assert motion(np.full((270, 480), 9, np.uint8), picture[:270, :480]) is None


@pytest.mark.parametrize("kernel", [(1, 9), (9, 1), (9, 9)])
def test_blur_in_any_direction_is_less_sharp(kernel: tuple[int, int]) -> None:
    assert sharpness(cv2.blur(textured(), kernel)) < 0.6 * sharpness(textured())


def test_a_flash_is_no_cut_and_another_scene_is_one() -> None:
    picture, other, white = textured(), textured(1), np.full((540, 960), 255, np.uint8)
    pan = [picture[100:640, 5 * k : 5 * k + 960] for k in range(20)]
    flash = measured([*pan[:10], white, *pan[11:]])
    assert np.isnan(flash.steps[:, 0, 0]).sum() == 1 and flash.sharpness[10] == 0.0
    assert np.prod([step[0, 0] for step in flash.steps[1:]]) == pytest.approx(1.0, abs=0.02)
    assert flash.steps[1:, 0, 2].sum() * 960 == pytest.approx(-95.0, abs=2.0)
    scenes = [*pan, *(other[100:640, 5 * k : 5 * k + 960] for k in range(MAX_LOST_FRAMES + 10))]
    assert np.isnan(measured(scenes).steps[:, 0, 0]).sum() == 2
