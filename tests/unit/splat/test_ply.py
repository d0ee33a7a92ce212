"""Splat files: the exact 3DGS layout as an independent reader sees it, and hostile files."""

import struct
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.ply import (
    MIP_COMMENT,
    property_names,
    read_splat,
    read_splat_header,
    write_splat,
    write_splat_parts,
)
from splatpipe.pipeline.splat.model.gaussians import Gaussians

# The order of the 3DGS reference implementation, spelled out.
LAYOUT = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


def random_gaussians(n: int, degree: int) -> Gaussians:
    generator = torch.Generator().manual_seed(n + degree)
    shapes = [(n, 3), (n, 3), (n, 4), (n,), (n, (degree + 1) ** 2, 3)]
    return Gaussians(*(torch.randn(*shape, generator=generator) for shape in shapes))


def assert_same(a: Gaussians, b: Gaussians) -> None:
    for name, tensor in a.tensors().items():
        torch.testing.assert_close(tensor, b.tensors()[name], atol=0, rtol=0)


def rewrite(path: Path, names: list[str], source: Gaussians, kind: str = "f4", byte_order: str = "<") -> None:
    """A splat by plyfile, its properties in any order and type."""
    write_splat(path, source)
    rows = plyfile.PlyData.read(path, mmap=False)["vertex"].data
    again = np.empty(len(rows), dtype=[(name, kind) for name in names])
    for name in names:
        again[name] = rows[name]
    plyfile.PlyData([plyfile.PlyElement.describe(again, "vertex")], byte_order=byte_order).write(path)


def splat_bytes(tmp_path: Path, n: int = 3, degree: int = 0) -> bytes:
    path = tmp_path / "whole.ply"
    write_splat(path, random_gaussians(n, degree))
    return path.read_bytes()


@pytest.mark.parametrize("degree", [0, 3])
def test_written_in_parts_the_file_is_the_same_and_complete(tmp_path, degree):
    parts, path = [random_gaussians(n, degree) for n in (5, 0, 12)], tmp_path / "parts.ply"
    write_splat(tmp_path / "whole.ply", Gaussians.concat(parts), [MIP_COMMENT])
    write_splat_parts(path, iter(parts), 17, degree, [MIP_COMMENT])
    assert path.read_bytes() == (tmp_path / "whole.ply").read_bytes()
    with pytest.raises(ValueError, match="17 Gaussians were to be of 18"):
        write_splat_parts(path, parts, 18, degree)
    with pytest.raises(ValueError, match="degree"):
        write_splat_parts(path, parts, 17, 1)
    parts[0].means[2, 1] = torch.nan
    with pytest.raises(ValueError, match="1 Gaussians have values that are not finite"):
        write_splat_parts(path, parts, 17, degree)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_independent_reader_finds_every_property_where_3dgs_has_it(tmp_path, degree):
    gaussians, path = random_gaussians(17, degree), tmp_path / "splat.ply"
    write_splat(path, gaussians, comments=[MIP_COMMENT])
    ply = plyfile.PlyData.read(path, mmap=False)
    rows, per_channel = ply["vertex"].data, (degree + 1) ** 2 - 1
    assert [e.name for e in ply.elements] == ["vertex"]
    assert ply.byte_order == "<"
    assert ply.comments == ["SplatRenderMode: mip"]
    assert list(rows.dtype.names) == [n for n in LAYOUT if not n.startswith("f_rest") or int(n[7:]) < 3 * per_channel]
    assert {kind for kind, _ in (rows.dtype.fields[n] for n in rows.dtype.names)} == {np.dtype("<f4")}
    np.testing.assert_array_equal(np.stack([rows[n] for n in "xyz"], 1), gaussians.means)
    for n in ("nx", "ny", "nz"):
        assert not rows[n].any()
    for channel in range(3):
        np.testing.assert_array_equal(rows[f"f_dc_{channel}"], gaussians.sh[:, 0, channel])
        for i in range(per_channel):  # channel-major
            stored = rows[f"f_rest_{channel * per_channel + i}"]
            np.testing.assert_array_equal(stored, gaussians.sh[:, 1 + i, channel])
        np.testing.assert_array_equal(rows[f"scale_{channel}"], gaussians.log_scales[:, channel])
    for i in range(4):
        np.testing.assert_array_equal(rows[f"rot_{i}"], gaussians.quats[:, i])
    np.testing.assert_array_equal(rows["opacity"], gaussians.opacity_logits)


