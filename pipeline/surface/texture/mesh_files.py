"""The files of a mesh in local metres: glTF for viewers, OBJ for CAD, PLY with vertex colours, its georeference."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from splatpipe.pipeline.delivery.delivery_frame import facts_of, georef_facts
from splatpipe.pipeline.engine.files.durable import whole_file
from splatpipe.pipeline.engine.files.json_file import write_json
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.splat.formats.plain_ply import frame_comments
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh
from splatpipe.pipeline.surface.texture.glb_mesh import write_glb
from splatpipe.pipeline.surface.texture.obj_mesh import write_mtl, write_obj
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh
from splatpipe.pipeline.survey.crs.frames import Frame

MATERIALS = "mesh.mtl"


def write_mesh(folder: Path, made: TexturedMesh, frame: Frame, boundary: Path | None) -> None:
    """Write `mesh.glb`, `mesh.obj`, `mesh.mtl`, `mesh.ply` and `georef.json`, which georeferences them, into a folder.

    Args:
        folder: Output folder, where the pages are.
        made: The mesh in the frame's local metres.
        frame: The run's frame from georef.
        boundary: `georef.boundary`; None if the run has none.

    Raises:
        OSError: if the disk is full or not writable.
    """
    vertices = made.coloured.mesh.vertices
    facts = georef_facts(frame, np.stack([vertices.min(axis=0), vertices.max(axis=0)]), boundary)
    comments = frame_comments(facts_of(frame, antialias=False))
    with whole_file(folder / "mesh.glb") as aside, new_file(aside) as file:
        write_glb(file, made)
    with whole_file(folder / "mesh.obj") as aside, new_file(aside) as file:
        write_obj(file, made, MATERIALS, ["splatpipe: a mesh, z up, metres", *comments, *_offset_comments(facts)])
    with whole_file(folder / MATERIALS) as aside, new_file(aside) as file:
        write_mtl(file, made)
    with whole_file(folder / "mesh.ply") as aside, new_file(aside) as file:
        write_ply(file, made.coloured, comments)
    write_json(folder / "georef.json", facts)


def _offset_comments(facts: dict[str, Any]) -> list[str]:
    """Header lines that say where the local zero is in the CRS."""
    if facts["origin"] is None:
        return []
    x, y, z = (f"{number:.4f}" for number in facts["origin"]["in_crs"])
    return [
        f"offset: {x} {y} {z} (the local zero in the crs; the grid's north and scale differ a little from the local"
        " ones: georef.json has the exact transformation)"
    ]


def write_ply(file: BinaryIO, made: ColouredMesh, comments: Sequence[str]) -> None:
    """Write a mesh with vertex colours (sRGB, as is usual) as binary PLY.

    Args:
        file: Output.
        made: The mesh.
        comments: Lines of the header.
    """
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(made.mesh.vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(made.mesh.triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    file.write(("\n".join(header) + "\n").encode())
    vertices = np.empty(len(made.mesh.vertices), np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    vertices["xyz"], vertices["rgb"] = made.mesh.vertices, made.colours
    faces = np.empty(len(made.mesh.triangles), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"], faces["corners"] = 3, made.mesh.triangles
    file.write(vertices.data)
    file.write(faces.data)
