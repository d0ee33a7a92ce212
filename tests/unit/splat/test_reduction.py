"""Merging preserves mass, mean and covariance; reducing gives the requested count and the same bits for any input."""

import math

import numpy as np
import pytest
import torch

from splatpipe.pipeline.splat.levels.matching import match_cheapest
from splatpipe.pipeline.splat.levels.merge_costs import COLOUR_WEIGHT, merge_costs
from splatpipe.pipeline.splat.levels.reduction import reduce_to
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.moments import Moments, ellipsoid_areas, merge_pairs, moments_of

KEPT = 1e-5
"""Relative: parameters are float32s, and a covariance is a square of some of them."""


def some_gaussians(count: int = 60, degree: int = 2, seed: int = 1) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    made = Gaussians.empty(count, degree)
    made.means = torch.randn(count, 3, generator=generator)
    made.log_scales = -1.5 + torch.randn(count, 3, generator=generator)
    made.quats = 3.0 * torch.randn(count, 4, generator=generator)
    made.opacity_logits = -2.0 + torch.randn(count, generator=generator)
    made.sh = 0.5 * torch.randn(made.sh.shape, generator=generator)
    return made


def matrices(moments: Moments) -> np.ndarray:
    return moments.covariances[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def test_moments_are_those_of_the_definition() -> None:
    gaussians = some_gaussians(20)
    moments = moments_of(gaussians)
    for i, matrix in enumerate(matrices(moments)):
        w, x, y, z = torch.nn.functional.normalize(gaussians.quats[i], dim=0).double().tolist()
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        scales = np.exp(gaussians.log_scales[i].double().numpy())
        np.testing.assert_allclose(matrix, turn @ np.diag(scales**2) @ turn.T, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(ellipsoid_areas(np.full((1, 3), 2.0)), 16.0 * math.pi, rtol=1e-12)


def test_a_merge_keeps_mass_mean_and_covariance() -> None:
    one, other = some_gaussians(500, seed=2), some_gaussians(500, seed=3)
    merged = merge_pairs(one, other)
    ours, theirs, found = moments_of(one), moments_of(other), moments_of(merged)
    masses = ours.masses() + theirs.masses()
    first, second = ours.masses() / masses, theirs.masses() / masses
    means = first[:, None] * ours.means + second[:, None] * theirs.means
    np.testing.assert_allclose(found.means, means, rtol=KEPT, atol=KEPT)
    expected = np.zeros((500, 3, 3))
    for share, part in ((first, ours), (second, theirs)):
        off = part.means - means
        expected += share[:, None, None] * (matrices(part) + off[:, :, None] * off[:, None, :])
    size = np.trace(expected, axis1=1, axis2=2)[:, None, None]
    kept = matrices(found) / size
    fits = found.opacities < 0.999
    assert fits.sum() > 400
    np.testing.assert_allclose(kept[fits], (expected / size)[fits], atol=KEPT)
    grown = np.trace(kept[~fits], axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(kept[~fits] / grown, (expected / size)[~fits], atol=KEPT)
    assert (grown >= 1.0).all() and (found.masses()[~fits] <= masses[~fits]).all()
    np.testing.assert_allclose(found.masses()[fits], masses[fits], rtol=KEPT)
    colours = first[:, None, None] * one.sh.numpy() + second[:, None, None] * other.sh.numpy()
    np.testing.assert_allclose(merged.sh.numpy(), colours, rtol=1e-4, atol=1e-5)


def test_the_cost_of_a_merge_is_the_divergence_of_shapes_and_the_variance_of_colours() -> None:
    both = some_gaussians(12, degree=1, seed=4)
    moments = moments_of(both)
    merged = moments_of(merge_pairs(both.first(6), both.after(6)))
    pairs = np.stack([np.arange(6), np.arange(6) + 6], axis=1)
    colours = both.sh.reshape(12, -1).numpy()
    costs = merge_costs(moments, colours, pairs, 1e-12)
    for k in range(6):
        mass = moments.masses()[[k, k + 6]]
        share = mass / mass.sum()
        assert mass.sum() < merged.areas[k]  # not held at opaque, which would have made it larger
        logs = [np.linalg.slogdet(matrices(m)[row])[1] for m, row in ((merged, k), (moments, k), (moments, k + 6))]
        shape = 0.5 * (logs[0] - share[0] * logs[1] - share[1] * logs[2])
        mean = share[0] * colours[k] + share[1] * colours[k + 6]
        variance = sum(s * ((colours[row] - mean) ** 2).sum() for s, row in zip(share, (k, k + 6), strict=True))
        assert costs[k] == pytest.approx(shape + COLOUR_WEIGHT * variance, rel=1e-4)


def test_merging_across_a_wall_costs_more_than_merging_within_it() -> None:
    wall = some_gaussians(3, degree=0)
    wall.means[:] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.5]])
    wall.log_scales[:] = torch.log(torch.tensor([1.0, 1.0, 0.01]))
    wall.quats[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    wall.sh[:], wall.opacity_logits[:] = 0.0, 0.0
    beside, behind = merge_costs(moments_of(wall), np.zeros((3, 3), np.float32), np.array([[0, 1], [0, 2]]), 1e-6)
    assert behind > 5.0 * beside


def test_the_matching_is_the_greedy_one() -> None:
    rng = np.random.default_rng(5)
    edges = rng.integers(0, 40, (300, 2))
    edges = edges[edges[:, 0] != edges[:, 1]]
    costs = rng.integers(0, 30, len(edges)).astype(np.float64)
    used: set[int] = set()
    expected = []
    for edge in np.argsort(costs, kind="stable"):
        if not used & set(edges[edge].tolist()):
            used |= set(edges[edge].tolist())
            expected.append(edge)
    assert match_cheapest(edges, costs, 40).tolist() == expected


@pytest.mark.parametrize("count", [1, 2, 7, 59])
def test_the_requested_number_is_left_and_mass_is_kept(count: int) -> None:
    thin = some_gaussians()
    thin.opacity_logits -= 4.0  # none becomes opaque
    reduced = reduce_to(thin, count)
    assert len(reduced) == count
    assert reduced.sh_degree == 2 and bool(reduced.finite().all())
    before, after = moments_of(thin), moments_of(reduced)
    assert after.masses().sum() == pytest.approx(before.masses().sum(), rel=1e-4)
    np.testing.assert_allclose(
        after.masses() @ after.means, before.masses() @ before.means, rtol=1e-3, atol=1e-4 * before.masses().sum()
    )


def test_unmerged_gaussians_are_bit_identical() -> None:
    given = some_gaussians()
    reduced = reduce_to(given, 50)
    kept = {row.tobytes() for row in given.means.numpy()} & {row.tobytes() for row in reduced.means.numpy()}
    assert len(kept) >= 40
    assert reduce_to(given, 60) is given and reduce_to(given, 1000) is given


def test_the_same_gaussians_give_the_same_bits() -> None:
    first, second = (reduce_to(some_gaussians(2000), 300) for _ in range(2))
    assert all(torch.equal(tensor, second.tensors()[name]) for name, tensor in first.tensors().items())


def test_identical_gaussians_merge_first() -> None:
    given = some_gaussians(30)
    twin = given.select(torch.tensor([4]))
    reduced = reduce_to(Gaussians.concat([given, twin]), 30)
    distances = (reduced.means - given.means).abs().max(1).values
    assert bool((distances == 0.0).sum() >= 29)


def degenerate(name: str) -> Gaussians:
    made = some_gaussians(40)
    if name == "one place":
        made.means[:] = 3.0
    elif name == "one line":
        made.means[:, 1:] = 0.0
    elif name == "no size":
        made.log_scales[:] = -math.inf
    elif name == "all transparent":
        made.opacity_logits[:] = -math.inf
    elif name == "all opaque":
        made.opacity_logits[:] = math.inf
    elif name == "enormous":
        made.log_scales[:20] = 300.0
    elif name == "far away":
        made.means[:3] = 1e30
    elif name == "no rotation":
        made.quats[:] = 0.0
    elif name == "the same":
        made = made.select(torch.zeros(40, dtype=torch.int64))
    return made


@pytest.mark.parametrize(
    "name",
    [
        "one place",
        "one line",
        "no size",
        "all transparent",
        "all opaque",
        "enormous",
        "far away",
        "no rotation",
        "the same",
    ],
)
def test_degenerate_input_is_reduced_like_any_other(name: str) -> None:
    for count in (1, 13, 39):
        reduced = reduce_to(degenerate(name), count)
        assert len(reduced) == count
        assert not any(bool(tensor.isnan().any()) for tensor in reduced.tensors().values())


def test_invisible_gaussians_are_removed_first() -> None:
    given = some_gaussians(40)
    given.means[3, 1], given.quats[5, 0], given.sh[7, 0, 0] = math.nan, math.inf, math.nan
    assert bool(reduce_to(given, 39).finite().all())
    assert len(reduce_to(given, 39)) == 37
    with pytest.raises(ValueError, match="no splat"):
        reduce_to(given, 0)
