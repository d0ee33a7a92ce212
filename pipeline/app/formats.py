"""Export of runs to more formats (option parsing, feasibility checks), and conversion of files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.web.options import (
    FORMATS,
    SURFACE_FORMATS,
    parse_any_formats,
    parse_formats,
    parse_surface_formats,
)
from splatpipe.stages.line import GEOREF, LINE
from splatpipe.stages.options import LineConfig

if TYPE_CHECKING:
    from splatpipe.pipeline.splat.formats.catalogue import SplatFormat

NEED_METRES, NEED_PLACE = {"laz", "copc"}, {"tiles", "mesh-tiles", "mbtiles"}
NEED_PRODUCTS = {
    "mesh-tiles": ("mesh", ("mesh/mesh.glb",)),
    "copc": ("cloud", ("cloud.laz",)),
    "mbtiles": ("ortho", ("ortho.tif", "dsm.tif")),
}
"""Formats of surface products: the product, and its files in OUT, of which one suffices."""


def with_formats(out: Path, formats: str) -> dict[str, Any]:
    """The options that add formats to those that a run already exports.

    Raises:
        UsageError: if there is no such format.
    """
    config, asked = open_run_folder(out, LINE).config(LineConfig)[1], _parse_names(formats)
    before = {"export": parse_formats(config.export.formats), "publish": parse_surface_formats(config.publish.formats)}
    every = {"export": FORMATS, "publish": SURFACE_FORMATS}
    names = {stage: [name for name in known if name in (*before[stage], *asked)] for stage, known in every.items()}
    return {stage: {"formats": ",".join(found)} for stage, found in names.items()}


def check_possible(out: Path, formats: str) -> None:
    """Check that a run can be exported to formats before anything starts.

    Raises:
        SplatpipeError: if the run has no scale or is not georeferenced, and a format needs it; or if it has not made
            the product that a format is of.
    """
    for name in _parse_names(formats):
        product, files = NEED_PRODUCTS.get(name, ("", ()))
        if files and not any((out / file).is_file() for file in files):
            raise SplatpipeError(
                f"{name} is made from {files[0]}, which this run does not have.",
                hint=f"Make it first: splatpipe surface {out} --products {product}",
            )
    names = set(_parse_names(formats))
    if not names & (NEED_METRES | NEED_PLACE):
        return  # reading the frame loads NumPy
    from splatpipe.pipeline.survey.crs.frames import load_frame

    part = open_run_folder(out, LINE).lineage(GEOREF).get("georef.frame")
    if part is None:
        return
    frame = load_frame(part.path)
    for missing, needing in ((not frame.in_metres, NEED_METRES), (frame.origin is None, NEED_PLACE)):
        if missing and names & needing:
            raise SplatpipeError(
                f"{min(names & needing)} needs a georeferenced run, and this one is not.",
                hint=f"Give it control points (splatpipe georef {out} --gcp FILE), or photos with positions.",
            )


def _parse_names(text: str) -> tuple[str, ...]:
    try:
        names = parse_any_formats(text)
    except ValueError as error:
        raise UsageError(f"--format: {error}.") from error
    if not text.strip(", "):
        raise UsageError("No format is given.", hint=f"Choose from: {', '.join((*FORMATS, *SURFACE_FORMATS))}.")
    return names


def convert_file(source: Path, target: Path, kind: SplatFormat) -> dict[str, Any]:
    """Convert a splat file.

    Returns:
        Number of Gaussians, bytes, the format's name, the origin taken off the coordinates (None if none was), steps
        and sizes in the file's units, and warnings.

    Raises:
        SplatpipeError: if it cannot be read, or the format cannot hold it.
        MachineError: if it cannot be written.
    """
    from splatpipe.pipeline.splat.formats.files import read_scene, write_scene

    scene = read_scene(source)
    if not len(scene.gaussians):
        raise SplatpipeError(f"{source} has no Gaussians.", hint="There is nothing to export.")
    cost = write_scene(target, scene, kind)
    files = [target] if target.is_file() else [path for path in target.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    return {
        "format": kind.name,
        "gaussians": len(scene.gaussians),
        "bytes": size,
        "file": str(target),
        **cost.summary(scene.facts),
        "warnings": [*scene.notes, *cost.warnings()],
    }


def show_precision(facts: Mapping[str, Any]) -> None:
    """Print the origin taken off a splat's coordinates, the steps of its positions, and warnings, from a summary."""
    from splatpipe.pipeline.app.terminal.console import print_line
    from splatpipe.pipeline.splat.model.position_cost import two_digits

    unit = " m" if facts["metres"] else ""
    if facts["origin"] is not None:
        x, y, z = (f"{number:.15g}" for number in facts["origin"])
        whole = "x, y, z as 64-bit numbers; for programs that read only 32-bit ones, write .viewer.ply"
        print_line(
            f"Origin {x} {y} {z}: {whole if facts['format'] == 'ply' else 'taken off, and recorded in the file'}"
        )
    steps = f"in steps of {two_digits(facts['position_step'])}{unit}" if facts["position_step"] else "exact"
    print_line(f"Positions {steps}, Gaussians of {two_digits(facts['gaussian_size'])}{unit}")
    for text in facts["warnings"]:
        print_line(f"! {text}")