def test_degree_3_row_has_248_bytes(tmp_path):
    assert property_names(3) == LAYOUT
    write_splat(tmp_path / "a.ply", random_gaussians(2, 3))
    assert read_splat_header(tmp_path / "a.ply").row.itemsize == 248


@pytest.mark.parametrize(("n", "degree"), [(0, 3), (1, 0), (70_000, 1), (5, 2), (9, 3)])
def test_round_trip_is_exact(tmp_path, n, degree):
    gaussians = random_gaussians(n, degree)
    write_splat(tmp_path / "splat.ply", gaussians.to(dtype=torch.float64).requires_grad_())
    assert_same(read_splat(tmp_path / "splat.ply"), gaussians)


def test_same_gaussians_give_the_same_bytes(tmp_path):
    assert splat_bytes(tmp_path, 100, 3) == splat_bytes(tmp_path, 100, 3)


@pytest.mark.parametrize("byte_order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_reads_any_order_without_normals_in_either_byte_order(tmp_path, kind, byte_order):
    gaussians, path = random_gaussians(11, 3), tmp_path / "other.ply"
    rewrite(path, [n for n in sorted(LAYOUT) if n[0] != "n"], gaussians, kind, byte_order)
    assert_same(read_splat(path), gaussians)


def test_reads_past_other_elements_extra_properties_and_crlf(tmp_path):
    data = splat_bytes(tmp_path)
    header, _, body = data.partition(b"end_header\n")
    header = header.replace(b"element vertex", b"obj_info by hand\nelement camera 2\nproperty uchar a\nelement vertex")
    header = header.replace(b"property float x", b"property uchar flags\nproperty float x")
    rows = len(body) // 3
    body = b"zz" + b"".join(b"f" + body[i * rows : (i + 1) * rows] for i in range(3)) + b"\x03 faces"
    header += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "odd.ply").write_bytes(header.replace(b"\n", b"\r\n") + body)
    assert_same(read_splat(tmp_path / "odd.ply"), random_gaussians(3, 0))


def test_infinite_opacity_and_zero_scale_become_finite(tmp_path):
    path, gaussians = tmp_path / "converted.ply", random_gaussians(3, 0)
    rewrite(path, property_names(0), gaussians)
    ply = plyfile.PlyData.read(path, mmap=False)
    ply["vertex"]["opacity"] = [np.inf, -np.inf, 0.5]
    ply["vertex"]["scale_1"] = [-np.inf, 0, 0]
    ply.write(path)
    again = read_splat(path)
    assert again.opacity_logits.tolist() == [20.0, -20.0, 0.5]
    assert again.log_scales[:, 1].tolist() == [-20.0, 0.0, 0.0]
    assert torch.sigmoid(again.opacity_logits[0]) == 1.0


def test_values_that_are_not_numbers_are_reported_with_their_row(tmp_path):
    path = tmp_path / "nan.ply"
    rewrite(path, property_names(0), random_gaussians(4, 0))
    ply = plyfile.PlyData.read(path, mmap=False)
    ply["vertex"]["y"] = [0, 0, np.nan, np.inf]
    ply.write(path)
    with pytest.raises(SplatpipeError, match=r"2 of 4 Gaussians .* number 2"):
        read_splat(path)


def test_double_beyond_float32_is_reported(tmp_path):
    path = tmp_path / "big.ply"
    rewrite(path, property_names(0), random_gaussians(2, 0), kind="f8")
    ply = plyfile.PlyData.read(path, mmap=False)
    ply["vertex"]["x"] = [1e300, 0]
    ply.write(path)
    with pytest.raises(SplatpipeError, match="1 of 2"):
        read_splat(path)


def test_writer_refuses_what_is_not_finite_and_comments_with_breaks(tmp_path):
    gaussians = random_gaussians(3, 1)
    gaussians.quats[1, 2] = torch.nan
    with pytest.raises(ValueError, match="1 Gaussians"):
        write_splat(tmp_path / "a.ply", gaussians)
    assert not (tmp_path / "a.ply").exists()
    too_large = random_gaussians(3, 1).to(dtype=torch.float64)
    too_large.means[0, 0] = 1e300
    with pytest.raises(ValueError, match="1 Gaussians"):
        write_splat(tmp_path / "a.ply", too_large)
    with pytest.raises(ValueError, match="one line"):
        write_splat(tmp_path / "a.ply", random_gaussians(3, 1), comments=["a\nend_header"])


