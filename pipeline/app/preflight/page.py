"""The preflight's page: verdict, overlap map, findings with images, and the forecast of a run."""

from __future__ import annotations

import importlib.metadata
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatpipe.pipeline.app.page_file import page_text, printable
from splatpipe.pipeline.app.path_labels import PathLabels
from splatpipe.pipeline.app.preflight.finding_pictures import FindingPicture, finding_pictures
from splatpipe.pipeline.app.preflight.findings import RANK, Finding, Preflight, PresetForecast, Severity
from splatpipe.pipeline.app.preflight.overlap_map import overlap_map
from splatpipe.pipeline.app.report.facts.wording import count, duration, local_moment, number, plural, roughly, size
from splatpipe.pipeline.engine.files.durable import write_durably

TEMPLATES = Path(__file__).resolve().parent / "templates"
MAX_FINDINGS = 200
MAX_NAMES = 300  # photos listed per finding
MAX_CONTROL = 500  # rows
LEVELS: Mapping[Severity, Literal["note", "doubt", "bad"]] = {"error": "bad", "warning": "doubt", "note": "note"}
SIGNS = {"bad": "✗", "doubt": "!", "note": "i"}


@dataclass(frozen=True)
class FindingCard:
    """A finding's card.

    Attributes:
        finding: The finding.
        level: Its level.
        sign: The level as one character.
        pictures: Images of some of its photos.
        names: Printable names of its photos, up to a limit.
        more: Number of photos beyond the limit.
    """

    finding: Finding
    level: str
    sign: str
    pictures: list[FindingPicture]
    names: list[str]
    more: int


def write_page(preflight: Preflight, path: Path) -> None:
    """Write the page atomically.

    Args:
        preflight: The preflight's result.
        path: The output file.

    Raises:
        OSError: if it cannot be written.
        MachineError: if this installation lacks the page's style.
    """
    write_durably(path, check_page(preflight))


def check_page(preflight: Preflight) -> str:
    """The page as one self-contained HTML text.

    Raises:
        MachineError: if this installation lacks the page's style.
    """
    level, headline, text = _verdict(preflight)
    pictures = finding_pictures(preflight)
    findings = [_card(it, shown_of) for it, shown_of in zip(preflight.findings, pictures, strict=True)]
    return page_text(
        TEMPLATES,
        "check.html.j2",
        PathLabels.of(preflight.folder, preflight.folder),
        style="check.css",
        name=preflight.folder.resolve().name or "photos",
        version=importlib.metadata.version("splatpipe"),
        made=local_moment(preflight.when_s),
        took=duration(preflight.seconds),
        level=level,
        headline=headline,
        text=text,
        findings=findings[:MAX_FINDINGS],
        findings_more=max(0, len(findings) - MAX_FINDINGS),
        facts=_facts(preflight),
        drawing=overlap_map(preflight, _doubts(preflight)),
        steps=("1", "2", "3–4", "5–9", "10 or more"),
        gaps=[gap.text for gap in preflight.gaps],
        control=preflight.control[:MAX_CONTROL],
        control_more=max(0, len(preflight.control) - MAX_CONTROL),
        forecasts=[
            (_named(it), size(it.memory_bytes), roughly(it.seconds), roughly(it.cpu_seconds), size(it.disk_bytes),
             it.lacking)
            for it in preflight.forecasts
        ],
        machine=(
            f"{size(preflight.machine.memory_bytes)} of memory, {plural(preflight.machine.cores, 'processor')}, "
            f"{size(preflight.machine.free_disk_bytes)} free on the disk"
        ),
    )  # fmt: skip


def _verdict(preflight: Preflight) -> tuple[str, str, str]:
    """Level, headline and sentence at the top of the page."""
    if not preflight.photos:
        return "bad", "There are no usable photos", "No readable photo was found in the folder."
    counts = Counter(finding.severity for finding in preflight.findings)
    photos = plural(len(preflight.photos), "photo")
    if counts["error"]:
        more = f", and {plural(counts['warning'], 'warning')}" if counts["warning"] else ""
        text = (
            f"Do not leave the site yet: with {plural(counts['error'], 'error')}{more}, these {photos} cannot "
            "be used as they stand."
        )
        return "bad", "This capture cannot be reconstructed as it stands", text
    if counts["warning"]:
        which = "One point" if counts["warning"] == 1 else f"{counts['warning']:,} points"
        text = f"The {photos} can be reconstructed; the findings below cost photos, accuracy or completeness."
        return "doubt", f"{which} to resolve before you leave", text
    return "good", "No problems found", f"The {photos} can be reconstructed, as far as can be judged in advance."


def _named(forecast: PresetForecast) -> str:
    return forecast.preset if forecast.blocks == 1 else f"{forecast.preset}, in {forecast.blocks} blocks"


def _card(finding: Finding, pictures: list[FindingPicture]) -> FindingCard:
    level = LEVELS[finding.severity]
    names = [printable(name) for name in finding.photos]
    return FindingCard(finding, level, SIGNS[level], pictures, names[:MAX_NAMES], max(0, len(names) - MAX_NAMES))


def _doubts(preflight: Preflight) -> dict[str, str]:
    """The findings, by name, of each photo with a warning or an error."""
    doubts: dict[str, list[str]] = {}
    for finding in preflight.findings:
        if RANK[finding.severity] < RANK["note"]:
            for name in finding.photos:
                doubts.setdefault(name, []).append(finding.code.replace("_", " ").replace("-", " "))
    return {name: ", ".join(dict.fromkeys(codes)) for name, codes in doubts.items()}


def _facts(preflight: Preflight) -> list[tuple[str, str]]:
    photos = preflight.photos
    pixels = sum(photo.width * photo.height for photo in photos)
    times = sorted(photo.time for photo in photos if photo.time)
    placed = sum(photo.position_m is not None for photo in photos)
    pieces = sum(len(piece) > 1 for piece in preflight.components)
    matched = sum(pair.matches > 0 for pair in preflight.pairs)
    facts = [
        ("Photos", count(len(photos)) + (f", {count(len(preflight.left_out))} left out" if preflight.left_out else "")),
        ("Pixels", f"{number(pixels / 1e6 / len(photos), 1)} megapixels each, on average" if photos else ""),
        ("Cameras", count(len({photo.camera for photo in photos}))),
        ("Taken", _span(times)),
        (
            "Positions",
            "all" if placed == len(photos) else f"{count(placed) if placed else 'none'} of {count(len(photos))}",
        ),
        ("Pairs", f"{count(matched)} match of {count(len(preflight.pairs))} compared" if preflight.pairs else ""),
        ("Pieces", f"{count(pieces)} that are not connected" if pieces > 1 else ""),
    ]
    return [fact for fact in facts if fact[1]]


def _span(times: list[str]) -> str:
    if not times:
        return ""
    first, last = (time.replace("T", " ")[:16] for time in (times[0], times[-1]))
    if first == last:
        return first
    return f"{first} to {last[11:] if first[:10] == last[:10] else last}"
