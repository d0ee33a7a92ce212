"""What the preflight says of a capture: findings, and what they rest on."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from splatpipe.pipeline.engine.stage import JSON

Severity = Literal["error", "warning", "note"]
RANK: dict[Severity, int] = {"error": 0, "warning": 1, "note": 2}
Place = tuple[float, float]  # east, north about the preflight's origin, metres


@dataclass(frozen=True)
class Finding:
    """Something that whoever flew should know.

    Attributes:
        code: What it is, for programs: ``blurred``, ``gap``, …
        severity: ``error`` where nothing can be reconstructed, ``warning`` where photos or accuracy are lost, ``note``.
        message: One sentence.
        hint: What to do about it; empty where there is nothing to do.
        photos: Names of the photos that it is about, sorted; empty where it is about the whole capture.
    """

    code: str
    severity: Severity
    message: str
    hint: str = ""
    photos: tuple[str, ...] = ()


@dataclass(frozen=True)
class PhotoFacts:
    """A photo that can be used.

    Attributes:
        name: Relative to the folder.
        width: Of the stored grid, pixels.
        height: Likewise.
        orientation: EXIF's, 1 to 8: how to turn it for people.
        camera: Number of its camera group.
        time: ISO 8601, local to the camera; None when EXIF does not say.
        position_m: East, north, up about the origin; None without a position.
        footprint_m: Corners of what it shows of the ground; None where that is not known.
        sharpness: Detail of its finest scales over that of its neighbours in what both show: 1 is as sharp as they,
            less is duller; None where nothing could be compared.
        brightness_ev: Exposure values by which it is brighter than its neighbours in what both show; None likewise.
        mean_level: Mean grey level, 0 to 255.
        matched: With so many other photos.
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
    """A file that takes no part, and why: ``reason`` ends a sentence that starts with the name."""

    name: str
    reason: str


@dataclass(frozen=True)
class MatchedPair:
    """Two photos that were compared (numbers in ``Preflight.photos``, first < second), and keypoints that agree."""

    first: int
    second: int
    matches: int


@dataclass(frozen=True)
class Gap:
    """Where overlap is missing: its outline, and what is told of it."""

    outline_m: tuple[Place, ...]
    text: str


@dataclass(frozen=True)
class ControlPlace:
    """A point of the control file.

    Attributes:
        name: As written.
        kind: Its role in the survey.
        position_m: East, north.
        photos: So many photos may show it, by their footprints; None where these are not known.
        marks: So many photos have it marked.
    """

    name: str
    kind: Literal["control", "check"]
    position_m: Place
    photos: int | None
    marks: int


@dataclass(frozen=True)
class PresetForecast:
    """What a run would need with a preset.

    Attributes:
        preset: Its name.
        memory_bytes: Peak of its hungriest stage.
        cpu_seconds: Of all stages.
        seconds: On this machine's processors.
        disk_bytes: That OUT takes.
        lacking: Why it does not fit this machine; empty when it does.
        blocks: That the scene is trained in; 1 where it is trained whole.
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
    """What there is here to run it: bytes of memory, processors, bytes free on the disk."""

    memory_bytes: int
    cores: int
    free_disk_bytes: int


@dataclass(frozen=True)
class Preflight:
    """All that was found.

    Attributes:
        folder: The user's; photos' names are relative to ``photo_root`` of it.
        photos: Those that can be used, sorted by name.
        left_out: The others.
        findings: The worst first.
        origin: Latitude and longitude, degrees, of what metres count from; None without positions.
        pairs: What the quick match compared.
        components: Photos (numbers) that hang together by these, the largest first; orphans are those of one.
        gaps: Where overlap is missing.
        control: The control file's points; empty without one, or where its CRS or the photos' positions are not known.
        forecasts: A preset each.
        machine: Which they are for.
        when_s: When it was made, seconds since 1970.
        seconds: How long that took.
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

    @property
    def orphans(self) -> tuple[int, ...]:
        """Photos (numbers) that hang together with no other."""
        return tuple(sorted(piece[0] for piece in self.components if len(piece) == 1))

    @property
    def worst(self) -> Severity | None:
        """Severity of the worst finding; None without any."""
        return min((finding.severity for finding in self.findings), key=RANK.__getitem__, default=None)


def as_json(preflight: Preflight) -> JSON:
    """What ``check --json`` prints; no path but the photos' names."""
    value = asdict(preflight)
    del value["folder"]
    return value | {"verdict": preflight.worst or "fine", "orphans": list(preflight.orphans)}


def worst_first(findings: list[Finding]) -> tuple[Finding, ...]:
    """The findings in the order in which they are told."""
    return tuple(sorted(findings, key=lambda finding: (RANK[finding.severity], finding.code, finding.photos)))
