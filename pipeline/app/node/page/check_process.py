"""A process that checks an uploaded capture, so that the node itself loads no photo: prints JSON, one object a line.

It competes with runs for processors on purpose: somebody waits for it, and it takes a minute where they take hours.

    python -m splatpipe.pipeline.app.node.page.check_process PHOTOS PAGE THREADS OPTIONS

PAGE is where to write the preflight's page; OPTIONS are tables over the presets' options, as JSON. Progress is
``{"done", "total", "what"}``, the last line ``{"check": …}`` or ``{"error": …}``.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpipe.pipeline.app.report.facts.wording import plural
from splatpipe.pipeline.engine.errors import SplatpipeError

if TYPE_CHECKING:
    from splatpipe.pipeline.app.preflight.findings import Preflight
    from splatpipe.pipeline.engine.events import Event

MODULE = "splatpipe.pipeline.app.node.page.check_process"
SCRATCH = "scratch"  # beside PAGE: frames of a film, gigabytes
PRESETS = ("preview", "standard", "high")
TELL_S = 0.3  # between two lines of progress
MOST_FINDINGS = 60
MOST_CHARACTERS = 600  # of a message or a hint; the page has all of it


def main() -> None:
    """Check the capture on the command line."""
    photos, page, threads, options = sys.argv[1:]
    try:
        _tell({"check": _check(Path(photos), Path(page), int(threads), json.loads(options))})
    except SplatpipeError as error:
        text = f"{error.message} {error.hint}".strip()
        _tell({"error": text.replace(f"{photos}/", "").replace(photos, "the upload")})  # no path of this machine


def _check(photos: Path, page: Path, threads: int, options: dict[str, Any]) -> dict[str, Any]:
    from splatpipe.pipeline.app.library.requests import Overrides
    from splatpipe.pipeline.app.preflight.examination import examine_capture
    from splatpipe.pipeline.app.preflight.page import write_page
    from splatpipe.pipeline.engine.config import load_preset
    from splatpipe.pipeline.engine.events import EventReporter

    configs = {preset: Overrides([options]).resolve(load_preset(preset)) for preset in PRESETS}
    scratch = page.with_name(SCRATCH)  # the node removes it, too: this process may be ended at any time
    scratch.mkdir()
    try:
        preflight = examine_capture(photos, configs, threads, EventReporter("check", _Progress()), scratch)
        write_page(preflight, page)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return summary(preflight)


def summary(preflight: Preflight) -> dict[str, Any]:
    """What our page shows of a preflight: the verdict, the findings without their photos, the forecasts."""
    headline, text = _verdict(preflight)
    return {
        "verdict": preflight.worst or "fine",
        "headline": headline,
        "text": text,
        "photos": len(preflight.photos),
        "findings": [
            {"severity": each.severity, "message": each.message[:MOST_CHARACTERS], "hint": each.hint[:MOST_CHARACTERS]}
            for each in preflight.findings[:MOST_FINDINGS]
        ],
        "forecasts": [
            {
                "preset": each.preset,
                "seconds": round(each.seconds),
                "memory_bytes": each.memory_bytes,
                "disk_bytes": each.disk_bytes,
                "lacking": each.lacking,
                "blocks": each.blocks,
            }
            for each in preflight.forecasts
        ],
        "control": len(preflight.control),
        "marked": sum(point.marks >= 2 for point in preflight.control),
    }


def _verdict(preflight: Preflight) -> tuple[str, str]:
    """Headline and sentence."""
    photos, counts = plural(len(preflight.photos), "photo"), Counter(each.severity for each in preflight.findings)
    if not preflight.photos:
        return "There are no usable photos", "No readable photo was found."
    if counts["error"]:
        return "This capture cannot be reconstructed as it stands", f"A run of these {photos} would most likely fail."
    if counts["warning"]:
        text = "The photos can be reconstructed; what follows costs photos, accuracy or completeness."
        return f"{plural(counts['warning'], 'point')} to look at before the run", text
    return "No problems found", f"The {photos} can be reconstructed, as far as can be judged in advance."


class _Progress:
    """Prints progress, not too often."""

    def __init__(self) -> None:
        self._told_s = -TELL_S

    def __call__(self, event: Event) -> None:
        now = time.monotonic()
        if event.kind == "progress" and now - self._told_s >= TELL_S:
            self._told_s = now
            _tell({name: event.data[name] for name in ("done", "total", "what")})


def _tell(message: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
