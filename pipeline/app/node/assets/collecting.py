"""Collects what `all.zip` of a run has: its files in their places, what is made for clients, and what it lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.node.assets.archive import Entry
from splatpipe.pipeline.app.node.assets.clouds import CloudFacts, UnusableCloud, check_cloud
from splatpipe.pipeline.app.node.assets.control_points import control_geojson
from splatpipe.pipeline.app.node.assets.earth import Earth
from splatpipe.pipeline.app.node.assets.finished_run import NOT_ASKED_FOR, FinishedRun
from splatpipe.pipeline.app.node.assets.geo_glb import UnusableMesh, plan_centre, write_geo_glb
from splatpipe.pipeline.app.node.assets.geo_obj import write_geo_obj
from splatpipe.pipeline.app.node.assets.layout import (
    CAMERAS,
    CLOUD,
    CONTROL,
    GLB,
    MATERIALS,
    MESH_PLACE,
    OBJ,
    ORTHO_PICTURE,
    ORTHO_PLACE,
    PLACES,
    REPLACED,
    SHOTS,
    STATISTICS,
    TEXTURING,
    Place,
    is_safe,
)
from splatpipe.pipeline.app.node.assets.outputs import chosen
from splatpipe.pipeline.app.node.assets.rasters import (
    UnplacedRaster,
    UnusableRaster,
    check_map_tiles,
    check_raster,
    write_picture,
)
from splatpipe.pipeline.app.node.assets.shots import Flight, cameras_json, read_flight, shots_geojson
from splatpipe.pipeline.app.node.assets.statistics import run_statistics
from splatpipe.pipeline.engine.files.json_file import json_text

MESH_TEXT, MESH_MATERIALS, MESH_PAGES = "mesh/mesh.obj", "mesh/mesh.mtl", "mesh/mesh_"
NOWHERE = "the run has no place on the earth"


@dataclass
class Contents:
    """What an archive is going to have.

    Attributes:
        entries: Its entries by path.
        absences: What it lacks, in words, and why.
        notes: What else is to be said of it, as sentences.
    """

    entries: dict[str, Entry] = field(default_factory=dict)
    absences: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """What it lacks, and the notes, as lines of a log."""
        unasked = [what for what, reason in self.absences if reason == NOT_ASKED_FOR]
        lines = [f"all.zip lacks {what}: {reason}." for what, reason in self.absences if reason != NOT_ASKED_FOR]
        return [*self.notes, *lines, *([f"Not asked for: {', '.join(unasked)}."] if unasked else [])]


def collect(run: FinishedRun, work: Path, outputs: Sequence[str]) -> Contents:
    """Everything that the archive of a run is to have.

    Args:
        run: The run.
        work: Folder for files that are made for the archive.
        outputs: Paths that the archive is restricted to; none for everything.

    Raises:
        OSError: if a file cannot be read or written.
    """
    collector = _Collector(run, work, outputs)
    for place in PLACES:
        collector.add_place(place)
    collector.add_others()
    collector.add_picture()
    collector.add_mesh()
    collector.add_figures()
    return collector.contents


class _Collector:
    """Fills an archive's contents.

    Args:
        run: The run.
        work: Folder for files that are made.
        outputs: What is wanted; empty for everything.
    """

    def __init__(self, run: FinishedRun, work: Path, outputs: Sequence[str]) -> None:
        self.run, self.work, self.contents = run, work, Contents()
        self._outputs = outputs
        self._packed: set[str] = set()  # paths in OUT that have a place
        self._broken: set[str] = set()
        self._cloud: CloudFacts | None = None

    def add_place(self, place: Place) -> None:
        """Add a product that is packed as it is, after a look at it if it is a map or a cloud."""
        if place.source.endswith("/"):
            found = [name for name in self.run.files if name.startswith(place.source)]
        else:
            found = [name for name in (place.source,) if name in self.run.files]
        if place.kind and found and self._is_left_out(place):
            return
        for name in found:
            self._add_file(place.entry + name[len(place.source) :], name)
        if not found:
            self._lacks(place.entry.rstrip("/"), place.what, self.run.why_absent(place))

    def add_others(self) -> None:
        """Add all other deliverables, each under its own path."""
        for name in self.run.files:
            if name in self._broken:
                continue
            if name not in self._packed and not name.startswith(REPLACED):
                self._add_file(name, name)
            elif self._outputs and name not in self.contents.entries:
                self._add_file(name, name)  # if outputs names it as it is in OUT

    def add_picture(self) -> None:
        """Add the orthophoto as PNG."""
        if ORTHO_PLACE.entry not in self.contents.entries or not self._is_wanted(ORTHO_PICTURE):
            return
        path = self.work / Path(ORTHO_PICTURE).name
        try:
            width, height = write_picture(self.run.files[ORTHO_PLACE.source], path)
        except UnusableRaster as error:
            self._lacks(ORTHO_PICTURE, "orthophoto as PNG", str(error))
            return
        self._add(ORTHO_PICTURE, path)
        self.contents.notes.append(f"{ORTHO_PICTURE} has {width:,} x {height:,} pixels.")

    def add_mesh(self) -> None:
        """Add the textured mesh in the CRS: GLB, and OBJ with its materials and pages."""
        files, earth = self.run.files, self.run.earth
        if MESH_PLACE.source not in files or earth is None:
            reason = self.run.why_absent(MESH_PLACE) if MESH_PLACE.source not in files else "the run has no scale"
            self._lacks(GLB, MESH_PLACE.what, reason)
            return
        if not any(self._is_wanted(entry) for entry in (GLB, OBJ, MATERIALS)):
            return
        try:
            self._write_mesh(files, earth)
        except UnusableMesh as error:
            self._lacks(GLB, MESH_PLACE.what, str(error))
            return
        pages = [name for name in files if name.startswith(MESH_PAGES)]
        for name in pages:
            self._add_file(TEXTURING + Path(name).name, name)

    def _write_mesh(self, files: Mapping[str, Path], earth: Earth) -> None:
        centre = plan_centre(earth, files[MESH_PLACE.source])
        if self._is_wanted(GLB):
            target = self.work / Path(GLB).name
            write_geo_glb(files[MESH_PLACE.source], target, earth, centre)
            self._add(GLB, target)
        if MESH_TEXT in files and MESH_MATERIALS in files and self._is_wanted(OBJ):
            target = self.work / Path(OBJ).name
            write_geo_obj(files[MESH_TEXT], target, earth, centre, Path(MATERIALS).name)
            self._add(OBJ, target)
            self._add_file(MATERIALS, MESH_MATERIALS)

    def add_figures(self) -> None:
        """Add photos, lenses, surveyed points and statistics."""
        inputs, earth = self.run.inputs, self.run.earth
        ingested = inputs.part("ingest.photos")
        photos = [] if ingested is None else inputs.read_in_part("ingest.photos", "photos.json").get("photos", [])
        self._add_json(STATISTICS, run_statistics(inputs, self._cloud, photos))
        try:
            flight = self._flight()
        except (OSError, ValueError) as error:
            self._lacks(SHOTS, "photos' places", f"the model cannot be read: {error}")
            return
        if flight is None:
            self._lacks(SHOTS, "photos' places", "the run ended before its stage georef")
            return
        self._add_json(CAMERAS, cameras_json(flight))
        if earth is None or not earth.is_georeferenced:
            self._lacks(SHOTS, "photos' places", NOWHERE)
            return
        self._add_json(SHOTS, shots_geojson(flight, earth, photos))
        points = control_geojson(inputs.read("georef.control"), earth, flight.sizes())
        if points is None:
            self._lacks(CONTROL, "surveyed points", "the run had none")
        else:
            self._add_json(CONTROL, points)

    def _flight(self) -> Flight | None:
        model = self.run.inputs.part("georef.model")
        return None if model is None or self.run.inputs.part("georef.frame") is None else read_flight(model)

    def _is_left_out(self, place: Place) -> bool:
        """Whether clients could not open a product; a map without a place on the earth is packed under its own name."""
        try:
            self._open(place)
        except UnplacedRaster as error:
            self._add_file(place.source, place.source)
            self._lacks(place.entry, place.what, f"{error}; it is there as {place.source}")
            return True
        except (UnusableRaster, UnusableCloud) as error:
            self._broken.add(place.source)
            self._lacks(place.entry, place.what, str(error))
            return True
        return False

    def _open(self, place: Place) -> None:
        path = self.run.files[place.source]
        if place.kind == "map":
            check_raster(path, colours=place is ORTHO_PLACE)
        elif place.kind == "tiles":
            check_map_tiles(path)
        else:
            facts = check_cloud(path)
            self._cloud = facts if place.entry == CLOUD else self._cloud

    def _is_wanted(self, entry: str) -> bool:
        return bool(chosen([entry], self._outputs))

    def _add_file(self, entry: str, name: str) -> None:
        self._packed.add(name)
        self._add(entry, self.run.files[name])

    def _add_json(self, entry: str, value: Any) -> None:
        self._add(entry, json_text(value).encode())

    def _add(self, entry: str, content: Path | bytes) -> None:
        if not self._is_wanted(entry):
            return
        if not is_safe(entry):
            self.contents.absences.append((f"the file {entry[:80]!a}", "such names are not safe in archives"))
            return
        self.contents.entries[entry] = Entry(entry, content)

    def _lacks(self, entry: str, what: str, reason: str) -> None:
        if self._is_wanted(entry):
            self.contents.absences.append((what, reason))
