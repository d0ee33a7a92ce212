"""Photos on a mesh: from a mesh and photos to its texture pages."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Int16
from PIL import Image

from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.mvs.array_file import save_arrays
from splatpipe.pipeline.splat.containers.archives import open_archive
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet
from splatpipe.pipeline.surface.depths.pixel_file import pixels_on_disk
from splatpipe.pipeline.surface.depths.sources import LruCache
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh
from splatpipe.pipeline.surface.texture.charts import make_charts
from splatpipe.pipeline.surface.texture.face_choice import Labels, choose_photos
from splatpipe.pipeline.surface.texture.face_graph import adjacent_faces, reachable_from_borders
from splatpipe.pipeline.surface.texture.face_views import NONE, rate_faces, sample_faces
from splatpipe.pipeline.surface.texture.neighbour_photos import FaceNeighbours, NeighbourPhotos
from splatpipe.pipeline.surface.texture.packing import pack_charts
from splatpipe.pipeline.surface.texture.page_colours import TextureInput, colour_page
from splatpipe.pipeline.surface.texture.seams import blend_seams
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh, page_paths

PIXEL_BYTES = 512 << 20  # limit for decoded photos in memory; beyond it, all are kept on disk
QUALITY = 92  # of JPEG: its errors are below the photos' own noise
LEAST_CELLS = 400.0  # area, in cells of a pixel's size, below which a photo gives way to those around it


@dataclass(frozen=True, eq=False)
class TextureTask:
    """What textures are made from.

    Attributes:
        photos: Photos with depths and gains.
        cell_m: Their GSD, metres.
        most_texels: Limit on the texels of all pages, about.
        threads: Photos in parallel.
    """

    photos: PhotoSet
    cell_m: float
    most_texels: float
    threads: int


def texture_mesh(task: TextureTask, coloured: ColouredMesh, work: Path, out: Path, report: Reporter) -> TexturedMesh:
    """Put photos on a mesh; a killed call resumes after the choice of photos and after each page.

    Triangles at the mesh's borders that no photo sees are removed: there the surface was only extrapolated.

    Args:
        task: Inputs.
        coloured: The mesh, with the colours of what no photo sees.
        work: Folder for intermediate files.
        out: Folder of the pages.
        report: Receives progress.

    Raises:
        ValueError: if depths or pixels do not fit their camera.
        OSError: if the disk is full or not writable.
    """
    beyond = adjacent_faces(coloured.mesh.triangles)
    with pixels_on_disk(task.photos.sources, work, PIXEL_BYTES) as sources:
        photos = replace(task.photos, sources=sources)
        label, listed = _choose(task, photos, coloured, beyond, work / "choice.npz", report)
        kept = ~reachable_from_borders(beyond, label == NONE)
        coloured, label, listed = coloured.select(kept), label[kept], listed[kept]
        mesh = coloured.mesh
        charts = make_charts(mesh, label, adjacent_faces(mesh.triangles), sources, task.most_texels)
        atlas, blends = pack_charts(charts), blend_seams(mesh, label, listed)
        pages = page_paths(out, len(atlas.sizes))
        inputs = TextureInput(coloured, charts, atlas, blends, sources, photos.levels, LruCache(PIXEL_BYTES))
        for number, page in enumerate(pages):
            if not page.is_file():
                _write_page(page, colour_page(inputs, number, task.threads))
            report.progress(number + 1, len(pages), "drawing texture pages", "pages")
    return TexturedMesh(coloured, atlas, pages)


def _choose(
    task: TextureTask, photos: PhotoSet, coloured: ColouredMesh, beyond: np.ndarray, kept: Path, report: Reporter
) -> tuple[Labels, Int16[np.ndarray, "m k"]]:
    """The photo of each triangle, and the list of those that see it."""
    if not kept.is_file():
        mesh = coloured.mesh
        faces, least_m2 = sample_faces(mesh), LEAST_CELLS * task.cell_m**2
        views = rate_faces(photos, faces, task.cell_m, task.threads, report)
        label = choose_photos(views, beyond, mesh.areas(), least_m2)
        neighbours = NeighbourPhotos(photos, faces, views, task.cell_m, task.threads)
        neighbours.join(label, FaceNeighbours(beyond, mesh.areas(), least_m2))
        save_arrays(kept, label=label, listed=views.photo)
        del views, faces, neighbours
        return_free_heap()  # half a gigabyte, before pages are drawn
    with open_archive(kept) as arrays:
        return arrays["label"], arrays["listed"]


def _write_page(path: Path, page: np.ndarray) -> None:
    def write(file: IO[bytes]) -> None:
        Image.fromarray(page).save(file, "JPEG", quality=QUALITY, subsampling="4:2:0")

    write_durably(path, write)
