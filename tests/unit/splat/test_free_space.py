"""Free space: a wall at a known depth, and Gaussians in front of it, on it and behind it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality import free_space as module
from splatpipe.pipeline.splat.quality.free_space import FreeSpace, free_space, near_or_free, share_of_opacity

WALL = 10.0  # depth; every camera looks along z, so that a cell of 20 pixels is half a unit wide there
WIDTH, HEIGHT, FOCAL = 480, 360, 400.0


def camera(x: float, name: str = "") -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(name or f"at {x}", WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


CAMERAS = [camera(x) for x in (-1.0, 0.0, 1.0)]


def wall(lowest: float = 6.0) -> np.ndarray:
    """Points a fifth of a unit apart; y is down, so `lowest` is the largest y."""
    x, y = np.meshgrid(np.arange(-8.0, 8.1, 0.2), np.arange(-6.0, lowest, 0.2))
    return np.stack((x.ravel(), y.ravel(), np.full(x.size, WALL)), axis=1)


def observed(cameras: list[Camera], xyz: np.ndarray) -> list[np.ndarray]:
    found = []
    for view in cameras:
        pixels = view.project(xyz)
        found.append(np.flatnonzero(((pixels >= 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1)))
    return found


def space_of(cameras: list[Camera], xyz: np.ndarray) -> FreeSpace:
    return free_space(cameras, xyz, observed(cameras, xyz))


@pytest.fixture(scope="module")
def space() -> FreeSpace:
    return space_of(CAMERAS, wall())


def gaussians_at(places: list[tuple[float, float, float]], size: float = 0.01) -> Gaussians:
    found = Gaussians.empty(len(places), 0)
    found.means = torch.tensor(places, dtype=torch.float32).reshape(-1, 3)
    found.log_scales[:] = float(np.log(size))
    return found


def free_space_views(gaussians: Gaussians, space: FreeSpace) -> torch.Tensor:
    """Photos that see through each Gaussian; all of them where it is directly in front of a camera."""
    counts = range(1, len(space.photos) + 1)
    return sum((near_or_free(gaussians, space, views).long() for views in counts), torch.zeros(len(gaussians)).long())


def with_opacity(gaussians: Gaussians, opacity: float) -> Gaussians:
    return replace(gaussians, opacity_logits=torch.full((len(gaussians),), float(np.log(opacity / (1.0 - opacity)))))


def test_share_of_opacity_is_that_of_the_gaussians_in_front_of_the_wall(space: FreeSpace) -> None:
    rows = [(0.1 * n, 0.05 * n) for n in range(-5, 5)]
    parts = [with_opacity(gaussians_at([(x, y, z) for x, y in rows]), o) for z, o in ((5, 0.8), (WALL, 0.4), (15, 0.2))]
    model = Gaussians.concat(parts)
    chosen = near_or_free(model, space)
    assert chosen.tolist() == [True] * 10 + [False] * 20
    assert share_of_opacity(model, chosen) == pytest.approx(0.8 / (0.8 + 0.4 + 0.2), abs=1e-7)


def test_every_photo_that_sees_through_a_gaussian_counts_once(space: FreeSpace) -> None:
    # At depth 5 an image is 6 wide: x = 3.9 is only in the last camera's, 2.5 in those of the last two.
    places = [(0.0, 0.0, 5.0), (2.5, 0.0, 5.0), (3.7, 0.0, 5.0), (4.5, 0.0, 5.0)]
    assert free_space_views(gaussians_at(places), space).tolist() == [3, 2, 1, 0]
    assert near_or_free(gaussians_at(places), space).tolist() == [True, True, False, False]
    assert near_or_free(gaussians_at(places), space, views=1).tolist() == [True, True, True, False]


def test_gaussians_within_a_tenth_of_the_depth_of_the_surface_are_kept(space: FreeSpace) -> None:
    assert free_space_views(gaussians_at([(0, 0, 8.95), (0, 0, 9.05)]), space).tolist() == [3, 0]


def test_only_the_extent_along_the_view_may_reach_the_surface(space: FreeSpace) -> None:
    model = gaussians_at([(0, 0, 8.5)] * 4)
    model.log_scales[1, 0] = model.log_scales[2, 2] = model.log_scales[3, 0] = float(np.log(0.6))
    model.quats[3] = torch.tensor([1.0, 0.0, 1.0, 0.0])  # a quarter turn about y: its x axis looks along the view
    assert free_space_views(model, space).tolist() == [3, 3, 0, 0]


def test_directly_in_front_of_a_camera_one_photo_is_enough() -> None:
    # Two units are a fifth of the wall's depth; the other cameras' images show nothing so near.
    space = space_of(CAMERAS, wall())
    places = [(-1.0, 0.0, 1.0), (-1.0, 0.0, -1.0), (-1.5, 0.0, 0.5)]
    assert near_or_free(gaussians_at(places), space, views=1).tolist() == [True, False, False]
    assert near_or_free(gaussians_at(places), space, views=2).tolist() == [True, False, False]  # one sees through it


def test_a_photo_with_something_close_does_not_call_that_a_floater() -> None:
    fence = np.array([(x, y, 1.5) for x in np.arange(-0.2, 0.2, 0.05) for y in (0.4, 0.45)])
    space = space_of([camera(0.0)], np.concatenate((wall(), fence)))
    assert len(fence) < 0.05 * len(wall())
    assert space.photos[0].near == pytest.approx(0.9 * 1.5)
    assert near_or_free(gaussians_at([(0.0, 0.42, 1.5), (0.0, 0.0, 1.2)]), space).tolist() == [False, True]


@pytest.mark.parametrize(("observers", "through"), [(3, 0), (2, 3)])
def test_well_observed_point_beside_a_gaussian_contradicts_free_space(observers: int, through: int) -> None:
    """A post that is thinner than a cell: three photos see the wall around it, others see it."""
    xyz = np.concatenate((wall(), [(0.0, 0.0, 6.0)]))
    others = [camera(0.0, f"other {n}") for n in range(observers)]
    rows = [seen[seen < len(xyz) - 1] for seen in observed(CAMERAS, xyz)]
    rows += [np.array([len(xyz) - 1])] * observers
    space = free_space([*CAMERAS, *others], xyz, rows)
    views = free_space_views(gaussians_at([(0.0, 0.22, 6.0), (0.0, 0.26, 6.0)]), space)
    assert views.tolist() == [through, 3]  # 4 % of the distance of 6 are 0.24


def test_ground_at_the_foot_of_a_wall_is_not_judged() -> None:
    """The wall's points end within a cell (pixels 220 to 240); below them, something may be nearer."""
    space = space_of(CAMERAS, wall(lowest=1.3))
    foot = float(wall(lowest=1.3)[:, 1].max()) * FOCAL / WALL + HEIGHT / 2
    assert 220.0 < foot < 235.0
    above, below = ((row - HEIGHT / 2) * 7.0 / FOCAL for row in (222.0, 238.0))
    assert free_space_views(gaussians_at([(0.0, above, 7.0), (0.0, below, 7.0)]), space).tolist() == [3, 0]


