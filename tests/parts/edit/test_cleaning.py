"""Cleaning against truth: a box on a plain made of Gaussians, cameras around it, and Gaussians that do not belong."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float32, Float64

from splatpipe.pipeline.edit.floaters.cleaning import CleaningResult, clean_scene
from splatpipe.pipeline.edit.floaters.depth_islands import without_islands
from splatpipe.pipeline.edit.floaters.visibility import TrainingPhotos, measure_visibility
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc

SPACING = 0.1
OPTIONS = rasterizer.RenderOptions(sh_degree=0)
Points = Float64[np.ndarray, "n 3"]


def made_of(
    points: Points, scale: float | tuple[float, float, float], colour: float, opacity: float = 0.95
) -> Gaussians:
    """Gaussians at points, not rotated."""
    found = Gaussians.empty(len(points), 0)
    found.means[:] = torch.from_numpy(points).float()
    found.log_scales[:] = torch.log(torch.tensor(scale if isinstance(scale, tuple) else (scale,) * 3))
    found.opacity_logits[:] = torch.logit(torch.tensor(opacity))
    found.sh[:, 0] = rgb_to_dc(torch.full((3,), colour))
    return found


def grid(low: tuple[float, float, float], high: tuple[float, float, float]) -> Points:
    """Points between two corners; a side without length is a plane."""
    axes = [np.arange(a, b + 1e-9, SPACING) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@cache
def scene() -> Gaussians:
    """A plain of 8 m, a box of 2 m on it, a pole of 2 m beside it, and a wire from the pole to the box's roof."""
    thin = 0.2 * SPACING
    ground = made_of(grid((-4, -4, 0), (4, 4, 0)), (0.07, 0.07, thin), 0.4)
    roof = made_of(grid((-1, -1, 2), (1, 1, 2)), (0.07, 0.07, thin), 0.7)
    walls = [made_of(grid((side, -1, 0), (side, 1, 2)), (thin, 0.07, 0.07), 0.6) for side in (-1.0, 1.0)] + [
        made_of(grid((-1, side, 0), (1, side, 2)), (0.07, thin, 0.07), 0.5) for side in (-1.0, 1.0)
    ]
    pole = made_of(grid((2.5, 0, 0), (2.5, 0, 2)), (0.03, 0.03, 0.06), 0.9)
    wire = made_of(grid((1, 0, 2), (2.5, 0, 2)), (0.06, 0.015, 0.015), 0.1)
    return Gaussians.concat([ground, roof, *walls, pole, wire])


def camera(eye: tuple[float, float, float], name: str) -> Camera:
    """Return a camera that looks at the scene's centre."""
    return looking(eye, (0.0, 0.0, 0.7), name)


def looking(eye: tuple[float, float, float], at: tuple[float, float, float], name: str = "") -> Camera:
    """Return a camera that looks at a point."""
    centre = np.array(eye)
    forward = np.array(at) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ centre
    return Camera(name, 160, 120, 150.0, 150.0, 80.0, 60.0, pose)


def cameras() -> list[Camera]:
    """Twelve around it, at two heights."""
    turns = [(2.0 * np.pi * k / 12, 4.0 if k % 2 else 6.5) for k in range(12)]
    return [camera((7.0 * np.cos(a), 7.0 * np.sin(a), height), f"{a:.2f}") for a, height in turns]


def photos(pictures: bool) -> TrainingPhotos:
    """Return photos of the original scene."""

    return TrainingPhotos(cameras(), OPTIONS, picture if pictures else None)


@cache
def picture(index: int) -> tuple[Pixels, Mask | None]:
    """Return what a camera sees of the original scene."""
    with torch.no_grad():
        colour = rasterizer.render(scene(), cameras()[index], OPTIONS).colour
    pixels = (colour.clamp(0.0, 1.0) * 255.0 + 0.5).numpy().astype(np.uint8)
    pixels.flags.writeable = False
    return pixels, None


def planted(kind: str) -> Gaussians:
    """Return Gaussians that do not belong to the scene."""
    rng = np.random.default_rng(3)
    air = np.stack([rng.uniform(-3, 3, 40), rng.uniform(-3, 3, 40), rng.uniform(2.6, 3.4, 40)], axis=1)
    if kind == "single":
        return made_of(air, 0.05, 1.0)
    if kind == "clusters":
        return made_of((air[:6, None] + rng.normal(0, 0.08, (6, 8, 3))).reshape(-1, 3), 0.05, 1.0)
    if kind == "near surfaces":
        beside = np.stack([np.full(30, -1.5), rng.uniform(-0.9, 0.9, 30), rng.uniform(0.5, 1.8, 30)], axis=1)
        return made_of(beside[::3], 0.04, 1.0)
    if kind == "transparent":
        return made_of(air, 0.05, 1.0, opacity=0.005)
    assert kind == "oversized"
    return made_of(np.array([[0.0, 0.0, 4.0]]), (1.5, 1.5, 0.1), 1.0, opacity=0.2)


