"""A textured mesh as Wavefront OBJ with its MTL, for CAD: z up, local metres, the pages as files beside it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import BinaryIO

import numpy as np

from splatpipe.pipeline.surface.texture.glb_mesh import split_corners
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh

BATCH = 1 << 14  # lines at a time
METRES, SHARES = "%.4f", "%.7f"  # a tenth of a millimetre; a thousandth of a texel of the largest page


def write_obj(file: BinaryIO, made: TexturedMesh, materials: str, comments: Sequence[str]) -> None:
    """Write a mesh as OBJ.

    Args:
        file: Output.
        made: The mesh.
        materials: Name of the MTL file beside it.
        comments: Lines of the header.
    """
    for comment in comments:
        file.write(f"# {comment}\n".encode())
    file.write(f"mtllib {materials}\no mesh\n".encode())
    _write_lines(file, f"v {METRES} {METRES} {METRES}\n", made.coloured.mesh.vertices)
    first = 1
    for page in range(len(made.pages)):
        part = split_corners(made.coloured.mesh, made.atlas, page)
        uv = part.uv.astype(np.float64)
        uv[:, 1] = 1.0 - uv[:, 1]  # upwards
        _write_lines(file, f"vt {SHARES} {SHARES}\n", uv)
        file.write(f"usemtl page_{page:02d}\n".encode())
        corners = np.empty((len(part.triangles), 6), np.int64)
        corners[:, 0::2] = part.vertex[part.triangles] + 1
        corners[:, 1::2] = part.triangles.astype(np.int64) + first
        _write_lines(file, "f %d/%d %d/%d %d/%d\n", corners)
        first += len(uv)


def _write_lines(file: BinaryIO, form: str, rows: np.ndarray) -> None:
    for start in range(0, len(rows), BATCH):
        part = rows[start : start + BATCH]
        file.write(((form * len(part)) % tuple(part.ravel().tolist())).encode())


def write_mtl(file: BinaryIO, made: TexturedMesh) -> None:
    """Write the materials: one per page, without lighting where programs know that (illumination model 0)."""
    for number, page in enumerate(made.pages):
        lines = [
            f"newmtl page_{number:02d}",
            "Ka 1 1 1",
            "Kd 1 1 1",
            "Ks 0 0 0",
            "d 1",
            "illum 0",
            f"map_Kd {page.name}",
        ]
        file.write(("\n".join(lines) + "\n").encode())
