"""Density control: which Gaussians are cloned, split, pruned and held back, and reproducible random numbers."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.densify import (
    grow,
    half_opacity,
    prune_mask,
    reset_opacity,
    room_at,
)
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.random_numbers import normal, permutation, uniform

SCHEDULE = replace(resolve_schedule(TrainConfig()).density, reset_every=100)
EXTENT = 10.0  # so that sizes above 0.1 are split, and above 1 pruned


def model(sizes: list[float]) -> Gaussians:
    gaussians = Gaussians.empty(len(sizes), 0)
    gaussians.log_scales = torch.tensor(sizes).log()[:, None].repeat(1, 3)
    gaussians.means = torch.arange(3.0 * len(sizes)).reshape(-1, 3)
    return gaussians


def test_small_gaussians_are_cloned_and_large_ones_split() -> None:
    gaussians = model([0.05, 0.5, 0.05, 0.5])
    growth, counts = grow(gaussians, torch.tensor([1.0, 1.0, 0.0, 0.0]), 10, SCHEDULE, EXTENT, 7)
    assert counts == {"cloned": 1, "split": 1, "held_back": 0}
    assert growth.source.tolist() == [0, 2, 3, 0, 1, 1]
    assert growth.fresh.tolist() == [False, False, False, True, True, True]
    assert torch.equal(growth.means[3], gaussians.means[0])
    torch.testing.assert_close(growth.log_scales[4:].exp(), torch.full((2, 3), 0.5 / 1.6))
    assert not torch.equal(growth.means[4], growth.means[5])
    assert ((growth.means[4:] - gaussians.means[1]).abs() < 5 * 0.5).all()


def test_children_of_a_split_are_drawn_from_their_parent() -> None:
    gaussians = model([1.0] * 4000)
    gaussians.means.zero_()
    gaussians.log_scales[:] = torch.tensor([4.0, 1.0, 0.25]).log()
    half = math.radians(30.0) / 2.0
    gaussians.quats[:] = 3.0 * torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)])
    growth, _ = grow(gaussians, torch.ones(4000), 4000, SCHEDULE, EXTENT, 1)
    c, s = math.cos(2 * half), math.sin(2 * half)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    expected = turn @ np.diag([16.0, 1.0, 0.0625]) @ turn.T
    # 8000 draws: a covariance entry is known to 1.6 % of its scale, so 8 % is five sigma.
    np.testing.assert_allclose(np.cov(growth.means.numpy().T), expected, atol=0.08 * 16)
    assert growth.means.mean(dim=0).abs().max() < 0.25


def test_the_largest_scores_come_first_and_the_rest_is_counted() -> None:
    score = torch.tensor([0.1, 0.5, 0.3, 0.5, 0.0])
    growth, counts = grow(model([0.05] * 5), score, 2, SCHEDULE, EXTENT, 1)
    assert growth.source.tolist() == [0, 1, 2, 3, 4, 1, 3]
    assert counts == {"cloned": 2, "split": 0, "held_back": 2}
    _, counts = grow(model([0.05] * 9), torch.ones(9), -3, SCHEDULE, EXTENT, 1)
    assert counts == {"cloned": 0, "split": 0, "held_back": 9}


def test_both_halves_together_transmit_as_much_light_as_their_parent() -> None:
    gaussians = model([0.05, 0.5, 0.5])
    gaussians.opacity_logits[:] = torch.tensor([2.0, -4.0, 1.0])
    growth, _ = grow(gaussians, torch.tensor([1.0, 1.0, 0.0]), 9, SCHEDULE, EXTENT, 1)
    assert growth.source.tolist() == [0, 2, 0, 1, 1]
    before, after = 1.0 - torch.sigmoid(gaussians.opacity_logits), 1.0 - torch.sigmoid(growth.opacity_logits)
    torch.testing.assert_close(after[0] * after[2], before[0])
    torch.testing.assert_close(after[3] * after[4], before[1])
    assert growth.opacity_logits[1] == gaussians.opacity_logits[2]


def test_gaussians_that_would_be_pruned_once_halved_are_not_densified() -> None:
    gaussians = model([0.05, 0.5, 0.05, 0.5])
    gaussians.opacity_logits[:] = torch.logit(torch.tensor([0.0099, 0.0099, 0.0101, 0.0101]))
    growth, counts = grow(gaussians, torch.ones(4), 9, SCHEDULE, EXTENT, 1)
    assert counts == {"cloned": 1, "split": 1, "held_back": 0} and growth.source.tolist() == [0, 1, 2, 2, 3, 3]
    grown = gaussians.select(growth.source)
    grown.opacity_logits = growth.opacity_logits
    assert not prune_mask(grown, SCHEDULE, EXTENT, 50, torch.zeros(6)).any()
    unlimited = replace(SCHEDULE, prune_opacity=0.0)
    assert grow(gaussians, torch.ones(4), 9, unlimited, EXTENT, 1)[1] == {"cloned": 2, "split": 2, "held_back": 0}


def test_halved_opacity_stays_finite_in_float32() -> None:
    halved = half_opacity(torch.tensor([-1000.0, -210.0, 210.0, 1000.0]))
    torch.testing.assert_close(halved, torch.tensor([-1000.0 - math.log(2.0), -210.0 - math.log(2.0), 105.0, 500.0]))


@pytest.mark.parametrize("logit", [-80.0, -20.0, 0.0, 9.0, 80.0])
def test_halved_opacity_is_exact_for_any_logit(logit: float) -> None:
    halved = float(half_opacity(torch.tensor([logit], dtype=torch.float64)))
    alpha, through = 1.0 / (1.0 + math.exp(-logit)), math.exp(-0.5 * math.log1p(math.exp(logit)))
    assert halved == pytest.approx(math.log(alpha) - math.log1p(through) - math.log(through), rel=1e-9)


def test_the_number_of_gaussians_rises_to_the_cap_fast_at_first() -> None:
    schedule = resolve_schedule(
        TrainConfig(iterations=4000, max_gaussians=1000)
    ).density  # steps at 500, 600, ..., 2000
    steps = [room_at(schedule, 100, step) for step in range(500, 2001, 100)]
    assert steps[-1] == 1000 and steps[7] == 775  # half of the steps done: three quarters of the growth
    growth = [after - before for before, after in pairwise([100, *steps])]
    assert all(earlier >= later - 1 for earlier, later in pairwise(growth)) and growth[0] > 15 * growth[-1]
    assert room_at(schedule, 100, 400) == 100 and room_at(schedule, 5000, 1000) == 1000
    assert room_at(replace(schedule, on=False), 100, 1000) == 100
    never = replace(schedule, last=400)  # ends before it begins
    assert [room_at(never, 100, iteration) for iteration in (1, 400, 500, 4000)] == [100] * 4


def test_transparent_huge_and_broken_gaussians_are_pruned() -> None:
    gaussians = model([0.5, 0.5, 2.0, 0.5, 0.5])
    gaussians.opacity_logits[1] = math.log(0.004 / 0.996)
    gaussians.means[3, 1] = math.nan
    radii = torch.tensor([0.0, 0.0, 0.0, 0.0, 50.0])
    assert prune_mask(gaussians, SCHEDULE, EXTENT, 200, radii).tolist() == [False, True, True, True, False]
    assert prune_mask(gaussians, SCHEDULE, EXTENT, 50, radii).tolist() == [False, True, False, True, False]
    on_screen = replace(SCHEDULE, prune_screen_px=20.0)
    assert prune_mask(gaussians, on_screen, EXTENT, 200, radii).tolist() == [False, True, True, True, True]


def test_the_last_gaussian_is_never_pruned() -> None:
    gaussians = model([0.5, 0.5])
    gaussians.opacity_logits[:] = torch.tensor([-20.0, -19.0])
    assert prune_mask(gaussians, SCHEDULE, EXTENT, 50, torch.zeros(2)).tolist() == [True, False]


def test_published_schedule_of_density_control() -> None:
    schedule = resolve_schedule(TrainConfig(density="published")).density
    steps = [i for i in range(1, 30_001) if schedule.is_step(i)]
    assert (steps[0], steps[1], steps[-1]) == (500, 600, 15_000)
    resets = [i for i in range(1, 30_001) if schedule.is_reset(i)]
    assert resets == [3000, 6000, 9000, 12_000]
    ours = resolve_schedule(TrainConfig()).density
    assert not any(ours.is_reset(i) for i in range(1, 30_001))


def test_opacity_reset_lowers_only_what_is_above() -> None:
    logits = torch.tensor([2.0, -9.0])
    reset_opacity(logits, 0.01)
    torch.testing.assert_close(torch.sigmoid(logits), torch.tensor([0.01, 1.0 / (1.0 + math.exp(9.0))]))


def test_random_numbers_depend_on_their_key_alone() -> None:
    everything = uniform(3, 100, 2, np.arange(1000))
    np.testing.assert_array_equal(uniform(3, 100, 2, [5, 999]), everything[[5, 999]])
    for other in (
        uniform(4, 100, 2, np.arange(1000)),
        uniform(3, 101, 2, np.arange(1000)),
        uniform(3, 100, 1, np.arange(1000)),
    ):
        assert not (other == everything).any()
        assert abs(np.corrcoef(other, everything)[0, 1]) < 0.15  # 1000 pairs: σ is 0.032


def test_random_numbers_have_their_distribution() -> None:
    flat = np.sort(uniform(0, 1, 1, np.arange(20_000)))
    assert np.abs(flat - (np.arange(20_000) + 0.5) / 20_000).max() < 1.63 / math.sqrt(20_000)  # Kolmogorov, 1 %
    bell = normal(0, 1, 1, np.arange(20_000))
    assert abs(bell.mean()) < 0.03 and abs(bell.std() - 1.0) < 0.02 and abs((bell**4).mean() - 3.0) < 0.3


@pytest.mark.parametrize("count", [1, 2, 37])
def test_every_epoch_sees_every_photo_once_in_its_own_order(count: int) -> None:
    orders = [tuple(permutation(0, epoch, count)) for epoch in range(3)]
    assert all(sorted(order) == list(range(count)) for order in orders)
    assert count < 5 or len(set(orders)) == 3