def shares(cleaned: CleaningResult) -> tuple[float, float]:
    """Return the shares of planted Gaussians found and of the scene lost."""
    real = len(scene())
    return 1.0 - float(cleaned.keep[real:].float().mean()), 1.0 - float(cleaned.keep[:real].float().mean())


@pytest.mark.parametrize("known", ["pictures", "cameras", "nothing"])
@pytest.mark.parametrize("kind", ["single", "clusters", "near surfaces", "transparent"])
def test_planted_floaters_are_found_and_the_scene_is_kept(kind: str, known: str) -> None:
    both = Gaussians.concat([scene(), planted(kind)])
    seen = None if known == "nothing" else photos(pictures=known == "pictures")
    found, lost = shares(clean_scene(both, seen))
    assert found >= 0.95
    assert lost <= 0.005


@pytest.mark.parametrize("known", ["pictures", "cameras", "nothing"])
def test_thin_things_are_kept(known: str) -> None:
    seen = None if known == "nothing" else photos(pictures=known == "pictures")
    thin = grid((2.5, 0, 0), (2.5, 0, 2)).shape[0] + grid((1, 0, 2), (2.5, 0, 2)).shape[0]
    assert clean_scene(scene(), seen).keep[-thin:].all()


def test_large_haze_in_front_of_everything_is_found() -> None:
    cleaned = clean_scene(Gaussians.concat([scene(), planted("oversized")]), photos(pictures=True))
    assert not cleaned.keep[-1] and cleaned.keep[:-1].float().mean() >= 0.995


def test_gaussians_that_no_photo_sees_are_removed_unless_attached_to_the_scene() -> None:
    inside = made_of(np.array([[0.0, 0.0, -1.0], [0.1, 0.1, -0.9]]), 0.02, 0.5)  # far below
    behind = made_of(np.array([[0.0, 0.0, -0.03]]), 0.05, 0.5)  # under the box, in contact with the ground
    cleaned = clean_scene(Gaussians.concat([scene(), inside, behind]), photos(pictures=False))
    assert cleaned.keep[-3:].tolist() == [False, False, True]
    assert cleaned.removed["seen by none"] == 2


def test_real_floating_objects_are_kept_because_of_the_photos() -> None:
    balloon = made_of(np.array([[1.8, -1.5, 1.9], [-1.9, 1.6, 1.5]]), 0.08, 0.9)
    real = Gaussians.concat([scene(), balloon])

    def picture(index: int) -> tuple[Pixels, Mask | None]:
        with torch.no_grad():
            colour = rasterizer.render(real, cameras()[index], OPTIONS).colour
        return (colour.clamp(0.0, 1.0) * 255.0 + 0.5).numpy().astype(np.uint8), None

    assert clean_scene(real, TrainingPhotos(cameras(), OPTIONS, picture)).keep[-2:].all()
    assert not clean_scene(real, photos(pictures=True)).keep[-2:].any()  # on photos without them


def test_a_veil_beside_a_camera_is_found_if_it_helps_no_photo() -> None:
    """Two walls at a right angle; most photos show one from afar, the last was taken right before it, along it.

    A rod from the wall holds the veil: what is held by nothing is found anyway.
    """
    near = looking((1.0, -1.0, 1.0), (8.0, -1.0, 1.0))
    far = [looking((x, -9.0, 1.0), (x, 0.0, 1.0)) for x in (-1.0, 0.0, 1.0, 2.0)]
    walls = Gaussians.concat(
        [
            made_of(grid((-4, 0, -2), (8, 0, 4)), (0.07, 0.02, 0.07), 0.6),
            made_of(grid((8, -5, -2), (8, 0, 4)), (0.02, 0.07, 0.07), 0.4),
            made_of(grid((0.95, -0.6, 1.05), (0.95, 0, 1.05)), (0.02, 0.05, 0.02), 0.6),
        ]
    )
    veil = made_of(np.array([[0.95, -0.75, 1.05]]), 0.1, 0.6, opacity=0.3)

    def kept(cameras: list[Camera], taken_of: Gaussians, veil: Gaussians = veil) -> bool:
        def picture(index: int) -> tuple[Pixels, Mask | None]:
            with torch.no_grad():
                colour = rasterizer.render(taken_of, cameras[index], OPTIONS).colour
            return (colour.clamp(0.0, 1.0) * 255.0 + 0.5).numpy().astype(np.uint8), None

        cleaned = clean_scene(Gaussians.concat([walls, veil]), TrainingPhotos(cameras, OPTIONS, picture))
        assert cleaned.keep[:-1].float().mean() >= 0.995
        return bool(cleaned.keep[-1])

    assert not kept([*far, near], walls)
    assert kept(far, walls)  # nobody was there
    dark = replace(veil, sh=torch.full_like(veil.sh, -1.5))
    assert kept([*far, near], Gaussians.concat([walls, dark]), dark)  # the photos show it


