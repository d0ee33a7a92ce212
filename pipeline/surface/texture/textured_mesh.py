"""The textured mesh of a run, and the file from which other products read it.

The part `mesh.textured` has the arrays, and names the pages, which lie among the mesh's own files (`mesh.files`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.mvs.array_file import save_arrays
from splatpipe.pipeline.splat.containers.archives import read_archive
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh, TriangleMesh

FOLDER = "mesh"  # of the part `mesh.files`
PAGE_SIDE = 8192  # pixels: the largest texture that every GPU of the last ten years takes
MOST_PAGES = 4096
PAGE_NAME = "mesh_{:02d}.jpg"


@dataclass(frozen=True, eq=False)
class Atlas:
    """Where the triangles of a mesh lie in its texture pages.

    Attributes:
        corners: Column and row of each triangle's corners in its page, pixels; the first pixel's centre is (0.5, 0.5),
            rows go down.
        chart: Chart of each triangle. The triangles of a chart, which need not be connected, lie inside of its
            rectangle and do not share its pixels with those of other charts.
        rects: Page, left, top, width, height of each chart in pixels, with a border that its triangles do not reach.
        sizes: Width and height of each page, pixels.
    """

    corners: Float32[np.ndarray, "m 3 2"]
    chart: Int32[np.ndarray, " m"]
    rects: Int32[np.ndarray, "c 5"]
    sizes: Int32[np.ndarray, "p 2"]

    def page(self) -> Int32[np.ndarray, " m"]:
        """The page of each triangle."""
        return np.asarray(self.rects[self.chart, 0])


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A triangle mesh with photos on it.

    Attributes:
        coloured: The mesh in the frame's local metres (east, north, up), with a colour per vertex.
        atlas: Where its triangles lie in the pages.
        pages: The pages' image files, JPEG.
    """

    coloured: ColouredMesh
    atlas: Atlas
    pages: tuple[Path, ...]


def page_paths(folder: Path, count: int) -> tuple[Path, ...]:
    """The pages' files in a folder."""
    return tuple(folder / PAGE_NAME.format(number) for number in range(count))


def save_textured_mesh(path: Path, made: TexturedMesh | None) -> None:
    """Write the arrays of a textured mesh for ``load_textured_mesh``.

    Args:
        path: Output file, `.npz`.
        made: The mesh; None if there is none.

    Raises:
        OSError: if the disk is full or not writable.
    """
    if made is None:
        save_arrays(path)
        return
    mesh, atlas = made.coloured.mesh, made.atlas
    save_arrays(
        path,
        vertices=mesh.vertices,
        triangles=mesh.triangles.astype(np.int32),
        colours=made.coloured.colours,
        **vars(atlas),
    )


def load_textured_mesh(path: Path, files: Path) -> TexturedMesh | None:
    """Read a finished run's textured mesh; None if it has none.

    Args:
        path: The part `mesh.textured`.
        files: The part `mesh.files`.

    Raises:
        StageError: if the arrays are broken or do not fit each other, or a page is missing.
    """
    try:
        kept = read_archive(path)
        if not kept:
            return None
        _check(kept)
        mesh = TriangleMesh(kept["vertices"].astype(np.float64), kept["triangles"].astype(np.int64))
        atlas = Atlas(*(kept[name] for name in ("corners", "chart", "rects", "sizes")))
        pages = page_paths(files / FOLDER, len(atlas.sizes))
        missing = [page.name for page in pages if not page.is_file()]
        if missing:
            raise ValueError(f"{missing[0]} is missing")
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise StageError(
            f"The textured mesh {path.name} cannot be read: {error}", "Run again with --rerun mesh."
        ) from error
    return TexturedMesh(ColouredMesh(mesh, kept["colours"]), atlas, pages)


def _check(arrays: Mapping[str, np.ndarray]) -> None:
    """Check the shapes and types of stored arrays, and that they point into each other."""
    vertices, triangles, charts, pages = (len(arrays[name]) for name in ("vertices", "triangles", "rects", "sizes"))
    shapes = {
        "vertices": ((vertices, 3), np.float64),
        "colours": ((vertices, 3), np.uint8),
        "triangles": ((triangles, 3), np.int32),
        "corners": ((triangles, 3, 2), np.float32),
        "chart": ((triangles,), np.int32),
        "rects": ((charts, 5), np.int32),
        "sizes": ((pages, 2), np.int32),
    }
    for name, (shape, kind) in shapes.items():
        if arrays[name].shape != shape or arrays[name].dtype != kind:
            raise ValueError(f"{name} of {arrays[name].dtype} {arrays[name].shape}")
    if not (np.isfinite(arrays["vertices"]).all() and np.isfinite(arrays["corners"]).all()):
        raise ValueError("coordinates that are no numbers")
    sizes = arrays["sizes"]
    if pages > MOST_PAGES or (sizes < 1).any() or (sizes > PAGE_SIDE).any():
        raise ValueError("pages of impossible sizes")
    _check_range("triangles", arrays["triangles"], vertices)
    _check_range("chart", arrays["chart"], charts)
    _check_range("rects", arrays["rects"][:, 0], pages)


def _check_range(name: str, indices: np.ndarray, count: int) -> None:
    if indices.size and not 0 <= indices.min() <= indices.max() < count:
        raise ValueError(f"{name} beyond {count}")
