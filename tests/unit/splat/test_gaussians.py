"""The Gaussians' container and its change of frame."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatpipe.pipeline.splat.model.gaussians import Gaussians, multiply_quats, quat_from_rotation
from splatpipe.pipeline.splat.model.sh import eval_sh


def random_gaussians(n: int, degree: int = 3, seed: int = 0, dtype: torch.dtype = torch.float64) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=dtype)

    return Gaussians(draw(n, 3), draw(n, 3), draw(n, 4), draw(n), draw(n, (degree + 1) ** 2, 3))


def rotation_of(quat: torch.Tensor) -> torch.Tensor:
    """Rotation matrix by turning the axes: v + 2 q × (q × v + w v), independent of the code under test."""
    quat = quat / quat.norm()
    w, q = quat[0], quat[1:]
    axes = torch.eye(3, dtype=quat.dtype)
    turned = [v + 2 * torch.linalg.cross(q, torch.linalg.cross(q, v) + w * v) for v in axes]
    return torch.stack(turned, dim=1)


def covariance(gaussians: Gaussians, i: int) -> torch.Tensor:
    half = rotation_of(gaussians.quats[i]) * torch.exp(gaussians.log_scales[i])
    return half @ half.T


@pytest.mark.parametrize(
    "axis_angle", [(0, 0, 0), (3.14159265, 0, 0), (0, 3.14159265, 0), (0, 0, 3.14159265), (1, -2, 0.5)]
)
def test_quaternion_of_a_matrix_turns_like_it(axis_angle):
    vector = torch.tensor(axis_angle, dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    x, y, z = vector
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    rotation = torch.linalg.matrix_exp(skew)
    torch.testing.assert_close(rotation_of(quat_from_rotation(rotation)), rotation, atol=1e-12, rtol=0)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 3.0])
@pytest.mark.parametrize("off", [0.0, 1e-9])
def test_quaternion_of_a_matrix_has_scipys_bits(size: float, off: float) -> None:
    generator = np.random.default_rng(7)
    turns = Rotation.from_rotvec(size * generator.normal(size=(200, 3))).as_matrix()
    half_turns = np.stack([np.diag([1.0, -1.0, -1.0]), np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])])
    for matrix in np.concatenate([turns, half_turns]) + off * generator.normal(size=(202, 3, 3)):
        x, y, z, w = Rotation.from_matrix(matrix).as_quat(canonical=True)
        assert quat_from_rotation(torch.from_numpy(matrix)).tolist() == [w, x, y, z]


def test_quaternion_product_composes_rotations():
    a, b = torch.randn(2, 4, dtype=torch.float64)
    torch.testing.assert_close(rotation_of(multiply_quats(a, b)), rotation_of(a) @ rotation_of(b))


def test_change_of_frame_transforms_means_covariances_and_colours():
    gaussians = random_gaussians(6)
    rotation, shift, scale = rotation_of(torch.randn(4, dtype=torch.float64)), torch.randn(3, dtype=torch.float64), 2.5
    moved = gaussians.transformed(scale, rotation, shift)
    torch.testing.assert_close(moved.means, scale * gaussians.means @ rotation.T + shift)
    for i in range(6):
        expected = scale**2 * rotation @ covariance(gaussians, i) @ rotation.T
        torch.testing.assert_close(covariance(moved, i), expected)
    dirs = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64), dim=1)
    torch.testing.assert_close(eval_sh(3, moved.sh, dirs @ rotation.T), eval_sh(3, gaussians.sh, dirs))
    torch.testing.assert_close(moved.opacity_logits, gaussians.opacity_logits)


def test_change_of_frame_gives_the_same_bits_for_any_number_of_threads():
    gaussians, rotation = random_gaussians(40_001, dtype=torch.float32), rotation_of(torch.tensor([0.3, 1, -2, 0.7]))
    threads, results = torch.get_num_threads(), []
    try:
        for n in (1, 2, 5):
            torch.set_num_threads(n)
            results.append(gaussians.transformed(1.7, rotation, torch.tensor([1.0, 2.0, 3.0])).tensors())
    finally:
        torch.set_num_threads(threads)
    for result in results[1:]:
        assert all(torch.equal(tensor, results[0][name]) for name, tensor in result.items())


def test_change_of_frame_refuses_a_mirror_and_a_bad_scale():
    gaussians = random_gaussians(1)
    with pytest.raises(ValueError, match="rotation"):
        gaussians.transformed(1.0, -torch.eye(3), torch.zeros(3))
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="scale"):
            gaussians.transformed(scale, torch.eye(3), torch.zeros(3))


def test_selection_and_concatenation_are_inverse():
    gaussians = random_gaussians(10)
    mask = torch.arange(10) % 3 == 0
    again = Gaussians.concat([gaussians.select(mask), gaussians.select(~mask)])
    order = torch.cat([torch.nonzero(mask)[:, 0], torch.nonzero(~mask)[:, 0]])
    for name, tensor in again.tensors().items():
        torch.testing.assert_close(tensor, gaussians.tensors()[name][order], atol=0, rtol=0)
    with pytest.raises(ValueError, match="degree"):
        Gaussians.concat([gaussians, random_gaussians(1, degree=1)])
    with pytest.raises(ValueError, match="degree"):
        Gaussians.concat([])


def test_state_round_trips_through_plain_tensors():
    gaussians = random_gaussians(4, degree=2, dtype=torch.float32)
    again = Gaussians.from_tensors({**gaussians.tensors(), "step": torch.zeros(1)})
    assert (len(again), again.sh_degree) == (4, 2)
    assert again.means is gaussians.means
    assert gaussians.to(dtype=torch.float64).sh.dtype == torch.float64


def test_only_finite_rows_are_called_finite():
    gaussians = random_gaussians(5)
    gaussians.sh[1, 3, 2] = torch.nan
    gaussians.opacity_logits[4] = torch.inf
    assert gaussians.finite().tolist() == [True, False, True, True, False]
    assert Gaussians.empty(0, 3).finite().tolist() == []


def test_shapes_that_do_not_agree_are_refused():
    good = random_gaussians(3).tensors()
    for name, tensor in {"quats": good["quats"][:2], "sh": good["sh"][:, :5]}.items():
        with pytest.raises((ValueError, TypeError)):
            Gaussians.from_tensors({**good, name: tensor})


def test_gradients_reach_every_parameter():
    gaussians = random_gaussians(3).requires_grad_()
    sum(t.square().sum() for t in gaussians.to(dtype=torch.float32).tensors().values()).backward()
    assert all(t.grad is not None and bool(t.grad.abs().sum() > 0) for t in gaussians.tensors().values())
    assert not gaussians.detach().means.requires_grad
