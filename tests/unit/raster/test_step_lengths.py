"""Step lengths of Gaussians: the same angle in the photo's camera, wherever they lie."""

from __future__ import annotations

import torch

from splatpipe.pipeline.raster.step_lengths import FarSteps

UNIT = 10.0


def stepped(means: torch.Tensor, step: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
    """Return how far each Gaussian moves for a given step."""
    moved = means.clone()
    with FarSteps((1.0, 2.0, 3.0), UNIT).lengthened(moved, rows):
        moved += step
    return moved - means


def at(*distances: float) -> torch.Tensor:
    return torch.tensor([[1.0, 2.0, 3.0 + distance] for distance in distances])


def test_across_the_ray_a_step_grows_with_the_distance_beyond_the_unit() -> None:
    across = torch.tensor([[0.01, -0.02, 0.0]])
    moved = stepped(at(5.0, 10.0, 40.0), across.repeat(3, 1))
    assert torch.allclose(moved, across * torch.tensor([[1.0], [1.0], [4.0]]), atol=1e-5)


def test_along_the_ray_it_grows_with_its_square_beyond_the_unit() -> None:
    along = torch.tensor([[0.0, 0.0, 0.01]])
    moved = stepped(at(5.0, 10.0, 40.0), along.repeat(3, 1))
    assert torch.allclose(moved, along * torch.tensor([[1.0], [1.0], [16.0]]), atol=2e-4)


def test_rows_that_are_not_stepped_stay_to_the_bit_and_so_does_one_in_the_camera() -> None:
    means = at(20.0, 30.0, 0.0)
    rows = torch.tensor([True, False, True])
    moved = stepped(means, torch.tensor([[0.01, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), rows)
    assert moved[0, 0] > 0.0199 and bool((moved[1:] == 0.0).all())
    assert bool(torch.isfinite(stepped(means, torch.full((3, 3), 0.01))).all())
