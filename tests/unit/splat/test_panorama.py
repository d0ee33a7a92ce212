"""The panorama behind a scene: colours by direction, gradients, the horizon, and its file."""

from pathlib import Path

import numpy as np
import pytest
import skies
import torch

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.splat.sky.panorama import (
    COLUMNS,
    ROWS,
    Panorama,
    cells_of,
    composite_over,
    read_panorama,
    write_panorama,
)
from splatpipe.pipeline.splat.sky.sky_mask import directions, elevations_deg

TILTED = np.array([0.36, -0.48, 0.8])
BLACK = (0.0, 0.0, 0.0)


def random_panorama(dtype: torch.dtype = torch.float32) -> Panorama:
    colours = torch.rand(ROWS * COLUMNS, 3, generator=torch.Generator().manual_seed(1), dtype=dtype)
    return Panorama(TILTED, colours.requires_grad_())


def test_every_direction_mixes_four_neighbouring_cells() -> None:
    rays = np.random.default_rng(0).normal(size=(500, 3))
    cells, weights = cells_of(rays, TILTED)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    assert weights.min() >= 0.0 and cells.min() >= 0 and cells.max() < ROWS * COLUMNS
    assert np.ptp(cells // COLUMNS, axis=1).max() <= 1
    steps = np.ptp(cells % COLUMNS, axis=1)
    assert set(steps.tolist()) <= {1, COLUMNS - 1}  # around the back the last column meets the first


def test_colours_by_elevation_appear_at_their_elevation() -> None:
    rows = (np.arange(ROWS) + 0.5) / ROWS * 180.0 - 90.0
    colours = np.repeat(rows / 90.0, COLUMNS)[:, None].repeat(3, axis=1).astype(np.float32)
    camera = skies.camera_towards(pitch_deg=30.0, roll_deg=25.0)
    seen = Panorama(skies.UP, torch.from_numpy(colours)).behind(camera, BLACK).numpy()
    elevation = elevations_deg(camera, skies.UP)
    inner = (elevation > 0.0) & (elevation < 80.0)
    assert np.abs(seen[:, :, 1] - elevation / 90.0)[inner].max() < 2e-3


def test_colours_do_not_depend_on_the_photo_but_on_the_direction() -> None:
    panorama = random_panorama()
    camera = skies.camera_towards(heading_deg=170.0, pitch_deg=20.0)
    every_pixel = panorama.at(directions(camera)).detach().numpy()
    looked_up = panorama.behind(camera, BLACK).detach().numpy()
    np.testing.assert_allclose(looked_up[::8, ::8], every_pixel[::8, ::8], atol=2e-6)  # above TILTED's horizon
    turned = skies.camera_towards(heading_deg=170.0, pitch_deg=20.0, roll_deg=180.0, x=5.0)
    np.testing.assert_allclose(panorama.at(directions(turned)).detach().numpy(), every_pixel[::-1, ::-1], atol=1e-5)


def test_well_below_the_horizon_the_background_is_kept() -> None:
    panorama = Panorama(skies.UP, torch.full((ROWS * COLUMNS, 3), 0.75))
    camera = skies.camera_towards(pitch_deg=0.0)
    seen = panorama.behind(camera, (0.25, 0.0, 1.0)).numpy()
    elevation = elevations_deg(camera, skies.UP)
    np.testing.assert_allclose(seen[elevation > 0.0], 0.75, atol=1e-6)
    low = seen[elevation < -9.0]
    np.testing.assert_allclose(low, np.broadcast_to([0.25, 0.0, 1.0], low.shape), atol=1e-6)


def test_gradient_by_the_cells_is_that_of_finite_differences() -> None:
    panorama = random_panorama(torch.float64)
    camera = skies.camera_towards(heading_deg=90.0, pitch_deg=10.0)
    generator = torch.Generator().manual_seed(2)
    weight = torch.rand(skies.HEIGHT, skies.WIDTH, 3, generator=generator, dtype=torch.float64)
    (weight * panorama.behind(camera, BLACK).square()).sum().backward()
    gradient = panorama.colours.grad
    assert gradient is not None
    way = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)

    def value(step: float) -> float:
        moved = Panorama(TILTED, panorama.colours.detach() + step * way)
        return float((weight * moved.behind(camera, BLACK).square()).sum())

    assert (value(1e-4) - value(-1e-4)) / 2e-4 == pytest.approx(float((gradient * way).sum()), rel=1e-6)


def test_render_over_another_background_is_a_render_laid_over_it() -> None:
    generator = torch.Generator().manual_seed(3)
    alpha, own, behind = (torch.rand(4, 5, *rest, generator=generator) for rest in ((), (3,), (3,)))
    old = (0.2, 0.9, 0.4)
    over_old = alpha[:, :, None] * own + (1.0 - alpha)[:, :, None] * torch.tensor(old)
    expected = alpha[:, :, None] * own + (1.0 - alpha)[:, :, None] * behind
    torch.testing.assert_close(composite_over(over_old, alpha, old, behind), expected)


def test_file_comes_back_and_is_the_same_each_time(tmp_path: Path) -> None:
    panorama = random_panorama()
    for name in ("a.npz", "b.npz"):
        write_panorama(tmp_path / name, panorama)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    back = read_panorama(tmp_path / "a.npz")
    assert back is not None
    np.testing.assert_array_equal(back.up, TILTED)
    assert torch.equal(back.colours, panorama.colours.detach())
    write_panorama(tmp_path / "none.npz", None)
    assert read_panorama(tmp_path / "none.npz") is None


def test_broken_files_are_refused_with_a_hint(tmp_path: Path) -> None:
    whole = tmp_path / "whole.npz"
    write_panorama(whole, random_panorama())
    np.savez(tmp_path / "nan.npz", up=TILTED, colours=np.full((ROWS * COLUMNS, 3), np.nan, np.float32))
    np.savez(tmp_path / "pole.npz", up=np.zeros(3), colours=np.zeros((ROWS * COLUMNS, 3), np.float32))
    np.savez(tmp_path / "small.npz", up=TILTED, colours=np.zeros((7, 3), np.float32))
    np.savez(tmp_path / "objects.npz", up=TILTED, colours=np.array([{}], object))
    with (tmp_path / "lone.npz").open("wb") as file:
        np.save(file, TILTED)
    foreign = whole.read_bytes()
    for name, at, byte in (("packed", 10, 99), ("secret", 8, 1), ("later", 6, 200)):  # of zip's central directory
        at += foreign.index(b"PK\x01\x02")
        (tmp_path / f"{name}.npz").write_bytes(foreign[:at] + bytes([byte]) + foreign[at + 1 :])
    header = foreign.index(b"}", foreign.index(b"NUMPY"))
    (tmp_path / "header.npz").write_bytes(foreign[:header] + b"(" + foreign[header + 1 :])
    (tmp_path / "half.npz").write_bytes(whole.read_bytes()[:1000])
    (tmp_path / "large.npz").write_bytes(whole.read_bytes() + bytes(2_000_000))
    arrays, files = (
        ("nan", "pole", "small", "objects", "lone"),
        ("half", "large", "packed", "secret", "later", "header"),
    )
    for name in (*arrays, *files, "missing"):
        with pytest.raises(StageError, match="sky") as raised:
            read_panorama(tmp_path / f"{name}.npz")
        assert raised.value.hint
