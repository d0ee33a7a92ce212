"""``splatpipe edit``: crop, clean, move, rotate, scale, merge and reduce a splat, in the order of the options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from splatpipe.pipeline.app.terminal.parameters import FormatOption, JsonOption, ThreadsOption, expand_user
from splatpipe.pipeline.app.terminal.summary import CommandSummary
from splatpipe.pipeline.engine.errors import UsageError

ORDER = "splatpipe.order"
CROP, MOVE, REST = "Keep or remove", "Move, rotate, scale", "Clean, merge, reduce"


class OrderedCommand(TyperCommand):
    """A command that records the order in which its options were given, including repetitions."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse as usual, and store the options' names in their order in the context."""
        _, _, order = self.make_parser(ctx).parse_args(args=list(args))
        ctx.meta[ORDER] = [parameter.name for parameter in order]
        return super().parse_args(ctx, args)


def _repeated(metavar: str, help_text: str, panel: str) -> Any:
    return typer.Option(metavar=metavar, help=help_text, rich_help_panel=panel)


@dataclass(frozen=True)
class StepOptions:
    """The steps of an edit."""

    crop_box: Annotated[
        list[str] | None, _repeated("X1,Y1,X2,Y2", "Keep what is inside a box; with heights: X1,Y1,Z1,X2,Y2,Z2.", CROP)
    ] = None
    crop_polygon: Annotated[
        list[Path] | None, _repeated("FILE", "Keep what is inside the polygons of a GeoJSON file, in any CRS.", CROP)
    ] = None
    crop_heights: Annotated[
        list[str] | None, _repeated("LOW,HIGH", "Keep a range of heights; LOW, or ,HIGH for one limit.", CROP)
    ] = None
    cut_box: Annotated[list[str] | None, _repeated("X1,Y1,X2,Y2", "Remove what is inside a box.", CROP)] = None
    cut_polygon: Annotated[list[Path] | None, _repeated("FILE", "Remove what is inside the polygons.", CROP)] = None
    move: Annotated[list[str] | None, _repeated("EAST,NORTH,UP", "Move by a distance in metres.", MOVE)] = None
    move_to: Annotated[
        list[str] | None,
        _repeated("X,Y[,Z]", "Move the splat's centre, or the point of --about, to these coordinates.", MOVE),
    ] = None
    rotate: Annotated[
        list[str] | None,
        _repeated(
            "DEGREES[,AXIS]", "Rotate anticlockwise as seen from above, or about x, y, z or an axis X,Y,Z.", MOVE
        ),
    ] = None
    scale: Annotated[
        list[str] | None, _repeated("FACTOR", "Scale; the splat loses its georeference and metric scale.", MOVE)
    ] = None
    scale_from: Annotated[
        tuple[str, str, str] | None,
        typer.Option(
            metavar="A B LENGTH",
            help=(
                "Scale so that points A and B (X,Y,Z) are LENGTH apart, e.g. 12.40m; A stays fixed, and units become "
                "metres."
            ),
            rich_help_panel=MOVE,
        ),
    ] = None
    about: Annotated[
        list[str] | None,
        _repeated("X,Y,Z|middle", "Fixed point of the steps that follow. Default: the splat's centre.", MOVE),
    ] = None
    clean: Annotated[
        bool,
        typer.Option("--clean", help="Remove floaters and rough edges.", rich_help_panel=REST),
    ] = False
    merge: Annotated[
        list[Path] | None,
        _repeated("FILE", "Add another splat at its georeferenced position.", REST),
    ] = None
    reduce: Annotated[
        list[str] | None,
        _repeated("N|100MB", "Merge neighbouring Gaussians down to N, or until OUT is at most this size.", REST),
    ] = None


def edit(
    context: typer.Context,
    source: Annotated[
        Path, typer.Argument(metavar="IN", callback=expand_user, help="A splat of any format, or the OUT of a run.")
    ],
    out: Annotated[
        Path, typer.Argument(metavar="OUT", callback=expand_user, help="The new file; its extension sets the format.")
    ],
    *,
    steps: StepOptions,
    local: Annotated[
        bool, typer.Option("--local", help="Coordinates are in metres from the splat's origin, not in its CRS.")
    ] = False,
    format_name: FormatOption = None,
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Write pictures of the splat before and after.")
    ] = True,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Crop, clean, move, rotate, scale, merge and reduce a splat, in the order in which the steps are given."""
    with CommandSummary(out, as_json) as done:
        given = steps_in_order(context.meta[ORDER], vars(steps))
        done.details = facts = _edit(source, (out, format_name), given, (local, pictures, threads))
        _show(facts)


def steps_in_order(order: Sequence[str], options: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """The options with their values, in command-line order.

    Args:
        order: Names of all options given, including repetitions.
        options: Values of the step options; a list if an option may be repeated.

    Raises:
        UsageError: if a non-repeatable option is given twice.
    """
    left = {name: list(value) if isinstance(value, list) else [value] for name, value in options.items()}
    found = []
    for name in order:
        if name not in left:
            continue  # not a step
        if not left[name]:
            raise UsageError(
                f"--{name.replace('_', '-')} can be given only once.",
                hint="Apply it to the edited file in a second command.",
            )
        found.append((name, left[name].pop(0)))
    return found


def _edit(
    source: Path, target: tuple[Path, str | None], given: Sequence[tuple[str, Any]], how: tuple[bool, bool, int]
) -> dict[str, Any]:
    from splatpipe.pipeline.app.terminal.console import RunConsole
    from splatpipe.pipeline.edit.editing import EditTask, edit_splat
    from splatpipe.pipeline.edit.size import OutputFile
    from splatpipe.pipeline.edit.sources import open_source
    from splatpipe.pipeline.edit.steps import parse_steps
    from splatpipe.pipeline.engine.events import EventReporter
    from splatpipe.pipeline.engine.machine import available_cores
    from splatpipe.pipeline.raster.threads import same_bits
    from splatpipe.pipeline.splat.formats.files import format_of_name

    local, pictures, threads = how
    output = OutputFile(target[0], format_of_name(*target))
    parse_steps(given, output, local)  # invalid steps are reported before anything is opened
    found = open_source(source)
    steps = parse_steps(given, output, local, found.trained_on())
    task = EditTask(found, output, steps, pictures)
    console = RunConsole()
    try:
        with same_bits(threads or available_cores()):
            return edit_splat(task, EventReporter("edit", console))
    finally:
        console.close()


def _show(facts: Mapping[str, Any]) -> None:
    from splatpipe.pipeline.app.formats import show_precision
    from splatpipe.pipeline.app.report.facts.wording import plural
    from splatpipe.pipeline.app.terminal.console import print_line

    for step in facts["steps"]:
        before, after = step["gaussians"]
        arrow = "" if before == after else f"{before:,} → "
        change = f"{arrow}{plural(after, 'Gaussian')}"
        print_line(f"{step['step']}: {change}")
    show_precision({**facts, "warnings": []})  # told while they were found
    for path in facts["outputs"]:
        print_line(path)
