"""The surface products for the web and for phones, from a finished run's files, one by one."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.durable import beside, remove_unfinished, write_durably
from splatpipe.pipeline.engine.files.json_file import json_text, read_json
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.surface.levels.copc import write_copc
from splatpipe.pipeline.surface.levels.map_tiles import write_ortho_tiles, write_relief_tiles
from splatpipe.pipeline.surface.levels.mesh_tiles import write_mesh_tiles
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.web.viewer_surfaces import viewer_mesh, viewer_points

MESH_TILES, COPC, ORTHO_MAP, RELIEF_MAP = "mesh-tiles", "cloud.copc.laz", "ortho.mbtiles", "dsm.mbtiles"
Facts = dict[str, Any]


@dataclass(frozen=True, eq=False)
class RunProducts:
    """A run's surface products.

    Attributes:
        frame: The frame of `georef`.
        cloud: `cloud.laz`; no file if there is none, and so the others.
        ortho: `ortho.tif`.
        dsm: `dsm.tif`.
        mesh: The textured mesh; None if there is none.
    """

    frame: Frame
    cloud: Path
    ortho: Path
    dsm: Path
    mesh: TexturedMesh | None


def write_publication(
    names: Sequence[str], products: RunProducts, folder: Path, work: Path, report: Reporter
) -> dict[str, Facts]:
    """Write products in the formats of the web; what an earlier, killed call finished is kept.

    Args:
        names: Of `publish.formats`.
        products: The run's products.
        folder: Output folder.
        work: Folder for intermediate files, removed afterwards.
        report: Receives progress, and warnings about what cannot be written.

    Returns:
        Bytes and further figures of each format that was written, by name.

    Raises:
        MachineError: if the disk is full or not writable.
    """
    writers: Mapping[str, Callable[[], Facts]] = {
        "mesh-tiles": lambda: _mesh_tiles(products, folder, work, report),
        "copc": lambda: _copc(products, folder, work, report),
        "mbtiles": lambda: _maps(products, folder, report),
    }
    made = {}
    for name in names:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            made[name] = writers[name]()
        except SplatpipeError as error:
            if error.exit_code != SplatpipeError.exit_code:
                raise
            report.warning(f"{name} is left out: {error.message}", hint=error.hint)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    return made


def _mesh_tiles(products: RunProducts, folder: Path, work: Path, report: Reporter) -> Facts:
    if products.mesh is None:
        raise SplatpipeError("The run has no textured mesh.", "Make it first: splatpipe surface OUT --products mesh.")
    target = folder / MESH_TILES
    remove_unfinished(folder, MESH_TILES)
    if not target.is_dir():
        with beside(target) as aside:
            aside.mkdir()
            made = write_mesh_tiles(aside, products.mesh, products.frame, work, _progress(report, "tiles of the mesh"))
        if made.placement.approximate:
            report.note(f"3D Tiles: {made.placement.note}")
    files = [path for path in target.rglob("*") if path.is_file()]
    return {"bytes": sum(path.stat().st_size for path in files), "tiles": len(files) - 1}


def _copc(products: RunProducts, folder: Path, work: Path, report: Reporter) -> Facts:
    if not products.cloud.is_file():
        raise SplatpipeError("The run has no dense cloud.", "Make it first: splatpipe surface OUT --products cloud.")
    target = folder / COPC
    if not target.is_file():
        write_copc(products.cloud, target, work, _progress(report, "points of the cloud"))
    return {"bytes": target.stat().st_size}


def _maps(products: RunProducts, folder: Path, report: Reporter) -> Facts:
    maps = [
        (products.ortho, folder / ORTHO_MAP, write_ortho_tiles, "tiles of the orthophoto"),
        (products.dsm, folder / RELIEF_MAP, write_relief_tiles, "tiles of the surface model"),
    ]
    there = [each for each in maps if each[0].is_file()]
    if not there:
        raise SplatpipeError("The run has no orthophoto and no surface model.", "Make them: splatpipe surface OUT.")
    for source, target, write, what in there:
        if not target.is_file():
            write(source, target, products.frame, _progress(report, what))
    return {"bytes": sum(target.stat().st_size for _, target, _, _ in there)}


def write_viewer_surfaces(products: RunProducts, path: Path, work: Path, report: Reporter) -> list[str]:
    """Write what the viewer shows besides the splat, unless an earlier, killed call did.

    Nothing is written if the run made neither mesh nor cloud.

    Args:
        products: The run's products.
        path: Output file.
        work: Folder for intermediate files, removed afterwards.
        report: Receives progress.

    Returns:
        What is in it.

    Raises:
        SplatpipeError: if a product is broken.
        OSError: if the disk is full or not writable.
    """
    if path.is_file():
        return list(read_json(path))
    surfaces: Facts = {}
    report.progress(0, 2, "reducing the mesh and the cloud for the viewer", "products")
    if products.mesh is not None and (mesh := viewer_mesh(products.mesh, work)) is not None:
        surfaces["mesh"] = mesh
    report.progress(1, 2, "reducing the mesh and the cloud for the viewer", "products")
    if products.cloud.is_file() and (points := viewer_points(products.cloud, products.frame)) is not None:
        surfaces["points"] = points
    report.progress(2, 2, "reducing the mesh and the cloud for the viewer", "products")
    if surfaces:
        write_durably(path, json_text(surfaces))
    return list(surfaces)


def _progress(report: Reporter, what: str) -> Callable[[int, int], None]:
    return lambda done, total: report.progress(done, total, what, "pieces")
