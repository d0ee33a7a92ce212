"""Merging keeps mass, mean and covariance; reducing gives the count asked for, the same bits, and takes any input."""

import math

import numpy as np
import pytest
import torch

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.matching import match_cheapest
from splatpipe.pipeline.splat.merge_costs import merge_costs
from splatpipe.pipeline.splat.moments import Moments, ellipsoid_areas, merge_pairs, moments_of
from splatpipe.pipeline.splat.reduction import reduce_to

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
    np.testing.assert_allclose(matrices(found) / size, expected / size, atol=KEPT)
    fits = masses < 0.999 * found.areas
    assert fits.sum() > 400
    np.testing.assert_allclose(found.masses()[fits], masses[fits], rtol=KEPT)
    assert (found.opacities[~fits] > 0.99).all()
    colours = first[:, None, None] * one.sh.numpy() + second[:, None, None] * other.sh.numpy()
    np.testing.assert_allclose(merged.sh.numpy(), colours, rtol=1e-4, atol=1e-5)


def test_what_a_merge_costs_is_the_integral_over_the_pictures() -> None:
    one, other = some_gaussians(6, degree=0, seed=4), some_gaussians(6, degree=0, seed=5)
    both, merged = Gaussians.concat([one, other]), moments_of(merge_pairs(one, other))
    pairs = np.stack([np.arange(6), np.arange(6) + 6], axis=1)
    costs = merge_costs(moments_of(both), both.sh.reshape(12, 3).numpy(), pairs, 0.0)
    merged_sh = merge_pairs(one, other).sh.numpy()
    step = 0.04
    grid = np.stack(np.meshgrid(np.arange(-8.0, 8.0, step), np.arange(-8.0, 8.0, step)), axis=-1)
    for k in range(6):
        total = 0.0
        for kept in ([0, 1], [0, 2], [1, 2]):
            seen = 0.0
            for moments, sh, row, sign in (
                (moments_of(both), both.sh.numpy(), k, 1.0),
                (moments_of(both), both.sh.numpy(), k + 6, 1.0),
                (merged, merged_sh, k, -1.0),
            ):
                off = grid - moments.means[row, kept]
                inverse = np.linalg.inv(matrices(moments)[row][np.ix_(kept, kept)])
                height = moments.opacities[row] * np.exp(-0.5 * np.einsum("...a,ab,...b", off, inverse, off))
                colour = np.append(sh[row, 0] * 0.28209479177387814, 0.5)  # its cover against what lies behind
                seen = seen + sign * height[..., None] * colour
            total += float((seen**2).sum()) * step * step
        assert costs[k] == pytest.approx(total, rel=0.02)


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
def test_as_many_are_left_as_were_asked_for_and_their_mass_is_kept(count: int) -> None:
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


def test_those_that_did_not_merge_stay_to_the_bit() -> None:
    given = some_gaussians()
    reduced = reduce_to(given, 50)
    kept = {row.tobytes() for row in given.means.numpy()} & {row.tobytes() for row in reduced.means.numpy()}
    assert len(kept) >= 40
    assert reduce_to(given, 60) is given and reduce_to(given, 1000) is given


def test_the_same_gaussians_give_the_same_bits() -> None:
    first, second = (reduce_to(some_gaussians(2000), 300) for _ in range(2))
    assert all(torch.equal(tensor, second.tensors()[name]) for name, tensor in first.tensors().items())


def test_two_that_are_one_merge_before_all_others() -> None:
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
def test_degenerate_input_is_reduced_as_any_other(name: str) -> None:
    for count in (1, 13, 39):
        reduced = reduce_to(degenerate(name), count)
        assert len(reduced) == count
        assert not any(bool(tensor.isnan().any()) for tensor in reduced.tensors().values())


def test_what_nobody_draws_goes_first() -> None:
    given = some_gaussians(40)
    given.means[3, 1], given.quats[5, 0], given.sh[7, 0, 0] = math.nan, math.inf, math.nan
    assert bool(reduce_to(given, 39).finite().all())
    assert len(reduce_to(given, 39)) == 37
    with pytest.raises(ValueError, match="no splat"):
        reduce_to(given, 0)
