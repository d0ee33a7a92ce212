"""Runs the whole preflight on a capture, cheapest checks first."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.app.preflight.boundary import boundary_findings
from splatpipe.pipeline.app.preflight.findings import (
    ControlPlace,
    Finding,
    Gap,
    MachineFacts,
    MatchedPair,
    PhotoFacts,
    Preflight,
    PresetForecast,
    worst_first,
)
from splatpipe.pipeline.app.preflight.heights import height_findings, predict_heights
from splatpipe.pipeline.app.preflight.intake import Intake, read_capture
from splatpipe.pipeline.app.preflight.overlap import (
    MatchGraph,
    flight_of,
    gap_findings,
    match_quickly,
    overlap_findings,
    swap_findings,
)
from splatpipe.pipeline.app.preflight.photo_quality import (
    find_blurred,
    find_copies,
    find_exposures,
    find_little_texture,
    sharpness,
)
from splatpipe.pipeline.app.preflight.places import (
    control_findings,
    footprint,
    origin_of,
    scale_bar_findings,
)
from splatpipe.pipeline.engine.machine import available_cores, available_memory_bytes
from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.runs.needs import whole
from splatpipe.pipeline.engine.runs.source import RunSource, is_film, open_source
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.intake.detail import DIRECTIONS
from splatpipe.pipeline.photos.intake.too_few import MIN_PHOTOS
from splatpipe.pipeline.sfm.matching.comparison import brighter_ev, detail_loss
from splatpipe.pipeline.sfm.matching.keypoints import single_threaded_opencv
from splatpipe.pipeline.sfm.matching.quick_match import QuickFeatures, quick_features

if TYPE_CHECKING:
    from splatpipe.stages.options import LineConfig

NOTHING = MatchGraph({}, ())


@dataclass(frozen=True)
class PhotoExamination:
    """Results of examining the photos' content.

    Attributes:
        findings: Findings about the photos.
        overlap: Result of the quick match.
        gaps: Gaps in the overlap.
        sharpness: Sharpness of each photo relative to its neighbours.
        brighter_ev: Brightness of each photo relative to its neighbours, EV.
        levels: Mean grey level of each photo.
    """

    findings: tuple[Finding, ...]
    overlap: MatchGraph
    gaps: tuple[Gap, ...]
    sharpness: Float64[np.ndarray, " n"]
    brighter_ev: Float64[np.ndarray, " n"]
    levels: tuple[float, ...]


def examine_capture(
    photos: Path, configs: Mapping[str, LineConfig], threads: int, report: Reporter, scratch: Path
) -> Preflight:
    """Examine a capture as far as a minute or two allow.

    Args:
        photos: The user's folder or film.
        configs: Configurations of the run that would follow, by preset; the files of the first one are used.
        threads: Number of threads.
        report: Receives the progress.
        scratch: A folder for a film's frames, which the page of findings shows.

    Raises:
        SplatpipeError: if there is no such folder, or a file that an option names.
    """
    from splatpipe.stages.forecast.needs import has_control
    from splatpipe.stages.line import LINE

    began_s, when_s = time.monotonic(), time.time()
    folder = photos.expanduser().resolve()
    config = next(iter(configs.values()))
    # No OUT is written: any folder outside the photos will do.
    source = open_source(photos, folder.parent / f"{folder.name}-out", LINE, config)
    intake, findings = read_capture(source, config, threads, report, scratch)
    if source.models is not None and source.models.note:
        findings.append(Finding("models", "note", source.models.note))
    examination = examine_photos(intake, threads, report)
    control, control_problems = _control(source, config, intake)
    heights = predict_heights(source, config, intake, report)
    controlled = any(place.kind == "control" for place in control)
    findings += [*examination.findings, *height_findings(intake, heights, controlled), *control_problems]
    if (boundary := source.part_path("source.boundary")).is_file():
        controlled = source.part_path("source.control").is_file()
        findings += boundary_findings(boundary, config.georef, intake.positions.positions, controlled)
    forecasts, machine = forecast_presets(intake, has_control(source), configs, threads)
    return Preflight(
        folder=source.folder,
        photos=_facts(intake, examination),
        left_out=intake.left_out,
        findings=worst_first(findings),
        origin=origin_of(intake),
        pairs=tuple(MatchedPair(i, j, count) for (i, j), count in sorted(examination.overlap.matches.items())),
        components=examination.overlap.pieces,
        gaps=examination.gaps,
        control=control,
        forecasts=forecasts,
        machine=machine,
        heights=heights,
        frames=scratch if is_film(source.folder) else None,
        when_s=when_s,
        seconds=round(time.monotonic() - began_s, 3),
    )


def examine_photos(intake: Intake, threads: int, report: Reporter) -> PhotoExamination:
    """Read the photos, match them quickly, and compare their quality where they match."""
    count = len(intake.photos)
    unknown = np.full(count, np.nan)
    if count < MIN_PHOTOS:
        return PhotoExamination((), NOTHING, (), unknown, unknown, (float("nan"),) * count)
    names = [photo.name for photo in intake.photos]
    quick: list[QuickFeatures] = []
    with single_threaded_opencv():
        for found in ordered_map(quick_features, intake.photos, threads):
            quick.append(found)
            report.progress(len(quick), count, "examining photos", "photos")
        overlap = match_quickly(intake.layout, quick, threads, report)
    dull = detail_loss(quick, overlap.found)
    assert dull.shape == (count, DIRECTIONS)
    steps = brighter_ev(quick, overlap.found)
    flight = flight_of(intake.layout, overlap)
    missing, gaps = gap_findings(names, flight)
    findings = [
        *find_blurred(intake.photos, dull),
        *find_little_texture(quick),
        *find_exposures(intake.photos, quick, steps),
        *find_copies(intake.photos, quick),
        *overlap_findings(names, overlap),
        *swap_findings(names, flight),
        *missing,
    ]
    levels = tuple(found.brightness.mean_level for found in quick)
    return PhotoExamination(tuple(findings), overlap, tuple(gaps), sharpness(dull), steps, levels)


def _control(source: RunSource, config: LineConfig, intake: Intake) -> tuple[tuple[ControlPlace, ...], list[Finding]]:
    path = source.part_path("source.control")
    bars = scale_bar_findings(source.part_path("source.scale_bars"))
    if not path.is_file():
        return (), bars
    findings, places = control_findings(path, intake, config.georef)
    return tuple(places), [*findings, *bars]


def forecast_presets(
    intake: Intake, control: bool, configs: Mapping[str, LineConfig], threads: int
) -> tuple[tuple[PresetForecast, ...], MachineFacts]:
    """Forecast what a run with each preset would need, and whether this machine has it."""
    from splatpipe.stages.forecast.needs import RunForecast, machine_speed
    from splatpipe.stages.forecast.training import CaptureSize

    disk = shutil.disk_usage(Path.cwd())
    machine = MachineFacts(available_memory_bytes(), available_cores(), disk.free)
    if len(intake.photos) < MIN_PHOTOS:
        return (), machine
    megapixels = float(np.median([photo.width * photo.height for photo in intake.photos])) / 1e6
    shape = float(np.median([min(photo.width / photo.height, photo.height / photo.width) for photo in intake.photos]))
    size = CaptureSize(len(intake.photos), megapixels, bool(intake.layout.located().mean() > 0.5), shape, control)
    speed = machine_speed()
    forecasts = []
    for preset, config in configs.items():
        run = RunForecast.of(size, config, threads, machine.memory_bytes)
        need = whole(run.needs(speed))
        disk_bytes = need.disk_bytes + need.scratch_bytes
        lacking = []
        if 0 < machine.memory_bytes < need.memory_bytes:
            lacking.append(
                f"{need.memory_bytes / 1e9:.1f} GB of memory, of which this machine has "
                f"{machine.memory_bytes / 1e9:.1f}"
            )
        if disk.free < disk_bytes:
            lacking.append(f"{disk_bytes / 1e9:.1f} GB of disk, of which {disk.free / 1e9:.1f} are free here")
        forecasts.append(
            PresetForecast(
                preset,
                need.memory_bytes,
                need.cpu_seconds,
                need.seconds(threads),
                disk_bytes,
                "; ".join(lacking),
                run.training.blocks,
            )
        )
    return tuple(forecasts), machine


def _facts(intake: Intake, examination: PhotoExamination) -> tuple[PhotoFacts, ...]:
    places = intake.layout.positions_m
    partners = examination.overlap.partners(len(intake.photos))
    return tuple(
        PhotoFacts(
            name=photo.name,
            width=photo.width,
            height=photo.height,
            orientation=photo.exif.orientation,
            camera=intake.camera_of[photo.name],
            time=photo.exif.time,
            position_m=_round_position(places[k]),
            footprint_m=footprint(intake.layout.views, k),
            sharpness=_number(examination.sharpness[k]),
            brightness_ev=_number(examination.brighter_ev[k]),
            mean_level=_number(examination.levels[k]),
            matched=partners[k],
        )
        for k, photo in enumerate(intake.photos)
    )


def _number(value: float) -> float | None:
    return round(float(value), 3) if np.isfinite(value) else None


def _round_position(place: Float64[np.ndarray, " 3"]) -> tuple[float, float, float] | None:
    if not np.isfinite(place).all():
        return None
    east, north, up = (round(float(value), 2) for value in place)
    return east, north, up
