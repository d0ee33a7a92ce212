"""publish: the surface products in the formats of the web and of phones, and reduced for the viewer."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.texture.textured_mesh import load_textured_mesh
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.web.measured_page import SURFACES
from splatpipe.pipeline.web.options import EXPORT, PublishConfig, parse_surface_formats
from splatpipe.pipeline.web.publication import RunProducts, write_publication, write_viewer_surfaces


def run(config: PublishConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/export/` and `viewer/surfaces.json`, each file only if there is the product that it needs.

    Raises:
        SplatpipeError: if a product is broken.
        MachineError: if the disk is full.
    """
    for name in ("files", "viewer"):
        (out / name).mkdir(exist_ok=True)
    products = RunProducts(
        load_frame(inputs["georef.frame"]),
        inputs["cloud.files"] / "cloud.laz",
        inputs["ortho.files"] / "ortho.tif",
        inputs["dsm.files"] / "dsm.tif",
        load_textured_mesh(inputs["mesh.textured"], inputs["mesh.files"]),
    )
    work, surfaces = out / "work", out / "viewer" / SURFACES
    shown = write_viewer_surfaces(products, surfaces, work, report) if products.frame.in_metres else []
    made = write_publication(parse_surface_formats(config.formats), products, out / "files" / EXPORT, work, report)
    return {"formats": made, "viewer": shown, "viewer_bytes": surfaces.stat().st_size if shown else 0}
