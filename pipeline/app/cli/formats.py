"""``splatpipe export`` and ``splatpipe convert``: a splat in the formats that other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from splatpipe.pipeline.app.library.commands import carry_out
from splatpipe.pipeline.app.library.requests import existing_request, overrides
from splatpipe.pipeline.app.terminal.parameters import (
    FormatOption,
    JsonOption,
    MachineOptions,
    OutArgument,
    SessionOptions,
    SetOption,
    expand_user,
)
from splatpipe.pipeline.app.terminal.summary import CommandSummary
from splatpipe.pipeline.engine.errors import UsageError


def export(
    out: OutArgument,
    formats: Annotated[
        str,
        typer.Option(
            "--format", "-f", metavar="NAMES", help="Formats to make, separated by commas; existing ones are kept."
        ),
    ],
    assignments: SetOption = None,
    *,
    machine: MachineOptions,
    session: SessionOptions,
) -> None:
    """Export a finished run in more formats, to OUT/export; docs/formats.md lists which programs read them."""
    from splatpipe.pipeline.app.formats import check_possible, with_formats

    with session.summary(out) as done:
        tables = [with_formats(out, formats), *overrides(None, assignments, None).tables]
        check_possible(out, formats)
        request = existing_request(out, tables, machine.device, machine.threads)
        carry_out(request, done.watch, lambda runner: runner.walk(), wait=session.wait)


def convert(
    source: Annotated[
        Path,
        typer.Argument(metavar="IN", callback=expand_user, help="PLY, SPZ, SOG or GLB, or a trainer's model folder."),
    ],
    target: Annotated[Path, typer.Argument(metavar="OUT", callback=expand_user, help="Its extension sets the format.")],
    format_name: FormatOption = None,
    as_json: JsonOption = False,
) -> None:
    """Convert a splat file to another format; its georeference is kept."""
    with CommandSummary(target, as_json) as done:
        from splatpipe.pipeline.app.formats import convert_file, show_precision
        from splatpipe.pipeline.app.report.facts.wording import plural, size
        from splatpipe.pipeline.app.terminal.console import print_line
        from splatpipe.pipeline.splat.formats.files import format_of_name

        kind = format_of_name(target, format_name)
        if target.exists() and target.samefile(source):
            raise UsageError(f"{target} is the input file.", hint="Choose another output file.")
        facts: dict[str, Any] = convert_file(source, target, kind)
        done.details = {"convert": facts}
        print_line(f"{plural(facts['gaussians'], 'Gaussian')}, {size(facts['bytes'])}: {target}")
        show_precision(facts)
