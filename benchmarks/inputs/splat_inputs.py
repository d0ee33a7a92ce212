"""Field inputs: splats."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
from field_case import FieldInput
from numpy.typing import NDArray

COUNT = 3000
XYZ = ("x", "y", "z")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATIONS = ("rot_0", "rot_1", "rot_2", "rot_3")
COLOURS = ("f_dc_0", "f_dc_1", "f_dc_2")
Columns = dict[str, NDArray[np.float64]]


def columns(rest: int = 45, count: int = COUNT) -> Columns:
    """Return Gaussians of a scene of 20 m as columns of a PLY, in its usual order."""
    random = np.random.default_rng(5)
    quats = random.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    found = dict(zip(XYZ, random.normal(size=(3, count)) * 6.0, strict=True))
    found |= {name: random.normal(size=count) * 0.8 for name in COLOURS}
    found |= {f"f_rest_{i}": random.normal(size=count) * 0.1 for i in range(rest)}
    found |= {"opacity": random.normal(size=count) * 2.0}
    found |= {name: random.normal(size=count) * 0.6 - 3.5 for name in SCALES}
    return found | dict(zip(ROTATIONS, quats.T, strict=True))


def write_ply(path: Path, data: Columns, kinds: dict[str, str] | None = None, order: str = "<", line: str = "\n",
              comments: tuple[str, ...] = (), ascii_lines: bool = False) -> None:  # fmt: skip
    """Write columns as a PLY; float, little-endian and binary unless otherwise said."""
    types = {"float": "f4", "double": "f8", "uchar": "u1", "int": "i4", "half": "f2"}
    kinds = dict.fromkeys(data, "float") | (kinds or {})
    form = "ascii" if ascii_lines else {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    count = len(next(iter(data.values())))
    head = ["ply", f"format {form} 1.0", *comments, f"element vertex {count}"]
    head += [f"property {kinds[name]} {name}" for name in data] + ["end_header", ""]
    table = np.zeros(count, [(name, order + types[kinds[name]]) for name in data])
    for name, values in data.items():
        table[name] = values
    body = table.tobytes()
    if ascii_lines:
        body = "".join(" ".join(f"{float(v):.6g}" for v in row) + line for row in table).encode()
    path.write_bytes(line.join(head).encode() + body)


def big_endian_doubles(folder: Path) -> None:
    """Doubles, big-endian, normals, a confidence, a label and colours in bytes, in alphabetical order."""
    data = columns()
    data |= {name: np.zeros(COUNT) for name in ("nx", "ny", "nz")}
    data |= {"confidence": np.ones(COUNT), "label": np.full(COUNT, 7.0), "red": np.full(COUNT, 200.0)}
    kinds = dict.fromkeys(data, "double") | {"label": "int", "red": "uchar"}
    write_ply(folder / "cloud.ply", dict(sorted(data.items())), kinds, ">")


def windows_ascii(folder: Path) -> None:
    """Text, with Windows' ends of line, SH of degree 1."""
    write_ply(folder / "cloud.ply", columns(rest=9), line="\r\n", ascii_lines=True)


def degrees_of_harmonics(folder: Path) -> None:
    """SH of degree 2, of degree 0, and a broken one (10 of 9 or 24 values); one merged into the other."""
    for rest in (0, 24, 10):
        write_ply(folder / f"rest_{rest}.ply", columns(rest=rest))


def byte_colours(folder: Path) -> None:
    """A nerfstudio export with colours in bytes instead of f_dc (--ply-color-mode rgb)."""
    data = {name: values for name, values in columns(rest=0).items() if name not in COLOURS}
    random = np.random.default_rng(1)
    data |= {name: random.integers(0, 256, COUNT).astype(float) for name in ("red", "green", "blue")}
    write_ply(folder / "splat.ply", data, dict.fromkeys(("red", "green", "blue"), "uchar"))


