"""Real spherical harmonics (SH) up to degree 3, with the signs and the order of 3D Gaussian splatting.

The basis is the one of "Efficient Spherical Harmonic Evaluation" (P.-P. Sloan, JCGT 2(2), 2013), its Condon-Shortley
phase included, ordered by degree l, then m = -l..l: the order in which a splat PLY stores its coefficients.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 3

C0 = math.sqrt(1.0 / (4.0 * math.pi))
"""The constant band; a splat's colour is 0.5 + C0 · f_dc plus the higher bands."""
_C1 = math.sqrt(3.0 / (4.0 * math.pi))
_C2 = (
    math.sqrt(15.0 / (4.0 * math.pi)),
    math.sqrt(5.0 / (16.0 * math.pi)),
    math.sqrt(15.0 / (16.0 * math.pi)),
)
_C3 = (
    math.sqrt(35.0 / (32.0 * math.pi)),
    math.sqrt(105.0 / (4.0 * math.pi)),
    math.sqrt(21.0 / (32.0 * math.pi)),
    math.sqrt(7.0 / (16.0 * math.pi)),
    math.sqrt(105.0 / (16.0 * math.pi)),
)
_OFFSET = 0.5
"""3DGS stores colours relative to mid-grey."""
_ROTATION_TOLERANCE = 1e-4
"""Covers a rotation matrix rounded to float32 and multiplied a few times."""
_ROUNDING = 1e-13
"""Weights below this are zero up to rounding."""

_CHUNK_ROWS = 8192
"""Rows multiplied at a time: one product's data fit into the cache."""


def coefficient_count(degree: int) -> int:
    """Number of coefficients per channel up to and including a degree.

    Raises:
        ValueError: if the degree is not in 0..3.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics degree {degree} is not in 0..{MAX_DEGREE}")
    return (degree + 1) ** 2


def sh_basis(degree: int, dirs: Float[Tensor, "n 3"]) -> Float[Tensor, "n k"]:
    """Evaluate the basis functions.

    Args:
        degree: Highest degree, 0..3; k = (degree + 1)².
        dirs: Unit directions.

    Returns:
        Each basis function at each direction.

    Raises:
        ValueError: if the degree is not in 0..3.
    """
    coefficient_count(degree)
    x, y, z = dirs.unbind(-1)  # (n,) each
    columns = [torch.full_like(x, C0)]
    if degree >= 1:
        columns += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        columns += [
            _C2[0] * x * y,
            -_C2[0] * y * z,
            _C2[1] * (2.0 * zz - xx - yy),
            -_C2[0] * x * z,
            _C2[2] * (xx - yy),
        ]
    if degree >= 3:
        columns += [
            -_C3[0] * y * (3.0 * xx - yy),
            _C3[1] * x * y * z,
            -_C3[2] * y * (4.0 * zz - xx - yy),
            _C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -_C3[2] * x * (4.0 * zz - xx - yy),
            _C3[4] * z * (xx - yy),
            -_C3[0] * x * (xx - 3.0 * yy),
        ]
    return torch.stack(columns, dim=-1)


def eval_sh(degree: int, sh: Float[Tensor, "n k 3"], dirs: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Evaluate each Gaussian's SH along its direction; add 0.5 (and clamp at 0) for a colour.

    Args:
        degree: Highest degree to evaluate, at most that of ``sh``.
        sh: Coefficients; the first (degree + 1)² of the k are used.
        dirs: Unit directions from the camera's centre to the Gaussians, world frame.

    Returns:
        Red, green, blue.

    Raises:
        ValueError: if ``degree`` is not in 0..3 or ``sh`` holds fewer bands.
    """
    count = coefficient_count(degree)
    if sh.shape[1] < count:
        raise ValueError(f"degree {degree} needs {count} coefficients a channel, got {sh.shape[1]}")
    basis = sh_basis(degree, dirs)  # (n, count)
    return (basis[:, :, None] * sh[:, :count]).sum(dim=1)


