"""The scene: 3D Gaussians with the raw optimised parameters that 3D Gaussian splatting trains and stores."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatpipe.pipeline.splat.model.sh import MAX_DEGREE, check_rotation, coefficient_count, multiply_rows, rotate_sh

PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "sh")
"""The parameters' names, in the order of the fields."""

_ROWS_AT_ONCE = 1 << 16  # torch.isfinite makes a copy
_ORTHONORMAL = 1e-12  # off a rotation's Gramian: SciPy makes what is farther off orthonormal


@dataclass(eq=False)
class Gaussians:
    """n Gaussians. Covariance R(quat) diag(exp(log_scale))² R(quat)ᵀ, opacity sigmoid(opacity_logit).

    Attributes:
        means: Centres, world frame and units.
        log_scales: Natural logarithms of the standard deviations along the Gaussian's own axes, world units.
        quats: World-from-Gaussian rotations (w, x, y, z), not necessarily of unit length.
        opacity_logits: Logits of the opacities.
        sh: Spherical harmonics, k = (degree + 1)² coefficients of red, green and blue; see ``splat.model.sh``.
    """

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    opacity_logits: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logits": (n,)}
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"{name} is {tuple(getattr(self, name).shape)}, not {shape}")
        k = self.sh.shape[1] if self.sh.ndim == 3 else 0
        if tuple(self.sh.shape) != (n, k, 3) or k not in {(d + 1) ** 2 for d in range(MAX_DEGREE + 1)}:
            raise ValueError(f"sh is {tuple(self.sh.shape)}, not ({n}, (degree + 1)², 3) of a degree 0..3")

    @classmethod
    def empty(cls, n: int, sh_degree: int, dtype: torch.dtype = torch.float32) -> Gaussians:
        """n Gaussians at the origin: all zeros, with identity rotations."""
        quats = torch.zeros(n, 4, dtype=dtype)
        quats[:, 0] = 1.0
        zeros = torch.zeros(n, 3, dtype=dtype)
        sh = torch.zeros(n, coefficient_count(sh_degree), 3, dtype=dtype)
        return cls(zeros, zeros.clone(), quats, torch.zeros(n, dtype=dtype), sh)

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Gaussians:
        """The inverse of ``tensors()``; other keys are ignored."""
        return cls(**{name: tensors[name] for name in PARAMETERS})

    def tensors(self) -> dict[str, Tensor]:
        """The parameters by name, not copied."""
        return {name: getattr(self, name) for name in PARAMETERS}

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0..3."""
        return math.isqrt(self.sh.shape[1]) - 1

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Gaussians:
        """The Gaussians on another device or in another dtype; differentiable, shared where nothing changes."""
        return self._map(lambda tensor: tensor.to(device=device, dtype=dtype))

    def detach(self) -> Gaussians:
        """The same values outside any graph, shared."""
        return self._map(torch.Tensor.detach)

    def clone(self) -> Gaussians:
        """A copy, contiguous."""
        return self._map(lambda tensor: tensor.clone(memory_format=torch.contiguous_format))

    def select(self, index: Int[Tensor, " m"] | Bool[Tensor, " n"]) -> Gaussians:
        """The Gaussians of an index or a mask, in its order, copied."""
        return self._map(lambda tensor: tensor[index])

    def first(self, count: int) -> Gaussians:
        """The first ``count`` Gaussians, not copied."""
        return self._map(lambda tensor: tensor[:count])

    def after(self, count: int) -> Gaussians:
        """The Gaussians after the first ``count``, not copied."""
        return self._map(lambda tensor: tensor[count:])

    def pieces(self, rows: int = _ROWS_AT_ONCE) -> Iterator[Gaussians]:
        """Iterate over all Gaussians in views of ``rows`` rows, so that temporaries stay small."""
        for start in range(0, len(self), rows):
            yield self._map(lambda tensor, start=start: tensor[start : start + rows])  # type: ignore[misc]

    @staticmethod
    def gathered(parts: Iterable[Gaussians], like: Gaussians) -> Gaussians:
        """Concatenate pieces without keeping them; at most as many as ``like``, with its SH degree and dtype."""
        found, count = Gaussians.empty(len(like), like.sh_degree, like.means.dtype), 0
        for part in parts:
            for name, tensor in found.tensors().items():
                tensor[count : count + len(part)] = getattr(part, name)
            count += len(part)
        return found.first(count)

    @staticmethod
    def concat(parts: Sequence[Gaussians]) -> Gaussians:
        """Concatenate Gaussians of one SH degree.

        Raises:
            ValueError: if there are none, or their SH degrees differ.
        """
        if not parts or len({part.sh_degree for part in parts}) != 1:
            raise ValueError("concat needs Gaussians of one SH degree")
        return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in PARAMETERS))

    def requires_grad_(self, requires_grad: bool = True) -> Gaussians:
        """Mark every parameter (a leaf) for autograd, in place."""
        for tensor in self.tensors().values():
            tensor.requires_grad_(requires_grad)
        return self

    def finite(self) -> Bool[Tensor, " n"]:
        """Which Gaussians have only finite parameters."""
        finite = torch.ones(len(self), dtype=torch.bool, device=self.means.device)
        for tensor in self.tensors().values():
            for start in range(0, len(self), _ROWS_AT_ONCE):
                rows = slice(start, start + _ROWS_AT_ONCE)
                finite[rows] &= torch.isfinite(tensor.detach()[rows, ..., None]).flatten(1).all(1)
        return finite

    def transformed(self, scale: float, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, " 3"]) -> Gaussians:
        """Transform to another frame, x_new = scale · rotation @ x + translation; means are computed in float64.

        Args:
            scale: New units per unit, > 0.
            rotation: New frame from this one.
            translation: This frame's origin in the new frame, new units.

        Returns:
            New Gaussians that look the same from a camera transformed likewise, SH included.

        Raises:
            ValueError: if the scale is not positive and finite, or ``rotation`` is not a rotation.
        """
        if not (scale > 0.0 and math.isfinite(scale)):
            raise ValueError(f"scale {scale} is not positive")
        matrix = check_rotation(rotation)
        device, dtype = self.means.device, self.means.dtype
        means = multiply_rows(scale * matrix, self.means.to(torch.float64))
        means = means + translation.to(device=device, dtype=torch.float64)
        turn = quat_from_rotation(matrix).to(device=device, dtype=torch.float64)
        quats = multiply_quats(turn, self.quats.to(torch.float64))
        return Gaussians(
            means.to(dtype),
            self.log_scales + math.log(scale),
            quats.to(dtype),
            self.opacity_logits.clone(),
            rotate_sh(self.sh, matrix),
        )

    def _map(self, change: Callable[[Tensor], Tensor]) -> Gaussians:
        return Gaussians(*(change(tensor) for tensor in self.tensors().values()))


def multiply_quats(a: Float[Tensor, "... 4"], b: Float[Tensor, "... 4"]) -> Float[Tensor, "... 4"]:
    """Hamilton product a b, (w, x, y, z): rotation b first, then a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def quat_from_rotation(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 4"]:
    """Unit quaternion (w, x, y, z), w ≥ 0, of a rotation matrix.

    The largest component is found without a difference of near numbers, and the others divided by it: S. W. Shepperd,
    "Quaternion from rotation matrix", Journal of Guidance and Control 1 (1978). SciPy takes the same steps, to the bit,
    but to load it takes half a CPU second; a half-turn and what is not quite orthonormal are left to it.
    """
    matrix = rotation.detach().cpu().double()
    m = matrix.tolist()
    trace = m[0][0] + m[1][1] + m[2][2]
    diagonal = [m[0][0], m[1][1], m[2][2], trace]
    i = diagonal.index(max(diagonal))
    if i == 3:
        quat = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], 1.0 + trace]  # x, y, z, w
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        parts = {i: 1.0 - trace + 2.0 * m[i][i], j: m[j][i] + m[i][j], k: m[k][i] + m[i][k]}
        quat = [parts[0], parts[1], parts[2], m[k][j] - m[j][k]]
    skew = float((matrix @ matrix.T - torch.eye(3, dtype=torch.float64)).abs().max())
    if quat[3] != 0.0 and skew < _ORTHONORMAL:
        x, y, z, w = quat
        length = math.copysign(math.sqrt(x * x + y * y + z * z + w * w), w)
        x, y, z, w = x / length, y / length, z / length, w / length
    else:
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_matrix(matrix.numpy()).as_quat(canonical=True)
    return torch.tensor([w, x, y, z], dtype=rotation.dtype, device=rotation.device)