def test_some_photos_suffice_to_find_floaters_and_what_they_do_not_show_is_kept() -> None:
    both = Gaussians.concat([scene(), planted("clusters")])
    every, all_photos = clean_scene(both, photos(pictures=True)), range(len(cameras()))
    assert torch.equal(clean_scene(both, replace(photos(pictures=True), compared=all_photos)).keep, every.keep)
    asked: list[int] = []

    def picture(index: int) -> tuple[Pixels, Mask | None]:
        asked.append(index)
        taken = photos(pictures=True).picture
        assert taken is not None
        return taken(index)

    found, lost = shares(clean_scene(both, TrainingPhotos(cameras(), OPTIONS, picture, compared=[0, 3, 6, 9])))
    assert found >= 0.95 and lost <= 0.005
    assert set(asked) == {0, 3, 6, 9}
    blind = clean_scene(both, replace(photos(pictures=True), compared=[]))
    assert blind.removed["floating"] == blind.removed["oversized"] == 0


def test_cleaning_twice_equals_cleaning_once_bit_for_bit() -> None:
    both = Gaussians.concat([scene(), planted("single"), planted("clusters")])
    first = clean_scene(both, photos(pictures=True))
    assert torch.equal(first.keep, clean_scene(both, photos(pictures=True)).keep)
    again = clean_scene(both.select(first.keep), photos(pictures=True))
    assert again.keep.all() and not any(again.removed.values())


def test_nothing_is_removed_from_few_or_no_gaussians() -> None:
    for few in (scene().first(0), scene().first(1), scene().first(9)):
        assert clean_scene(few).keep.all()


def test_values_that_are_not_finite_are_refused() -> None:
    broken = scene().clone()
    broken.means[3, 0] = float("nan")
    with pytest.raises(ValueError, match="not finite"):
        clean_scene(broken)


def test_weights_are_those_of_the_definition() -> None:
    """Two Gaussians, one before the other: the sums of α T by the slow definition, rendered in white on black."""
    two = made_of(np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 1.0]]), 0.2, 0.5, opacity=0.6)
    above = camera((0.01, 0.0, 7.0), "above")
    found = measure_visibility(two, TrainingPhotos([above], OPTIONS), lambda _done: None)
    for row in range(2):
        colours = torch.zeros(2, 3)
        colours[row] = 1.0
        lit = replace(two, sh=rgb_to_dc(colours)[:, None].contiguous())
        light = rasterizer.render(lit, above, OPTIONS, backend="reference").colour[..., 0].sum()
        assert found.weight[row] == pytest.approx(float(light), rel=1e-3)
    assert found.photos.tolist() == pytest.approx([1.0, 1.0])
    assert found.angle_deg == pytest.approx([0.0, 0.0], abs=0.1)  # float32 of a cosine near 1


def test_the_angle_between_photos_is_correct() -> None:
    one = made_of(np.array([[0.0, 0.0, 0.7]]), 0.2, 0.5)
    pair = [camera((5.0 * np.sin(a), 0.0, 0.7 + 5.0 * np.cos(a)), str(a)) for a in (-0.2, 0.2)]
    found = measure_visibility(one, TrainingPhotos(pair, OPTIONS), lambda _done: None)
    assert found.photos[0] == pytest.approx(2.0, abs=0.01)
    assert found.angle_deg[0] == pytest.approx(np.rad2deg(0.2), rel=0.02)


def test_islands_are_filled_and_long_objects_are_not() -> None:
    depth: Float32[np.ndarray, "h w"] = np.full((120, 160), 10.0, np.float32)
    depth[50:56, 40:46] = 5.0  # an island
    depth[:90, 100:102] = 6.0  # a pole
    depth[90:] = 8.0  # the ground
    filled = without_islands(depth)
    island: Bool[np.ndarray, "h w"] = depth == 5.0
    assert (filled[island] == 10.0).all()
    assert (filled[~island] == depth[~island]).mean() > 0.995  # but for corners


def test_without_a_surface_nothing_is_near() -> None:
    assert (without_islands(np.zeros((20, 30), np.float32)) > 0.0).all()
