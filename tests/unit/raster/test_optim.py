"""The fused Adam against torch's, and its state as density control reshapes it."""

import functools
import math
import weakref

import pytest
import torch

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.optim import Adam, sh_rates

# Relative to the size of a step: rounding of float32 in another order of the same operations, over 30 steps.
STEP_RTOL = 3e-5
SHAPES = {"means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "sh": (16, 3)}
RATES = {"means": 1.6e-4, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2}


def parameters(n: int, coefficients: int = 16) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(n)
    shapes = SHAPES | {"sh": (coefficients, 3)}
    return {name: torch.randn(n, *shape, generator=generator).requires_grad_() for name, shape in shapes.items()}


def set_gradients(tensors: dict[str, torch.Tensor], step: int) -> None:
    """Set gradients of all magnitudes, reproducible for a step."""
    generator = torch.Generator().manual_seed(1000 + step)
    for tensor in tensors.values():
        scale = 10.0 ** torch.randint(-12, 2, (1,), generator=generator)
        tensor.grad = (scale * torch.randn(tensor.shape, generator=generator)).to(tensor.dtype)


def rates(coefficients: int = 16) -> dict[str, float | torch.Tensor]:
    return RATES | {"sh": sh_rates(coefficients, 2.5e-3, 2.5e-3 / 20)}


@functools.cache
def torch_adam(n: int, coefficients: int, steps: int) -> dict[str, torch.Tensor]:
    """torch.optim.Adam in float64; the bands of sh as two groups, as 3DGS has them."""
    tensors = parameters(n, coefficients)
    leaves = {name: tensor.detach().double().requires_grad_() for name, tensor in tensors.items()}
    dc = leaves["sh"][:, :1].detach().clone().requires_grad_()
    rest = leaves["sh"][:, 1:].detach().clone().requires_grad_()
    groups = [{"params": [leaves[name]], "lr": rate} for name, rate in RATES.items()]
    groups += [{"params": [dc], "lr": 2.5e-3}, {"params": [rest], "lr": 2.5e-3 / 20}]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    for step in range(steps):
        set_gradients(leaves, step)
        dc.grad, rest.grad = leaves["sh"].grad[:, :1], leaves["sh"].grad[:, 1:]
        optimizer.step()
    return {name: leaf.detach() for name, leaf in leaves.items()} | {"sh": torch.cat([dc, rest], 1).detach()}


def snapshot(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("n", [1, 16, 37, 600])
def test_all_visible_is_torchs_adam(isa, n, coefficients):
    tensors = parameters(n, coefficients)
    start, expected = snapshot(tensors), torch_adam(n, coefficients, 30)
    optimizer = Adam(tensors)
    for step in range(30):
        set_gradients(tensors, step)
        optimizer.step(tensors, rates(coefficients))
    assert optimizer.take_skipped() == 0
    for name, tensor in tensors.items():
        moved = (expected[name] - start[name]).abs().max()
        error = (tensor.detach() - expected[name]).abs().max()
        # the sum itself is rounded to float32 at every step
        assert error <= STEP_RTOL * moved + 30 * 2**-24 * start[name].abs().max(), name


def test_first_step_is_the_learning_rate_against_the_sign():
    tensors = {"a": torch.zeros(5, 2, requires_grad=True)}
    tensors["a"].grad = torch.tensor([[1.0, -1e-6]] * 5)
    Adam(tensors).step(tensors, {"a": torch.tensor([0.1, 0.2])})
    torch.testing.assert_close(tensors["a"].detach(), torch.tensor([[-0.1, 0.2]] * 5))


@pytest.mark.parametrize("n", [5, 64, 300])
def test_unseen_rows_keep_values_and_moments_and_seen_ones_step_alike(isa, n):
    dense, sparse = parameters(n), parameters(n)
    optimizers = Adam(dense), Adam(sparse)
    visible = torch.arange(n) % 3 != 1
    visible[32:48] = False
    for step in range(3):
        for tensors, optimizer, mask in zip((dense, sparse), optimizers, (None, visible), strict=True):
            set_gradients(tensors, step)
            optimizer.step(tensors, rates(), mask)
    start = parameters(n)
    for name in SHAPES:
        torch.testing.assert_close(sparse[name][~visible], start[name][~visible], atol=0, rtol=0)
        torch.testing.assert_close(sparse[name][visible], dense[name][visible], atol=0, rtol=0)
        assert not optimizers[1].mean[name][~visible].any()
        torch.testing.assert_close(optimizers[1].square[name][visible], optimizers[0].square[name][visible])


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_row_with_a_gradient_that_is_not_finite_is_left_out_and_counted(isa, bad):
    tensors = parameters(50)
    before, optimizer = snapshot(tensors), Adam(tensors)
    set_gradients(tensors, 0)
    tensors["sh"].grad[3, 15, 2] = bad
    tensors["opacity_logits"].grad[49] = bad
    tensors["means"].grad[20, 0] = bad
    visible = torch.ones(50, dtype=torch.bool)
    visible[20] = False  # not seen, so not counted either
    optimizer.step(tensors, rates(), visible)
    assert optimizer.take_skipped() == 2
    assert optimizer.take_skipped() == 0
    left = torch.tensor([3, 20, 49])
    for name, tensor in tensors.items():
        torch.testing.assert_close(tensor[left].detach(), before[name][left], atol=0, rtol=0)
        assert not optimizer.mean[name][left].any()
        assert bool(torch.isfinite(tensor).all() and torch.isfinite(optimizer.square[name]).all())
        assert bool((tensor[:3] != before[name][:3]).any())


def test_same_bits_for_any_number_of_threads(isa):
    results = []
    visible = torch.rand(3000) > 0.5
    for threads in (1, 2, 5):
        _native.set_threads(threads)
        tensors = parameters(3000)
        optimizer = Adam(tensors)
        for step in range(2):
            set_gradients(tensors, step)
            optimizer.step(tensors, rates(), visible)
        results.append(snapshot(tensors))
    for name in SHAPES:
        assert all(torch.equal(result[name], results[0][name]) for result in results)


def test_parameter_without_gradient_is_left_alone():
    tensors = parameters(10)
    set_gradients(tensors, 0)
    tensors["quats"].grad = None
    before = snapshot(tensors)
    Adam(tensors).step(tensors, rates())
    assert torch.equal(tensors["quats"], before["quats"])
    assert not torch.equal(tensors["means"], before["means"])


def test_state_follows_density_control():
    tensors = parameters(8)
    optimizer = Adam(tensors)
    set_gradients(tensors, 0)
    optimizer.step(tensors, rates())
    mean = snapshot(optimizer.mean)
    optimizer.select(torch.tensor([7, 2, 2]))
    optimizer.append(2)
    assert len(optimizer) == 5
    for name in SHAPES:
        torch.testing.assert_close(optimizer.mean[name][:3], mean[name][[7, 2, 2]])
        assert not optimizer.square[name][3:].any()
    optimizer.zero_state(torch.tensor([True, False, False, False, False]), ["means"])
    assert not optimizer.mean["means"][0].any()
    assert optimizer.mean["means"][1].any()
    assert optimizer.mean["quats"][0].any()
    optimizer.zero_state(names=["opacity_logits"])
    assert not optimizer.square["opacity_logits"].any()
    optimizer.select(torch.zeros(5, dtype=torch.bool))
    assert len(optimizer) == 0
    optimizer.step({name: t[:0].detach() for name, t in tensors.items()}, rates())
    assert optimizer.take_skipped() == 0


def test_restored_state_continues_with_the_same_bits():
    straight, resumed = parameters(40), parameters(40)
    optimizer, first = Adam(straight), Adam(resumed)
    for step in range(6):
        set_gradients(straight, step)
        optimizer.step(straight, rates())
    for step in range(3):
        set_gradients(resumed, step)
        first.step(resumed, rates())
    second = Adam(parameters(1))
    second.load_state_dict({name: tensor.clone() for name, tensor in first.state_dict().items()})
    for step in range(3, 6):
        set_gradients(resumed, step)
        second.step(resumed, rates())
    assert second.step_count == 6
    assert all(torch.equal(straight[name], resumed[name]) for name in SHAPES)


def test_state_of_other_parameters_is_refused():
    optimizer = Adam(parameters(4))
    with pytest.raises(ValueError, match="sh"):
        optimizer.load_state_dict(Adam(parameters(4, coefficients=4)).state_dict())
    state = optimizer.state_dict()
    with pytest.raises(ValueError, match="rows"):
        optimizer.load_state_dict(state | {"mean.means": torch.zeros(5, 3)})
    del state["step"]
    with pytest.raises(ValueError, match="step"):
        optimizer.load_state_dict(state)


def test_parameters_that_cannot_be_stepped_in_place_are_refused():
    tensors = parameters(6)
    set_gradients(tensors, 0)
    optimizer = Adam(tensors)
    with pytest.raises(ValueError, match="not those"):
        optimizer.step({"means": tensors["means"]}, rates())
    wrong = {
        "more rows": parameters(7)["means"],
        "float64": tensors["means"].detach().double(),
        "strided": torch.zeros(6, 6)[:, ::2],
    }
    for means in wrong.values():
        means.requires_grad_().grad = torch.zeros_like(means)
        with pytest.raises(ValueError, match="means"):
            optimizer.step(tensors | {"means": means}, rates())
    with pytest.raises((ValueError, TypeError)):
        optimizer.step(tensors, rates(), torch.ones(5, dtype=torch.bool))
    assert optimizer.step_count == 0
    with pytest.raises(ValueError, match="rows"):
        Adam({"a": torch.zeros(3), "b": torch.zeros(4)})
    with pytest.raises(ValueError, match="betas"):
        Adam({}, betas=(0.9, 1.0))


def test_moments_are_loaded_one_after_the_other() -> None:
    class Watched(torch.Tensor):
        def to(self, *arguments: object, **named: object) -> torch.Tensor:
            found.append([reference() is None for reference in old].count(True))
            return self.as_subclass(torch.Tensor).clone()

    found: list[int] = []
    optimizer = Adam(parameters(5))
    state = {name: tensor + 1.0 for name, tensor in optimizer.state_dict().items() if tensor.ndim}
    given = {name: tensor.as_subclass(Watched) for name, tensor in state.items()} | {"step": torch.tensor(3)}
    old = [weakref.ref(tensor) for moments in (optimizer.mean, optimizer.square) for tensor in moments.values()]
    optimizer.load_state_dict(given)
    assert found == list(range(1, len(old) + 1))  # each is freed before its successor is loaded
    assert all(torch.equal(tensor, state[name]) for name, tensor in optimizer.state_dict().items() if tensor.ndim)
    assert optimizer.step_count == 3