def flat_gaussians(folder: Path) -> None:
    """2D Gaussian Splatting's PLY: two scales only."""
    data = columns()
    del data["scale_2"]
    write_ply(folder / "point_cloud.ply", data)


def mip_filter(folder: Path) -> None:
    """Mip-Splatting's PLY: a filter_3D for each Gaussian, which widens it and lowers its opacity."""
    write_ply(folder / "point_cloud.ply", columns() | {"filter_3D": np.full(COUNT, 0.05)})


def odd_quaternions(folder: Path) -> None:
    """Quaternions of any length, some of length zero."""
    data = columns()
    for name in ROTATIONS:
        data[name] = data[name] * np.linspace(0.0, 50.0, COUNT)
        data[name][:20] = 0.0
    write_ply(folder / "cloud.ply", data)


def linear_values(folder: Path) -> None:
    """Scales and opacities stored as they are, not as logarithm and logit."""
    data = columns()
    data |= {name: np.exp(data[name]) for name in SCALES}
    data["opacity"] = 1 / (1 + np.exp(-data["opacity"]))
    write_ply(folder / "activated.ply", data)


def browser_files(folder: Path) -> None:
    """A .splat (32 bytes a Gaussian) and a .ksplat, as web viewers keep them."""
    data = columns(rest=0)
    table = np.zeros(COUNT, [("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
    table["xyz"] = np.stack([data[name] for name in XYZ], 1)
    table["scale"] = np.exp(np.stack([data[name] for name in SCALES], 1))
    table["rgba"] = 200
    table["quat"] = np.clip(np.stack([data[name] for name in ROTATIONS], 1) * 128 + 128, 0, 255)
    (folder / "scene.splat").write_bytes(table.tobytes())
    (folder / "scene.ksplat").write_bytes(struct.pack("<BB2xII", 0, 1, 1, 1) + bytes(4096 + 1024) + table.tobytes())


def points_only(folder: Path) -> None:
    """COLMAP's or Metashape's cloud taken for a splat, a mesh, an empty splat, and one cut off in the middle."""
    data = columns(rest=0)
    cloud = {name: data[name] for name in XYZ} | {name: np.full(COUNT, 90.0) for name in ("red", "green", "blue")}
    write_ply(folder / "points3D.ply", cloud, dict.fromkeys(("red", "green", "blue"), "uchar"))
    (folder / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    write_ply(folder / "empty.ply", columns(count=0))
    write_ply(folder / "whole.ply", columns())
    whole = (folder / "whole.ply").read_bytes()
    (folder / "half.ply").write_bytes(whole[: len(whole) // 2])


def old_spz(folder: Path) -> None:
    """SPZ 1 (half-precision positions), SPZ 2 with 24 fractional bits in the header, and one without gzip."""
    random = np.random.default_rng(2)
    half = (random.normal(size=(COUNT, 3)) * 6).astype("<f2").tobytes()
    rest = [random.integers(0, 256, (COUNT, n), dtype=np.uint8).tobytes() for n in (1, 3)]
    scales = random.integers(90, 110, (COUNT, 3), dtype=np.uint8).tobytes()
    quats = random.integers(100, 156, (COUNT, 3), dtype=np.uint8).tobytes()
    first = struct.pack("<IIIBBBB", 0x5053474E, 1, COUNT, 0, 0, 0, 0) + half + b"".join(rest) + scales + quats
    (folder / "first.spz").write_bytes(gzip.compress(first))
    fixed = np.clip((random.normal(size=(COUNT, 3)) * 0.1 * 2**23), -(2**23), 2**23 - 1).astype("<i4")
    packed = fixed.view(np.uint8).reshape(COUNT, 3, 4)[..., :3].tobytes()
    second = struct.pack("<IIIBBBB", 0x5053474E, 2, COUNT, 0, 24, 0, 0) + packed + b"".join(rest) + scales + quats
    (folder / "second.spz").write_bytes(gzip.compress(second))
    (folder / "plain.spz").write_bytes(second)


def trainer_folder(folder: Path) -> None:
    """A trainer's folder with iterations 7000 and 30000, and a chkpnt30000.pth; the input cloud beside."""
    for iteration, count in ((7000, 2000), (30000, 3000)):
        inner = folder / f"model/point_cloud/iteration_{iteration}"
        inner.mkdir(parents=True)
        write_ply(inner / "point_cloud.ply", columns(count=count))
    (folder / "model/cfg_args").write_text("Namespace(sh_degree=3, source_path='/data/x', white_background=False)")
    (folder / "model/chkpnt30000.pth").write_bytes(b"PK\x03\x04not a checkpoint")
    cloud = {name: values for name, values in columns(rest=0).items() if name in XYZ}
    write_ply(folder / "model/input.ply", cloud)


def old_compressed(folder: Path) -> None:
    """SuperSplat's first compressed PLY (chunks of 12 numbers), and a splat with one Gaussian a million units off."""
    count, chunks = 512, 2
    random = np.random.default_rng(3)
    bounds = np.array([[-5, -5, -5, 5, 5, 5, -5, -5, -5, -2, -2, -2]] * chunks, "<f4")
    sides = [f"{side}_{what}{axis}" for what in ("", "scale_") for side in ("min", "max") for axis in XYZ]
    packed = random.integers(0, 2**32, (count, 4), dtype=np.uint32).astype("<u4")
    head = ["ply", "format binary_little_endian 1.0", "comment generated by super-splat", f"element chunk {chunks}"]
    head += [f"property float {name}" for name in sides] + [f"element vertex {count}"]
    head += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")] + ["end_header", ""]
    (folder / "old.compressed.ply").write_bytes("\n".join(head).encode() + bounds.tobytes() + packed.tobytes())
    data = columns()
    data["x"][7] = 1e6
    write_ply(folder / "stray.ply", data)


SPLAT_INPUTS = (
    FieldInput("big_endian_doubles", big_endian_doubles, ("convert cloud.ply cloud.spz",), 0),
    FieldInput("windows_ascii", windows_ascii, ("convert cloud.ply cloud.spz",), 1, ("Export it as a binary PLY",)),
    FieldInput(
        "degrees_of_harmonics",
        degrees_of_harmonics,
        ("edit rest_24.ply both.ply --merge rest_0.ply --no-pictures", "convert rest_10.ply ten.spz"),
        1,
        ("10 f_rest properties are not spherical harmonics",),
    ),
    FieldInput("byte_colours", byte_colours, ("convert splat.ply splat.spz",), 0, mended='"a point cloud"'),
    FieldInput("flat_gaussians", flat_gaussians, ("convert point_cloud.ply flat.spz",), 0, mended='"incomplete"'),
    FieldInput(
        "mip_filter", mip_filter, ("convert point_cloud.ply mip.spz",), 0, mended="the filter was dropped in silence"
    ),
    FieldInput("odd_quaternions", odd_quaternions, ("convert cloud.ply cloud.spz",), 0),
    FieldInput(
        "linear_values", linear_values, ("convert activated.ply cloud.spz",), 0, mended="read as logits in silence"
    ),
    FieldInput("browser_files", browser_files, ("convert scene.splat a.ply", "convert scene.ksplat b.ply"), 1),
    FieldInput(
        "points_only",
        points_only,
        tuple(f"convert {name}.ply {name}.spz" for name in ("points3D", "mesh", "empty", "half")),
        1,
        ("not a splat but a point cloud or a mesh", "half.ply is cut off"),
    ),
    FieldInput("old_spz", old_spz, tuple(f"convert {name}.spz {name}.ply" for name in ("first", "second", "plain")), 1),
    FieldInput("trainer_folder", trainer_folder, ("convert model model.spz",), 0),
    FieldInput(
        "old_compressed",
        old_compressed,
        (
            "convert old.compressed.ply old.spz",
            "convert stray.ply stray.sog",
            "edit stray.ply clean.sog --clean --no-pictures",
        ),
        0,
    ),
)