def rotate_sh(sh: Float[Tensor, "n k 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """Coefficients of the same radiance in a rotated world.

    With x_new = rotation @ x_old the result r satisfies ``eval_sh(r, rotation @ d) == eval_sh(sh, d)``. Each band is an
    invariant subspace, so its (2l + 1)² matrix is solved for, exactly up to float64 rounding, from the basis at
    more directions than unknowns.

    Args:
        sh: Coefficients of degree 0..3, k = (degree + 1)².
        rotation: New world from old world, orthonormal with determinant +1.

    Returns:
        Rotated coefficients, in the dtype and on the device of ``sh``.

    Raises:
        ValueError: if k is not (degree + 1)² for a degree in 0..3, or ``rotation`` is not a rotation.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    if coefficient_count(degree) != sh.shape[1]:
        raise ValueError(f"{sh.shape[1]} coefficients a channel are no whole number of bands")
    matrix = check_rotation(rotation)
    dirs = _sample_directions()
    back = (dirs[:, :, None] * matrix).sum(dim=1)  # rows Rᵀ d
    basis, basis_back = sh_basis(degree, dirs), sh_basis(degree, back)
    result = sh.clone()
    for band in range(1, degree + 1):
        columns = slice(band**2, (band + 1) ** 2)
        new_from_old = _least_squares(basis[:, columns], basis_back[:, columns])
        new_from_old[new_from_old.abs() < _ROUNDING] = 0.0  # for quarter turns most weights are zero and are skipped
        result[:, columns] = multiply_rows(new_from_old, sh[:, columns])
    return result


def _least_squares(a: Float[Tensor, "m k"], b: Float[Tensor, "m k"]) -> Float[Tensor, "k k"]:
    """Least-squares solution x of a @ x = b, by the normal equations and Gauss-Jordan elimination.

    Computed in plain Python: MKL's solvers round differently with memory alignment, and a weight of ±1e-17 instead of
    zero changes the sign of a zero in the file. The samples make the equations well conditioned.
    """
    rows, targets = a.tolist(), b.tolist()
    count = a.shape[1]
    system = [
        [math.fsum(row[i] * row[j] for row in rows) for j in range(count)]
        + [math.fsum(row[i] * target[j] for row, target in zip(rows, targets, strict=True)) for j in range(count)]
        for i in range(count)
    ]
    for i in range(count):
        system[i] = [value / system[i][i] for value in system[i]]
        for other in range(count):
            if other != i:
                factor = system[other][i]
                system[other] = [x - factor * y for x, y in zip(system[other], system[i], strict=True)]
    return torch.tensor([row[count:] for row in system], dtype=a.dtype)


def multiply_rows(matrix: Float[Tensor, "i j"], rows: Float[Tensor, "n j ..."]) -> Float[Tensor, "n i ..."]:
    """The matrix times every row, in the rows' dtype; bit-identical for any number of threads, unlike a matmul."""
    result = rows.new_empty((rows.shape[0], matrix.shape[0], *rows.shape[2:]))
    for start in range(0, rows.shape[0], _CHUNK_ROWS):
        part = slice(start, start + _CHUNK_ROWS)
        columns = rows[part].movedim(1, 0).contiguous()
        for i, weights in enumerate(matrix.tolist()):
            product = weights[0] * columns[0]
            for column, weight in zip(columns[1:], weights[1:], strict=True):
                if weight != 0.0:
                    product += weight * column
            result[part, i] = product
    return result


def check_rotation(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Check a rotation; returns it in float64 on the CPU.

    Raises:
        ValueError: if it is not orthonormal with determinant +1.
    """
    matrix = rotation.detach().to(device="cpu", dtype=torch.float64)
    error = (matrix @ matrix.T - torch.eye(3, dtype=torch.float64)).abs().max()
    if not (error < _ROTATION_TOLERANCE and torch.linalg.det(matrix) > 0.0):
        raise ValueError("not a rotation matrix: a mirror, a scale, or not orthonormal")
    return matrix


def rgb_to_dc(rgb: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
    """Constant-band coefficients of a view-independent colour (0..1)."""
    return (rgb - _OFFSET) / C0


def _sample_directions(count: int = 64) -> Float[Tensor, "n 3"]:
    """A Fibonacci lattice on the sphere: even enough for every band up to degree 3 to be well conditioned."""
    index = torch.arange(count, dtype=torch.float64)
    z = 1.0 - (2.0 * index + 1.0) / count
    angle = index * (math.pi * (3.0 - math.sqrt(5.0)))
    radius = torch.sqrt(1.0 - z * z)
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), z], dim=-1)
