"""Measures sections and volumes on a finished run's DSM and DTM, into OUT/sections, OUT/volumes.json and the pages."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splatpipe.pipeline.app.measurements import SECTIONS, VOLUMES, Items, write_measurements
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.files.durable import sync_folder
from splatpipe.pipeline.engine.files.output_file import own_folder
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.engine.runs.store import Part
from splatpipe.stages.line import DEPTHS, DSM, DTM, GEOREF, LINE, UNDISTORT
from splatpipe.stages.options import LineConfig
from splatpipe.stages.products import NO_PRODUCTS

if TYPE_CHECKING:
    from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile
    from splatpipe.pipeline.surface.rasters.map_crs import MapCrs
    from splatpipe.pipeline.survey.crs.frames import Frame

MAX_SECTIONS = 100
UNFINISHED = ".sections.making"
SECTION_FILE = re.compile(r"section-\d+(_points)?\.(csv|dxf|png)")
MAX_SECTION_POINTS = 2000  # most points in a section's trace: more than a chart has pixels
MAX_TRACE_POINTS = 60_000  # most points in all traces together: they add at most 3 MB to a page
MAX_RING_POINTS = 400  # most points in a polygon's ring
MAX_TRACED_VOLUMES = 200  # most volumes in pages; any more are only in volumes.json
Base = Literal["rim", "lowest", "ground"] | float
Model = Literal["dsm", "dtm"]
Line = tuple[float, float, float, float]


@dataclass(frozen=True)
class MeasurementRequest:
    """What to measure.

    Attributes:
        lines: Lines of the sections, in the run's CRS.
        polygons: A GeoJSON file with the polygons of volumes; None for none.
        base: Base of the volumes: ``rim``, ``lowest``, ``ground``, or a height in the CRS's unit.
        model: Heights of the volumes: the topmost surface, or the ground.
    """

    lines: tuple[Line, ...]
    polygons: Path | None
    base: Base
    model: Model = "dsm"

    @property
    def anything(self) -> bool:
        """Whether there is anything to measure."""
        return bool(self.lines) or self.polygons is not None

    @property
    def products(self) -> str:
        """The products that it needs."""
        return "dtm" if self.polygons is not None and (self.model == "dtm" or self.base == "ground") else "dsm"

    @staticmethod
    def of(sections: Sequence[str], polygons: Path | None, base: str, model: str = "dsm") -> MeasurementRequest:
        """Parse the request from command-line options.

        Raises:
            UsageError: if a section is not a line or has no length, the base or the model is invalid, or there is no
                such file.
        """
        if len(sections) > MAX_SECTIONS:
            raise UsageError(f"{len(sections)} sections are too many.", hint=f"At most {MAX_SECTIONS} at a time.")
        height = _number(base)
        if height is None and base not in ("rim", "lowest", "ground"):
            raise UsageError(f'There is no base "{base[:40]}".', hint="Choose rim, lowest, ground, or a height.")
        if model not in ("dsm", "dtm"):
            raise UsageError(f'There is no model "{model[:40]}".', hint="Choose dsm or dtm.")
        if model == "dtm" and base == "ground":
            raise UsageError("Between the ground and itself there is no volume.", hint="Choose another base or model.")
        if polygons is not None and not polygons.is_file():  # reported now: the products may take minutes
            raise UsageError(f"There is no file {polygons}.", hint="Give --volume a GeoJSON file of polygons.")
        named: dict[str, Base] = {"rim": "rim", "lowest": "lowest", "ground": "ground"}
        measured_from = height if height is not None else named[base]
        lines = tuple(_line(text) for text in sections)
        return MeasurementRequest(lines, polygons, measured_from, "dtm" if model == "dtm" else "dsm")


def _line(text: str) -> Line:
    numbers = [_number(part) for part in text.split(",")[:5]]
    if len(numbers) != 4 or None in numbers:
        raise UsageError(f'Cannot understand --section "{text[:60]}".', hint="Write it as --section X1,Y1,X2,Y2.")
    x1, y1, x2, y2 = (number for number in numbers if number is not None)
    if (x1, y1) == (x2, y2):
        raise UsageError(f"The section {text[:60]} has no length.", hint="Write it as --section X1,Y1,X2,Y2.")
    return x1, y1, x2, y2


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


@dataclass(frozen=True, eq=False)
class _SurfaceModel:
    """A finished surface model, and what it was made from.

    Attributes:
        parts: Parts by full name.
        frame: The frame of `georef`.
        crs: The model's CRS.
        model: Its heights.
        terrain: The terrain model made from it; None if there is none.
    """

    parts: Mapping[str, Part]
    frame: Frame
    crs: MapCrs
    model: SurfaceFile
    terrain: SurfaceFile | None

    def ground(self) -> SurfaceFile:
        """The terrain model.

        Raises:
            SplatpipeError: if there is none.
        """
        if self.terrain is None:
            raise SplatpipeError(
                "The run has no terrain model.", hint="Make one first: splatpipe surface OUT --products dtm."
            )
        return self.terrain

    @property
    def digests(self) -> tuple[str, str]:
        """Digests of the model and the frame; measurements are valid only for these."""
        return self.parts["dsm.files"].digest, self.parts["georef.frame"].digest


def check_possible(out: Path, *tables: dict[str, Any]) -> None:
    """Check that products can be made before anything is started or saved.

    Args:
        out: OUT, of a run.
        tables: Options given now, which override those of the run.

    Raises:
        SplatpipeError: if the run has no scale.
        MachineError: if a mesh is requested and open3d is not installed.
    """
    from splatpipe.pipeline.survey.crs.frames import load_frame

    changed, run = {stage for table in tables for stage in table}, open_run_folder(out, LINE)
    georeferenced_again = not {*NO_PRODUCTS, "splat_depths"}.issuperset(changed)
    frame = run.lineage(GEOREF).get("georef.frame")
    if frame is not None and not georeferenced_again and not load_frame(frame.path).in_metres:
        raise SplatpipeError(
            "The run has no metric scale, so no surface products can be made.",
            hint=f"Give it control (splatpipe georef {out} --gcp FILE), scale bars, or photos with positions.",
        )

    if "mesh" in changed and run.config(LineConfig, *tables)[1].mesh.enabled:
        from splatpipe.pipeline.surface.shapes.decimation import simplifier
        from splatpipe.pipeline.surface.shapes.tsdf import open3d

        open3d()
        simplifier()


def measurement_lines(out: Path, measured: Mapping[str, Any]) -> list[str]:
    """The measurements as text, one line each.

    Args:
        out: OUT.
        measured: As ``measure_surface`` returns it.
    """
    lines = []
    for section in measured.get("sections", ()):
        sigma_m = section["height_sigma_m"]
        accuracy = "" if sigma_m is None else f", accurate to {sigma_m * 100.0:.1f} cm"
        text = f"{section['length_m']:.2f} m, {section['share_with_height']:.0%} with heights{accuracy}"
        lines.append(f"{section['name']}: {text}: {out / SECTIONS / section['dxf']}")
    for volume in measured.get("volumes", ()):
        name = volume["name"] or f"Polygon {volume['polygon']}"
        kinds = (f"{kind} {volume[f'{kind}_m3']:.2f} ± {volume[f'{kind}_sigma_m3']:.2f} m³" for kind in ("cut", "fill"))
        lines.append(f"{name}: {', '.join(kinds)}: {out / VOLUMES}")
    return lines


def measure_surface(out: Path, wanted: MeasurementRequest, threads: int) -> dict[str, Any]:
    """Cut sections and measure volumes; each kind replaces earlier measurements, or nothing changes.

    Only the holder of OUT's lock may call this.

    Args:
        out: OUT, of a run with a surface model.
        wanted: What to measure.
        threads: Number of photos processed at a time.

    Returns:
        The content of the files, for programs.

    Raises:
        SplatpipeError: if there is no surface model, or a line or a polygon misses it.
        OSError: if the disk is full or not writable.
    """
    from splatpipe.pipeline.surface.measuring.volume_file import write_volumes

    surface = _open_surface(out)
    measured: dict[str, Any] = {}
    aside = out / UNFINISHED
    shutil.rmtree(aside, ignore_errors=True)  # a killed command may have left it
    try:
        aside.mkdir()
        sections = _sections(surface, wanted.lines, aside, threads)
        volumes = _volumes(surface, wanted)
        if sections:
            write_measurements(out, "sections", surface.digests, ())  # in case this is killed before the end
            _publish(aside, own_folder(out, SECTIONS))
            write_measurements(out, "sections", surface.digests, sections)
            measured["sections"] = [_without_trace(item) for item in sections]
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    if volumes:
        measured["volumes"] = [_without_trace(item) for item in volumes]
        write_measurements(out, "volumes", surface.digests, ())
        write_volumes(out / VOLUMES, measured["volumes"], surface.crs)
        write_measurements(out, "volumes", surface.digests, volumes)
    return measured


def _open_surface(out: Path) -> _SurfaceModel:
    from splatpipe.pipeline.surface.heights.surface_file import open_surface
    from splatpipe.pipeline.surface.rasters.map_crs import open_map
    from splatpipe.pipeline.survey.crs.frames import load_frame

    run = open_run_folder(out, LINE)
    parts = run.lineage(DSM, DEPTHS, UNDISTORT, GEOREF)
    files = parts["dsm.files"].path if "dsm.files" in parts else None
    if files is None or not (files / "dsm.tif").is_file():
        raise SplatpipeError("The run has no surface model.", hint=f"Make one first: splatpipe surface {out}")
    frame = load_frame(parts["georef.frame"].path)
    model = open_surface(files / "dsm.tif", files / "dsm_confidence.tif")
    terrain = None
    below = run.lineage(DTM)
    ground = below["dtm.files"].path if "dtm.files" in below else None
    of_model = "dsm.files" in below and below["dsm.files"].digest == parts["dsm.files"].digest
    if ground is not None and of_model and (ground / "dtm.tif").is_file():
        terrain = open_surface(ground / "dtm.tif", ground / "dtm_confidence.tif")
    return _SurfaceModel(parts, frame, open_map(frame), model, terrain)


def _sections(surface: _SurfaceModel, lines: Sequence[Line], folder: Path, threads: int) -> Items:
    """Cut all sections, and write their files into a folder."""
    from splatpipe.pipeline.mvs.depth_maps import list_depth_maps
    from splatpipe.pipeline.photos.pixels.dataset import load_views
    from splatpipe.pipeline.surface.depths.run_sources import metric_depths
    from splatpipe.pipeline.surface.measuring.section_files import write_section
    from splatpipe.pipeline.surface.measuring.sections import cut_section
    from splatpipe.pipeline.surface.measuring.traces import section_trace

    if not lines:
        return []
    maps = list_depth_maps(surface.parts["depths.maps"].path, load_views(surface.parts["undistort.dataset"].path))
    sources = metric_depths(maps, surface.frame.world_from_model)
    most = min(MAX_SECTION_POINTS, MAX_TRACE_POINTS // len(lines))
    found = []
    for number, line in enumerate(lines, 1):
        section = cut_section(surface.model, line, surface.crs, sources, threads, surface.terrain)
        facts = write_section(folder, f"section-{number}", section, surface.crs)
        found.append({**facts, "trace": section_trace(section, surface.crs, most)})
    return found


def _publish(aside: Path, folder: Path) -> None:
    """Move sections to their final folder, and remove those of an earlier call."""
    made = {path.name for path in aside.iterdir()}
    for path in sorted(aside.iterdir()):
        path.replace(folder / path.name)
    for path in folder.iterdir():
        if SECTION_FILE.fullmatch(path.name) and path.name not in made:
            path.unlink()
    sync_folder(folder)


def _volumes(surface: _SurfaceModel, wanted: MeasurementRequest) -> Items:
    from splatpipe.pipeline.geometry.plan_area import PlanArea
    from splatpipe.pipeline.surface.measuring.traces import polygon_trace
    from splatpipe.pipeline.surface.measuring.volume_file import volume_facts
    from splatpipe.pipeline.surface.measuring.volumes import measure_volume
    from splatpipe.pipeline.survey.boundary import placed_area
    from splatpipe.pipeline.survey.files.boundary_file import read_boundary

    if wanted.polygons is None:
        return []
    drawing = read_boundary(wanted.polygons)
    area = placed_area(drawing, surface.frame)
    rings = sum(len(polygon) for polygon in area.polygons[:MAX_TRACED_VOLUMES])
    most = max(4, min(MAX_RING_POINTS, MAX_TRACE_POINTS // rings))
    uncertainty = surface.frame.residuals.get("uncertainty") or {}  # absent if control points georeference the run
    datum_sigma_m = float(uncertainty.get("offset_sigma_m", (0.0,))[-1])
    model = surface.ground() if wanted.model == "dtm" else surface.model
    base = surface.ground() if wanted.base == "ground" else wanted.base
    found: Items = []
    for number, (polygon, name) in enumerate(zip(area.polygons, drawing.names, strict=True), 1):
        alone = PlanArea(area.axes, (polygon,))
        volume = measure_volume(model, alone, surface.crs, base, datum_sigma_m)
        facts = {**volume_facts(number, name, volume), "model": wanted.model}
        if number <= MAX_TRACED_VOLUMES:
            facts["trace"] = polygon_trace(model, polygon, surface.crs, most)
        found.append(facts)
    return found


def _without_trace(item: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in item.items() if key != "trace"}
