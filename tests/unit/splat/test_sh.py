"""Spherical harmonics: the 3DGS basis against its textbook definition, and rotation as a group action."""

import math

import numpy as np
import pytest
import torch

from splatpipe.pipeline.splat.model.sh import C0, eval_sh, rgb_to_dc, rotate_sh, sh_basis

FLOAT64_ATOL = 1e-12  # sums of at most 16 products of order one
FLOAT32_ATOL = 2e-6


def unit_directions(n: int, seed: int = 0) -> torch.Tensor:
    dirs = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return dirs / dirs.norm(dim=1, keepdim=True)


def random_rotation(seed: int) -> torch.Tensor:
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    q = q * torch.sign(torch.diagonal(r))
    return q * torch.sign(torch.linalg.det(q))


def legendre(degree: int, order: int, x: np.ndarray) -> np.ndarray:
    """Associated Legendre function with the Condon-Shortley phase, by its recurrence in the degree."""
    p = np.ones_like(x)
    for i in range(order):
        p = -p * (2 * i + 1) * np.sqrt(1 - x * x)
    if degree == order:
        return p
    previous, current = p, x * (2 * order + 1) * p
    for n in range(order + 2, degree + 1):
        previous, current = current, ((2 * n - 1) * x * current - (n + order - 1) * previous) / (n - order)
    return current


def textbook_basis(dirs: np.ndarray) -> np.ndarray:
    """Y_lm = √2 K P_l^|m|(cos θ) {cos, sin}(|m| φ), l = 0..3, m = -l..l."""
    phi, columns = np.arctan2(dirs[:, 1], dirs[:, 0]), []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            order = abs(m)
            k2 = (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - order) / math.factorial(degree + order)
            turn = np.sin(order * phi) if m < 0 else np.cos(order * phi)
            norm = math.sqrt(k2) * (math.sqrt(2) if m else 1.0)
            columns.append(norm * legendre(degree, order, dirs[:, 2]) * turn)
    return np.stack(columns, axis=1)


def test_basis_is_the_textbook_definition_with_condon_shortley_phase():
    dirs = unit_directions(200)
    np.testing.assert_allclose(sh_basis(3, dirs).numpy(), textbook_basis(dirs.numpy()), atol=FLOAT64_ATOL)


def test_first_bands_have_the_signs_of_splat_files():
    # 3DGS colours: C0 f0 - C1 y f1 + C1 z f2 - C1 x f3
    basis = sh_basis(1, torch.eye(3, dtype=torch.float64))
    c0, c1 = 0.28209479177387814, 0.4886025119029199
    expected = torch.tensor([[c0, 0, 0, -c1], [c0, -c1, 0, 0], [c0, 0, c1, 0]], dtype=torch.float64)
    torch.testing.assert_close(basis, expected, atol=FLOAT64_ATOL, rtol=0)


def test_lower_degree_reads_only_its_bands():
    sh, dirs = torch.randn(5, 16, 3, dtype=torch.float64), unit_directions(5)
    torch.testing.assert_close(eval_sh(2, sh, dirs), eval_sh(2, sh[:, :9], dirs))
    torch.testing.assert_close(eval_sh(0, sh, dirs) + 0.5, C0 * sh[:, 0] + 0.5)


def test_colour_and_constant_band_are_inverse():
    rgb = torch.rand(7, 3, dtype=torch.float64)
    torch.testing.assert_close(eval_sh(0, rgb_to_dc(rgb)[:, None], unit_directions(7)) + 0.5, rgb)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_coefficients_show_the_rotated_radiance(degree):
    sh = torch.randn(40, (degree + 1) ** 2, 3, dtype=torch.float64)
    dirs, rotation = unit_directions(40), random_rotation(3)
    turned = eval_sh(degree, rotate_sh(sh, rotation), dirs @ rotation.T)
    torch.testing.assert_close(turned, eval_sh(degree, sh, dirs), atol=FLOAT64_ATOL, rtol=0)


def test_rotation_is_a_group_action():
    sh, a, b = torch.randn(20, 16, 3, dtype=torch.float64), random_rotation(1), random_rotation(2)
    one_by_one = rotate_sh(rotate_sh(sh, b), a)
    torch.testing.assert_close(one_by_one, rotate_sh(sh, a @ b), atol=1e-11, rtol=0)
    torch.testing.assert_close(rotate_sh(one_by_one, (a @ b).T), sh, atol=1e-11, rtol=0)


def test_rotation_keeps_float32_and_its_input():
    sh = torch.randn(8, 16, 3)
    before = sh.clone()
    turned = rotate_sh(sh, random_rotation(5).float())
    assert turned.dtype == torch.float32
    torch.testing.assert_close(sh, before, atol=0, rtol=0)
    torch.testing.assert_close(
        turned.double(), rotate_sh(sh.double(), random_rotation(5)), atol=FLOAT32_ATOL, rtol=1e-5
    )


def test_invalid_rotations_and_bands_are_refused():
    sh = torch.zeros(1, 16, 3)
    for matrix in (torch.diag(torch.tensor([1.0, 1.0, -1.0])), 2 * torch.eye(3), torch.full((3, 3), torch.nan)):
        with pytest.raises(ValueError, match="rotation"):
            rotate_sh(sh, matrix)
    with pytest.raises(ValueError, match="bands"):
        rotate_sh(torch.zeros(1, 5, 3), torch.eye(3))
    with pytest.raises(ValueError, match="degree 4"):
        eval_sh(4, sh, torch.zeros(1, 3))
    with pytest.raises(ValueError, match="needs 16"):
        eval_sh(3, sh[:, :9], torch.zeros(1, 3))


def test_evaluation_is_differentiable():
    sh = torch.randn(3, 16, 3, dtype=torch.float64, requires_grad=True)
    dirs = unit_directions(3).requires_grad_()
    assert torch.autograd.gradcheck(lambda s, d: eval_sh(3, s, d), (sh, dirs))
