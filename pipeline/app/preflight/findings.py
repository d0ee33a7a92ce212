"""The results of the preflight: findings, and the facts they are based on."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.photos.files.photo_list import photo_root

if TYPE_CHECKING:
    from splatpipe.pipeline.survey.adjustment.predicted_flight import PredictedAccuracy

Severity = Literal["error", "warning", "note"]
RANK: dict[Severity, int] = {"error": 0, "warning": 1, "note": 2}
Place = tuple[float, float]  # east, north of the preflight's origin, metres


@dataclass(frozen=True)
class Finding:
    """Something the pilot should know.

    Attributes:
        code: Its kind, for programs: ``blurred``, ``gap``, …
        severity: ``error`` if nothing can be reconstructed, ``warning`` if photos or accuracy are lost, ``note``.
        message: One sentence.
        hint: What to do about it; empty if there is nothing to do.
        photos: Sorted names of the photos concerned; empty if it concerns the whole capture.
    """

    code: str
    severity: Severity
    message: str
    hint: str = ""
    photos: tuple[str, ...] = ()


@dataclass(frozen=True)
class PhotoFacts:
    """A usable photo.

    Attributes:
        name: Its path relative to the folder.
        width: Width of the stored pixel grid.
        height: Height of the stored pixel grid.
        orientation: EXIF orientation, 1 to 8.
        camera: Number of its camera group.
        time: ISO 8601, local to the camera; None if EXIF has none.
        position_m: East, north, up of the origin; None without a position.
        footprint_m: Corners of its ground footprint; None if unknown.
        sharpness: Fine detail relative to that of its neighbours in the area both show: 1 is equally sharp, less is
            more blurred; None if nothing could be compared.
        brightness_ev: Brightness relative to its neighbours in the area both show, EV; None likewise.
        mean_level: Mean grey level, 0 to 255.
        matched: Number of other photos it matches.
    """

    name: str
    width: int
    height: int
    orientation: int
    camera: int
    time: str | None
    position_m: tuple[float, float, float] | None = None
    footprint_m: tuple[Place, ...] | None = None
    sharpness: float | None = None
    brightness_ev: float | None = None
    mean_level: float | None = None
    matched: int = 0


@dataclass(frozen=True)
class LeftOutPhoto:
    """An excluded file; ``reason`` completes a sentence that starts with the name."""

    name: str
    reason: str


@dataclass(frozen=True)
class MatchedPair:
    """Two matched photos (indices into ``Preflight.photos``, first < second) and their number of inlier keypoints."""

    first: int
    second: int
    matches: int


@dataclass(frozen=True)
class Gap:
    """An area without enough overlap: its outline and its description."""

    outline_m: tuple[Place, ...]
    text: str


@dataclass(frozen=True)
class ControlPlace:
    """A point of the GCP file.

    Attributes:
        name: Its name as written.
        kind: Its role in the survey.
        position_m: East, north.
        photos: Number of photos that may show it, by their footprints; None if these are unknown.
        marks: Number of photos in which it is marked.
    """

    name: str
    kind: Literal["control", "check"]
    position_m: Place
    photos: int | None
    marks: int


@dataclass(frozen=True)
class PresetForecast:
    """The forecast of a run with a preset.

    Attributes:
        preset: The preset's name.
        memory_bytes: Peak memory of the most demanding stage.
        cpu_seconds: CPU seconds of all stages.
        seconds: Duration on this machine's processors.
        disk_bytes: Size of OUT.
        lacking: Why it does not fit this machine; else empty.
        blocks: Number of blocks in which the scene is trained; 1 if it is not divided.
    """

    preset: str
    memory_bytes: int
    cpu_seconds: float
    seconds: float
    disk_bytes: int
    lacking: str = ""
    blocks: int = 1


@dataclass(frozen=True)
class MachineFacts:
    """This machine's resources: bytes of memory, processors, bytes free on the disk."""

    memory_bytes: int
    cores: int
    free_disk_bytes: int


@dataclass(frozen=True)
class Preflight:
    """The result of a preflight.

    Attributes:
        folder: The user's folder, or film.
        photos: The usable photos, sorted by name.
        left_out: The excluded files.
        findings: The findings, worst first.
        origin: Latitude and longitude, degrees, of the origin of metric positions; None without positions.
        pairs: The pairs from the quick match.
        components: Connected components of photos (indices), largest first; orphans are components of one.
        gaps: Areas without enough overlap.
        control: The GCP file's points; empty without one, or if its CRS or the photos' positions are unknown.
        forecasts: One forecast per preset.
        machine: The machine they apply to.
        when_s: Time of the preflight, seconds since 1970.
        seconds: Its duration.
        heights: Predicted accuracy of the ground; None without accurate positions, or if nothing can be said.
        frames: The folder of a film's frames; None for photos.
    """

    folder: Path
    photos: tuple[PhotoFacts, ...]
    left_out: tuple[LeftOutPhoto, ...]
    findings: tuple[Finding, ...]
    origin: tuple[float, float] | None
    pairs: tuple[MatchedPair, ...]
    components: tuple[tuple[int, ...], ...]
    gaps: tuple[Gap, ...]
    control: tuple[ControlPlace, ...]
    forecasts: tuple[PresetForecast, ...]
    machine: MachineFacts
    when_s: float
    seconds: float
    heights: PredictedAccuracy | None = None
    frames: Path | None = None

    @property
    def root(self) -> Path:
        """The folder that photo names are relative to."""
        return photo_root(self.folder) if self.frames is None else self.frames

    @property
    def orphans(self) -> tuple[int, ...]:
        """Indices of photos that match no other."""
        return tuple(sorted(piece[0] for piece in self.components if len(piece) == 1))

    @property
    def worst(self) -> Severity | None:
        """Severity of the worst finding; None without any."""
        return min((finding.severity for finding in self.findings), key=RANK.__getitem__, default=None)


def as_json(preflight: Preflight) -> JSON:
    """The output of ``check --json``; it has no paths other than the photos' names."""
    value = asdict(preflight)
    del value["folder"], value["frames"]
    return value | {"verdict": preflight.worst or "fine", "orphans": list(preflight.orphans)}


def worst_first(findings: list[Finding]) -> tuple[Finding, ...]:
    """The findings sorted by severity, worst first."""
    return tuple(sorted(findings, key=lambda finding: (RANK[finding.severity], finding.code, finding.photos)))
