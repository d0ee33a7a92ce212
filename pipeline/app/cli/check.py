"""``splatpipe check``: the preflight, in the field before leaving."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from splatpipe.pipeline.app.library.requests import overrides
from splatpipe.pipeline.app.terminal.parameters import (
    ConfigOption,
    JsonOption,
    PhotosArgument,
    SetOption,
    ThreadsOption,
)
from splatpipe.pipeline.app.terminal.summary import CommandSummary
from splatpipe.pipeline.engine.errors import EXIT_INPUT, MachineError

if TYPE_CHECKING:
    from splatpipe.pipeline.app.preflight.findings import Preflight

PAGE = "check.html"
PRESETS = ("preview", "standard", "high")
SIGNS = {"error": "✗", "warning": "!", "note": "·"}


def check(
    photos: PhotosArgument,
    config: ConfigOption = None,
    assignments: SetOption = None,
    page: Annotated[
        Path, typer.Option("--output", "-o", help="The page to write. Default: check.html in the current folder.")
    ] = Path(PAGE),
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Check a capture while still on site: its problems, and the time and memory of a run."""
    page = page.expanduser()
    with CommandSummary(page, as_json) as done, TemporaryDirectory(prefix="splatpipe-check-") as scratch:
        from splatpipe.pipeline.app.preflight.examination import examine_capture
        from splatpipe.pipeline.app.preflight.findings import as_json as preflight_as_json
        from splatpipe.pipeline.app.preflight.page import write_page
        from splatpipe.pipeline.app.terminal.console import RunConsole, print_line
        from splatpipe.pipeline.engine.config import load_preset
        from splatpipe.pipeline.engine.events import EventReporter
        from splatpipe.pipeline.engine.machine import available_cores

        given = overrides(config, assignments, None)
        configs = {preset: given.resolve(load_preset(preset)) for preset in PRESETS}
        console = RunConsole()
        try:
            report = EventReporter("check", console)
            preflight = examine_capture(photos, configs, threads or available_cores(), report, Path(scratch))
        finally:
            console.close()
        done.details = facts = preflight_as_json(preflight)
        _show(preflight)  # first: the findings are shown even if the page cannot be written
        try:
            write_page(preflight, page)
        except OSError as error:
            raise MachineError(
                f"Cannot write the page {page}: {error.strerror}.", hint="Choose another path: -o FILE."
            ) from error
        failed = preflight.worst == "error"
        done.details = {**facts, "exit_code": EXIT_INPUT if failed else 0, "outputs": [str(page)]}
        print_line(str(page))
    if failed:
        raise typer.Exit(EXIT_INPUT)


def _show(preflight: Preflight) -> None:
    from splatpipe.pipeline.app.terminal.console import print_line

    for finding in preflight.findings:
        print_line(f"{SIGNS[finding.severity]} {finding.message} {finding.hint}".rstrip())
    for forecast in preflight.forecasts:
        text = f"{forecast.preset}: {forecast.memory_bytes / 1e9:.1f} GB of memory, {forecast.seconds / 60.0:.0f} min, "
        text += f"{forecast.disk_bytes / 1e9:.1f} GB on the disk"
        text += f", trained in {forecast.blocks} blocks" if forecast.blocks > 1 else ""
        print_line(f"  {text}" + (f"; lacks {forecast.lacking}" if forecast.lacking else ""))
    verdict = {
        "error": "This capture cannot be reconstructed as it stands",
        "warning": "It can be reconstructed, with the limitations above",
    }
    print_line(f"{len(preflight.photos)} photos. {verdict.get(preflight.worst or '', 'No problems found')}.")
