"""SPZ: what the file says, read by the letter of its specification, is what was written."""

import gzip
import math
import struct

import numpy as np
import pytest
import torch

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.spz import spz_bytes

QUARTER_TURN = math.sqrt(0.5)


def some_gaussians(count: int = 40, degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    made = Gaussians.empty(count, degree)
    made.means = 20.0 * torch.randn(count, 3, generator=generator)
    made.log_scales = -3.0 + torch.randn(count, 3, generator=generator)
    made.quats = torch.randn(count, 4, generator=generator)
    made.opacity_logits = 2.0 * torch.randn(count, generator=generator)
    made.sh = 0.3 * torch.randn(made.sh.shape, generator=generator)
    return made


def read(data: bytes) -> tuple[dict[str, int], dict[str, np.ndarray]]:
    """One number after another, as the specification's README says."""
    raw = gzip.decompress(data)
    magic, version, count, degree, bits, flags, _ = struct.unpack_from("<IIIBBBB", raw)
    assert magic == 0x5053474E
    terms = (degree + 1) ** 2 - 1
    sizes = {"means": 9, "alpha": 1, "colour": 3, "scale": 3, "quat": 3 if version == 2 else 4, "sh": 3 * terms}
    assert len(raw) == 16 + count * sum(sizes.values())
    arrays, at = {}, 16
    for name, size in sizes.items():
        block = raw[at : at + count * size]
        at += len(block)
        arrays[name] = [block[i * size : (i + 1) * size] for i in range(count)]
    found = {
        "means": np.array(
            [
                [int.from_bytes(m[i : i + 3], "little", signed=True) / 2**bits for i in (0, 3, 6)]
                for m in arrays["means"]
            ]
        ),
        "alpha": np.array([a[0] / 255.0 for a in arrays["alpha"]]),
        "dc": np.array([[(c / 255.0 - 0.5) / 0.15 for c in colour] for colour in arrays["colour"]]),
        "log_scales": np.array([[s / 16.0 - 10.0 for s in scale] for scale in arrays["scale"]]),
        "quats": np.array(
            [first_three(q) if version == 2 else smallest_three(struct.unpack("<I", q)[0]) for q in arrays["quat"]]
        ),
        "sh": np.array([[(s - 128.0) / 128.0 for s in sh] for sh in arrays["sh"]]).reshape(count, terms, 3),
    }
    return {"version": version, "degree": degree, "bits": bits, "flags": flags}, found


def smallest_three(word: int) -> list[float]:
    """(w, x, y, z): the index of the largest component of (x, y, z, w) in the upper bits, the others in order below."""
    largest, rest, square = word >> 30, [], 0.0
    for shift in (20, 10, 0):
        part = (word >> shift) & 1023
        value = (part & 511) / 511.0 * QUARTER_TURN
        rest.append(-value if part & 512 else value)
        square += value * value
    rest.insert(largest, math.sqrt(max(0.0, 1.0 - square)))
    return [rest[3], *rest[:3]]


def first_three(code: bytes) -> list[float]:
    """(w, x, y, z): each of x, y, z in a byte, w not negative."""
    x, y, z = (part / 127.5 - 1.0 for part in code)
    return [math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z)), x, y, z]


def test_version_2_differs_in_its_rotations_alone() -> None:
    made = some_gaussians()
    head, found = read(spz_bytes(made, antialias=False, version=2))
    head_3, found_3 = read(spz_bytes(made, antialias=False))
    assert head == {**head_3, "version": 2}
    for name in found.keys() - {"quats"}:
        np.testing.assert_array_equal(found[name], found_3[name])
    quats = made.quats / torch.linalg.vector_norm(made.quats, dim=1, keepdim=True)
    xyz = quats[:, 1:] * torch.where(quats[:, :1] < 0.0, -1.0, 1.0)
    np.testing.assert_allclose(found["quats"][:, 1:], xyz, atol=0.5 / 127.5 + 1e-6)
    with pytest.raises(ValueError, match="version"):
        spz_bytes(made, antialias=False, version=1)


def test_every_parameter_reads_back_within_half_a_step_of_its_code() -> None:
    made = some_gaussians()
    head, found = read(spz_bytes(made, antialias=True, sh_bits=(8, 8)))
    assert head["version"] == 3
    assert head["degree"] == 3
    assert head["flags"] & 1
    np.testing.assert_allclose(found["means"], made.means, atol=0.5 / 2 ** head["bits"] + 1e-6)
    np.testing.assert_allclose(found["alpha"], torch.sigmoid(made.opacity_logits), atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found["dc"], made.sh[:, 0].clamp(-3.3, 3.3), atol=0.5 / 255 / 0.15 + 1e-6)
    np.testing.assert_allclose(found["log_scales"], made.log_scales, atol=0.5 / 16 + 1e-6)
    np.testing.assert_allclose(found["sh"], made.sh[:, 1:].clamp(-1.0, 127.0 / 128.0), atol=0.5 / 128 + 1e-6)
    quats = made.quats / torch.linalg.vector_norm(made.quats, dim=1, keepdim=True)
    cosine = np.abs((found["quats"] * quats.numpy()).sum(axis=1))
    angle_deg = np.degrees(2.0 * np.arccos(np.minimum(cosine, 1.0)))
    assert angle_deg.max() < 0.25  # three components, each within half of 1 / 722


def test_harmonics_keep_as_many_bits_as_asked_for() -> None:
    made = some_gaussians()
    made.sh.clamp_(-0.9, 0.9)
    _, found = read(spz_bytes(made, antialias=False, sh_bits=(5, 4)))
    assert set(np.unique(found["sh"][:, :3] * 16.0 % 1.0)) == {0.0}
    assert set(np.unique(found["sh"][:, 3:] * 8.0 % 1.0)) == {0.0}
    np.testing.assert_allclose(found["sh"][:, 3:], made.sh[:, 4:], atol=0.5 / 8 + 1e-6)


def test_a_far_gaussian_is_brought_in_along_its_ray_and_shrunk_alike() -> None:
    made = some_gaussians(1000)
    made.means[7] = torch.tensor([3e6, 4e6, 0.0])
    head, found = read(spz_bytes(made, antialias=False))
    assert 2.0 ** -head["bits"] < 1e-3  # the scene, 100 units wide, keeps its places
    np.testing.assert_allclose(found["means"][7] / np.linalg.norm(found["means"][7]), [0.6, 0.8, 0.0], atol=1e-5)
    shrunk = np.linalg.norm(found["means"][7]) / 5e6
    expected = made.log_scales[7].numpy() + math.log(shrunk)
    np.testing.assert_allclose(found["log_scales"][7], np.maximum(expected, -10.0), atol=0.5 / 16 + 1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_are_as_long_as_their_terms(degree: int) -> None:
    head, found = read(spz_bytes(some_gaussians(5, degree), antialias=False))
    assert head["degree"] == degree
    assert found["sh"].shape == (5, (degree + 1) ** 2 - 1, 3)


def test_the_same_gaussians_give_the_same_bytes_and_none_give_a_file() -> None:
    assert spz_bytes(some_gaussians(), antialias=True) == spz_bytes(some_gaussians(), antialias=True)
    head, found = read(spz_bytes(some_gaussians(0), antialias=False))
    assert len(found["means"]) == 0
    assert head["flags"] == 0


def test_what_is_not_finite_is_refused() -> None:
    made = some_gaussians()
    made.means[3, 1] = float("nan")
    with pytest.raises(ValueError, match="finite"):
        spz_bytes(made, antialias=False)
