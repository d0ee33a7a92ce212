"""Sky detection without learned weights: where the sky is, and nowhere else."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import skies

from splatpipe.pipeline.splat.sky.sky_mask import (
    agreed,
    below_structure,
    find_skies,
    find_sky,
    is_open,
    up_of,
    votes_of,
)

WHITE = (0.92, 0.92, 0.91)


def found(photo: skies.SkyPhoto, points: np.ndarray) -> np.ndarray:
    return find_sky(photo, photo.camera.in_view(points)[1], skies.UP)


@pytest.mark.parametrize("colours", [skies.BLUE, skies.OVERCAST])
@pytest.mark.parametrize("roll_deg", [0.0, 20.0, -90.0, 180.0])
def test_sky_is_found_however_the_photo_is_rolled(
    colours: tuple[tuple[float, ...], tuple[float, ...]], roll_deg: float
) -> None:
    photo, truth = skies.trace(skies.camera_towards(roll_deg=roll_deg), sky=colours)
    assert skies.overlap(found(photo, skies.points_on()), truth) > 0.95


def test_sky_above_a_camera_that_looks_at_the_zenith_is_found() -> None:
    photo, truth = skies.trace(skies.camera_towards(pitch_deg=80.0))
    assert truth.all()
    photo.pixels[-30:] = 40  # an eave: in an image of sky alone nothing is darker than the sky
    mask = found(photo, skies.points_on())
    assert mask[:-34].all() and not mask[-30:].any()


def test_smooth_bluish_water_below_the_horizon_is_not_sky() -> None:
    photo, truth = skies.trace(skies.camera_towards(pitch_deg=0.0), blocks=())
    rows = np.arange(skies.HEIGHT)[:, None, None]
    pixels = np.where(rows > skies.HEIGHT // 2, np.array([120, 160, 200], np.uint8), photo.pixels)
    mask = found(replace(photo, pixels=pixels), skies.points_on(()))
    assert skies.overlap(mask, truth) > 0.9 and not mask[skies.HEIGHT // 2 + 12 :].any()


def test_looking_straight_down_there_is_no_sky() -> None:
    photo, _ = skies.trace(skies.camera_towards(pitch_deg=-85.0), blocks=())
    white = replace(photo, pixels=np.full_like(photo.pixels, 235))
    assert not found(white, np.zeros((0, 3))).any()


def test_white_wall_under_its_roof_is_not_sky() -> None:
    wall = skies.Block(-30.0, 30.0, 8.0, 3.2, 0.0, WHITE)
    roof = skies.Block(-30.0, 30.0, 9.0, 30.0)
    photo, truth = skies.trace(skies.camera_towards(pitch_deg=0.0), (wall, roof))
    assert not truth.any() and (photo.pixels.min(axis=2) > 220).mean() > 0.1
    assert not found(photo, skies.points_on((wall, roof))).any()


def test_white_wall_up_to_the_top_is_not_sky_if_the_camera_looks_down() -> None:
    wall = skies.Block(-30.0, 30.0, 4.0, 1.9, 0.0, WHITE)
    photo, _ = skies.trace(skies.camera_towards(pitch_deg=-35.0), (wall,))
    assert photo.pixels[0].min() > 220
    assert not found(photo, skies.points_on((wall,))).any()


def test_white_wall_up_to_the_top_is_not_sky_where_points_were_triangulated_on_it() -> None:
    wall = skies.Block(-30.0, 30.0, 8.0, 30.0, 0.0, WHITE)
    photo, _ = skies.trace(skies.camera_towards(pitch_deg=0.0), (wall,))
    random = np.random.default_rng(5)
    few = random.uniform([-6.0, 8.0, 0.0], [6.0, 8.0, 6.0], (60, 3))
    assert not found(photo, np.concatenate([skies.points_on(()), few])).any()


def test_a_few_wrong_points_in_the_sky_affect_only_their_surroundings() -> None:
    photo, truth = skies.trace(skies.camera_towards())
    wrong = np.array([[-4.0, 20.0, 11.0], [2.0, 30.0, 16.0], [5.0, 25.0, 14.0]])
    points = np.concatenate([skies.points_on(), wrong])
    mask = found(photo, points)
    assert skies.overlap(mask, truth) > 0.94
    columns, rows = photo.camera.in_view(wrong)[1].astype(int).T
    assert len(rows) == 3 and not mask[rows, columns].any()


def test_sky_of_any_colour_is_taken_from_a_mask() -> None:
    photo, truth = skies.trace(skies.camera_towards(), sky=((0.9, 0.2, 0.1), (0.9, 0.5, 0.1)))
    assert not found(photo, skies.points_on()).any()
    masked = replace(photo, ignored=truth)
    assert skies.overlap(found(masked, skies.points_on()), truth) > 0.95


def test_masked_object_that_does_not_reach_the_top_or_hides_points_is_not_sky() -> None:
    photo, _ = skies.trace(skies.camera_towards(), sky=((0.9, 0.2, 0.1), (0.9, 0.5, 0.1)))
    person = np.zeros((skies.HEIGHT, skies.WIDTH), bool)
    person[120:200, 100:140] = True
    assert not found(replace(photo, ignored=person), skies.points_on()).any()
    wall = skies.Block(-7.0, 7.0, 8.0, 9.0)
    tower, _ = skies.trace(skies.camera_towards(), (wall,))
    upper = np.zeros_like(person)
    upper[:100] = True
    assert not found(replace(tower, ignored=upper), skies.points_on((wall,))).any()


ROOM = (skies.Block(-30.0, 30.0, 8.0, 30.0, 0.0, WHITE), skies.Block(-30.0, 30.0, 7.5, 1.9))  # over a wainscot


def found_in_all(blocks: tuple[skies.Block, ...], points: np.ndarray) -> list[float]:
    """The share of each of four photos that is taken for sky."""
    cameras = [skies.camera_towards(heading, x=x) for heading, x in ((-6.0, -1.0), (-2.0, 0.0), (2.0, 0.5), (6.0, 1.0))]
    photos = [skies.trace(camera, blocks)[0] for camera in cameras]
    return [float(mask.unpacked().mean()) for mask in find_skies(cameras, lambda i: photos[i], points, skies.UP)]


def test_white_wall_of_a_room_is_not_sky_if_other_photos_show_its_ceiling() -> None:
    floor = skies.points_on(ROOM)
    floor = floor[floor[:, 1] < 8.0]
    ceiling = np.random.default_rng(6).uniform([-9.0, 0.0, 7.5], [9.0, 8.0, 7.5], (150, 3))
    assert min(found_in_all(ROOM, floor)) > 0.3  # as white as an overcast sky, and nothing else is known
    assert max(found_in_all(ROOM, np.concatenate([floor, ceiling]))) == 0.0


def test_sky_in_a_window_is_not_detected_if_its_lintel_is_above_the_image() -> None:
    window = (skies.Block(-9.0, -2.0, 8.0, 30.0), skies.Block(2.0, 9.0, 8.0, 30.0))
    walls = skies.points_on(window)
    lintel = np.random.default_rng(7).uniform([-2.0, 8.0, 8.5], [2.0, 8.0, 10.0], (60, 3))
    assert min(found_in_all(window, walls)) > 0.05
    assert max(found_in_all(window, np.concatenate([walls, lintel]))) == 0.0


def test_branch_above_the_sky_and_wrong_points_in_it_do_not_reduce_it() -> None:
    photo, truth = skies.trace(skies.camera_towards())
    random = np.random.default_rng(8)
    branch = random.uniform([-0.6, 6.0, 7.0], [0.8, 6.5, 8.0], (80, 3))
    birds = random.uniform([-9.0, 5.0, 15.0], [9.0, 9.0, 30.0], (2, 3))
    points = np.concatenate([skies.points_on(), branch, birds])
    assert not below_structure(photo.camera, truth, points, skies.UP).any()


def test_points_above_take_memory_in_proportion_to_their_number_only() -> None:
    """Not by that of the columns of azimuth: a dense model has a million above, and each thread its own."""
    photo, truth = skies.trace(skies.camera_towards())
    points = np.random.default_rng(9).uniform([-30.0, 4.0, -30.0], [30.0, 30.0, 30.0], (100_000, 3))
    tracemalloc.start()
    try:
        assert below_structure(photo.camera, truth, points, skies.UP).any()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 30e6  # some twenty numbers a point, and the pixels


def test_few_bright_patches_in_a_large_capture_are_no_sky() -> None:
    cameras = [skies.camera_towards(heading) for heading in np.linspace(0.0, 355.0, 72)]
    empty = np.zeros((skies.HEIGHT, skies.WIDTH), bool)
    patch, upper = empty.copy(), empty.copy()
    patch[:60, 100:220] = True
    upper[:100] = True
    indoors = [votes_of(camera, patch if i < 4 else empty, skies.UP) for i, camera in enumerate(cameras)]
    outdoors = [votes_of(camera, upper if i < 8 else empty, skies.UP) for i, camera in enumerate(cameras)]
    assert not is_open(indoors) and is_open(outdoors)


def test_other_photos_of_the_same_direction_decide() -> None:
    cameras = [skies.camera_towards(x=x) for x in (-1.0, 0.0, 1.0, 2.0)]
    sky = np.zeros((skies.HEIGHT, skies.WIDTH), bool)
    sky[:80] = True
    wall = np.zeros_like(sky)
    wall[80:] = True
    pairs = zip(cameras, [sky, sky, sky, wall], strict=True)
    assert agreed([votes_of(camera, mask, skies.UP) for camera, mask in pairs]) == [True, True, True, False]
    apart = zip([cameras[0], skies.camera_towards(heading_deg=180.0)], [sky, wall], strict=True)
    assert agreed([votes_of(camera, mask, skies.UP) for camera, mask in apart]) == [True, True]


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, -90.0])
def test_capture_without_orientation_finds_up_and_sky(turn_deg: float) -> None:
    cameras = [
        skies.camera_towards(heading_deg=heading, pitch_deg=6.0, roll_deg=turn_deg + wobble, x=0.1 * heading)
        for heading, wobble in ((-25.0, 1.0), (-10.0, -1.0), (0.0, 0.5), (12.0, 1.0), (24.0, -0.5))
    ]
    traced = [skies.trace(camera) for camera in cameras]
    points = skies.points_on()
    up = up_of(cameras, lambda index: traced[index][0], points)
    assert np.degrees(np.arccos(up @ skies.UP)) < 3.0
    masks = find_skies(cameras, lambda index: traced[index][0], points, up)
    assert all(skies.overlap(mask.unpacked(), truth) > 0.93 for mask, (_, truth) in zip(masks, traced, strict=True))
    threaded = find_skies(cameras, lambda index: traced[index][0], points, up, threads=3)
    assert all((one.bits == other.bits).all() for one, other in zip(masks, threaded, strict=True))


def test_cameras_that_do_not_turn_count_as_held_upright() -> None:
    cameras = [skies.camera_towards(pitch_deg=0.0, x=x) for x in np.linspace(-3.0, 3.0, 6)]
    traced = skies.trace(cameras[0])[0]
    np.testing.assert_allclose(up_of(cameras, lambda _: traced, skies.points_on()), skies.UP, atol=1e-6)


def test_sky_masks_override_points_and_other_photos() -> None:
    cameras = [skies.camera_towards(heading, x=0.1 * heading) for heading in (-6.0, -2.0, 2.0, 6.0)]
    traced = [skies.trace(camera) for camera in cameras]
    drawn = np.zeros(traced[0][1].shape, bool)
    drawn[-40:, :60] = True
    photos = [traced[0][0], replace(traced[1][0], drawn=drawn), *(photo for photo, _ in traced[2:])]
    masks = find_skies(cameras, lambda index: photos[index], skies.points_on(), skies.UP)
    np.testing.assert_array_equal(masks[1].unpacked(), drawn)
    for index in (0, 2, 3):
        assert skies.overlap(masks[index].unpacked(), traced[index][1]) > 0.95


def test_no_photos_have_no_sky() -> None:
    assert find_skies([], lambda _: skies.trace(skies.camera_towards())[0], np.zeros((0, 3)), skies.UP) == []


def test_bright_strip_that_is_narrow_at_the_top_is_not_sky() -> None:
    tower = skies.Block(-30.0, 30.0, 8.0, 30.0)
    photo, _ = skies.trace(skies.camera_towards(), (tower,))
    photo.pixels[:200, 100:125] = (228, 230, 232)  # a white column on a dark wall, no point on either
    assert not found(photo, np.zeros((0, 3))).any()
    photo.pixels[:60] = (228, 230, 232)  # as wide as the image, it might be sky: only points decide
    assert found(photo, np.zeros((0, 3)))[:50].all()