def test_nearer_points_in_the_cell_around_lower_the_bound() -> None:
    xyz = np.concatenate((wall(), [(0.25, 0.25, 7.0)]))
    space = space_of(CAMERAS, xyz)
    apart = gaussians_at([(0.0, 0.0, 6.8), (0.0, 2.0, 6.8)])
    assert free_space_views(apart, space).tolist() == [0, 3]


def test_nothing_is_called_free_without_points_or_photos() -> None:
    model = gaussians_at([(0.0, 0.0, 5.0)])
    none = free_space(CAMERAS, np.empty((0, 3)), [np.empty(0, np.int64)] * 3)
    few = space_of(CAMERAS, wall()[::401])
    nobody = free_space([], wall(), [])
    alone = space_of(CAMERAS[:1], wall())
    for unknown in (none, few, nobody, alone):
        assert not unknown.known
        assert not near_or_free(model, unknown).any()
    assert space_of(CAMERAS, wall()).known


def test_broken_gaussians_and_points_are_ignored(space: FreeSpace) -> None:
    model = gaussians_at([(0.0, 0.0, 5.0)] * 6 + [(0.0, 0.0, 0.0)])
    model.means[0, 2] = float("nan")
    model.means[1, 0] = float("inf")
    model.log_scales[2] = float("nan")
    model.opacity_logits[3] = float("nan")
    model.log_scales[4] = 500.0  # finite, but its size is not
    model.quats[5] = 0.0  # the identity
    assert free_space_views(model, space).tolist() == [0, 0, 0, 0, 0, 3, 0]
    chosen = near_or_free(model, space)
    assert share_of_opacity(model, chosen) == pytest.approx(1.0 / 3.0)
    xyz = np.concatenate((wall(), [(np.nan, 0.0, 1.0), (np.inf, 0.0, 1.0)]))
    rows = [np.concatenate((seen, [len(xyz) - 1, len(xyz) - 2])) for seen in observed(CAMERAS, wall())]
    broken = free_space(CAMERAS, xyz, rows)
    assert free_space_views(gaussians_at([(0.0, 0.0, 5.0)]), broken).tolist() == [3]