def test_comment_beyond_ascii_is_escaped_and_read_back(tmp_path):
    write_splat(tmp_path / "a.ply", random_gaussians(1, 0), comments=["Haus Gödel", MIP_COMMENT])
    assert read_splat_header(tmp_path / "a.ply").comments == ("Haus G\\xf6del", MIP_COMMENT)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d[:-1], "cut off: its header declares 3 Gaussians, but it has room for 2"),
        (lambda d: d[:100], "does not end"),
        (lambda d: b"", "not a PLY"),
        (lambda d: b"\xff\xd8\xff\xe0" + d, "not a PLY"),
        (lambda d: d.replace(b"element vertex 3", b"element vertex 999999999999999"), "cut off"),
        (lambda d: d.replace(b"element vertex 3", b"element vertex -1"), "not a valid line of a PLY header"),
        (lambda d: d.replace(b"element vertex 3", b"element vertex 1e3"), "not a valid line of a PLY header"),
        (lambda d: d.replace(b"element vertex 3", b"element vertex " + b"9" * 500), "not a valid line of a PLY header"),
        (lambda d: d.replace(b"element vertex", b"element points"), "no vertices"),
        (lambda d: d.replace(b"binary_little_endian", b"ascii"), "text PLY"),
        (lambda d: d.replace(b"format binary_little_endian 1.0\n", b""), "not name a format"),
        (lambda d: d.replace(b"property float y", b"property float x"), "twice"),
        (lambda d: d.replace(b"property float opacity", b"property float o"), "has no opacity"),
        (lambda d: d.replace(b"float f_dc_", b"float c_"), "a point cloud or a mesh: it has no f_dc_0"),
        (lambda d: d.replace(b"float opacity", b"uchar opacity"), "floats"),
        (lambda d: d.replace(b"float nx", b"list uchar int nx"), "floats"),
        (lambda d: d.replace(b"float nx", b"float f_rest_0"), "not spherical harmonics"),
        (lambda d: d.replace(b"float nx", b"quaternion nx"), "not a valid line of a PLY header"),
        (lambda d: d.replace(b"element vertex 3", b"element vertex 3\nproperty uint packed_position"), "cut off"),
        (
            lambda d: d.replace(b"element vertex", b"element f 9\nproperty list uchar int i\nelement vertex"),
            "lists before",
        ),
        (lambda d: d.replace(b"ply\n", b"ply\ncomment " + b"a" * 70_000 + b"\n"), "does not end"),
    ],
)
def test_hostile_file_gets_a_clear_error(tmp_path, change, says):
    path = tmp_path / "bad.ply"
    path.write_bytes(change(splat_bytes(tmp_path)))
    with pytest.raises(SplatpipeError, match=says) as caught:
        read_splat(path)
    assert caught.value.hint


def test_compressed_ply_is_named(tmp_path):
    text = (
        "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 1\n"
        "property uint packed_position\nproperty uint packed_rotation\nend_header\n"
    )
    (tmp_path / "c.ply").write_bytes(text.encode() + struct.pack("<fII", 0, 0, 0))
    with pytest.raises(SplatpipeError, match="compressed PLY"):
        read_splat(tmp_path / "c.ply")


def test_missing_file_and_folder_get_a_clear_error(tmp_path):
    for path in (tmp_path / "none.ply", tmp_path):
        with pytest.raises(SplatpipeError, match="Cannot read"):
            read_splat(path)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_file_is_read_or_refused_and_nothing_else(tmp_path, data):
    whole = bytearray(splat_bytes(tmp_path))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(whole) - 1))
        match data.draw(st.sampled_from(["flip", "cut", "insert", "swap"])):
            case "flip":
                whole[at] = data.draw(st.integers(0, 255))
            case "cut":
                del whole[at : at + data.draw(st.integers(1, 40))]
            case "insert":
                whole[at:at] = data.draw(st.binary(min_size=1, max_size=20))
            case "swap":
                whole[at : at + 4] = b"-9 \n"
        if not whole:
            break
    path = tmp_path / "fuzzed.ply"
    path.write_bytes(bytes(whole))
    try:
        gaussians = read_splat(path)
    except SplatpipeError:
        return
    assert bool(gaussians.finite().all())