def test_model_without_gaussians_or_opacity_has_no_share(space: FreeSpace) -> None:
    empty = gaussians_at([])
    assert near_or_free(empty, space).shape == (0,)
    assert share_of_opacity(empty, near_or_free(empty, space)) == 0.0


def test_result_is_the_same_in_another_frame_and_by_parts(space: FreeSpace, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(3)
    model = gaussians_at([(0.0, 0.0, 0.0)] * 2000)
    model.means = torch.rand(2000, 3, generator=generator) * torch.tensor([10.0, 6.0, 14.0]) - torch.tensor([5.0, 3, 0])
    model.log_scales = torch.randn(2000, 3, generator=generator) - 1.5
    model.quats = torch.randn(2000, 4, generator=generator)
    here = free_space_views(model, space)
    assert 200 < int((here > 0).sum()) < 1800
    angle = 0.7
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    scale, shift = 3.7, np.array([20.0, -3.0, 8.0])
    moved = []
    for view in CAMERAS:
        pose = np.eye(4)
        pose[:3, :3] = view.cam_from_world[:3, :3] @ turn.T
        pose[:3, 3] = scale * view.cam_from_world[:3, 3] - pose[:3, :3] @ shift
        moved.append(replace(view, cam_from_world=pose))
    there = free_space(moved, scale * wall() @ turn.T + shift, observed(CAMERAS, wall()))
    elsewhere = model.transformed(scale, torch.from_numpy(turn), torch.from_numpy(shift))
    monkeypatch.setattr(module, "CHUNK", 300)
    differing = int((free_space_views(elsewhere, there) != here).sum())
    assert differing <= 2  # single precision at the edges of cells
    assert torch.equal(free_space_views(model, space), here)


def test_gaussians_on_a_device_are_judged_equally(space: FreeSpace) -> None:
    generator = torch.Generator().manual_seed(3)
    model = gaussians_at([(0.0, 0.0, 1.0)] * 4000, 0.05)
    model.means = torch.rand(4000, 3, generator=generator) * torch.tensor([14.0, 10.0, 16.0]) - torch.tensor(
        [7, 5, 2.0]
    )
    model.log_scales = torch.log(0.02 + torch.rand(4000, 3, generator=generator))
    model.quats = torch.randn(4000, 4, generator=generator)
    model.means[17], model.quats[19] = torch.nan, torch.inf
    expected, ours = module._judge(model, space), module._judge_on_device(model, space)
    assert expected[0].max() > 1 and expected[1].any()
    for one, other in zip(ours, expected, strict=True):
        np.testing.assert_array_equal(one, other)
