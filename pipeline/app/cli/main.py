"""The command line: thin commands over the engine, and the one place where errors become exit codes."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from splatpipe.pipeline.app.cli.batch import batch
from splatpipe.pipeline.app.cli.check import check
from splatpipe.pipeline.app.cli.edit import OrderedCommand, edit
from splatpipe.pipeline.app.cli.formats import convert, export
from splatpipe.pipeline.app.cli.help import with_help
from splatpipe.pipeline.app.cli.node import node, start
from splatpipe.pipeline.app.library.commands import carry_out, run_line, run_one_stage
from splatpipe.pipeline.app.library.requests import (
    Overrides,
    check_stage,
    existing_request,
    overrides,
    request_of,
    stages_to_rerun,
)
from splatpipe.pipeline.app.render_request import RenderRequest
from splatpipe.pipeline.app.terminal.parameters import (
    CaptureSettings,
    ConfigOption,
    JsonOption,
    LineSettings,
    MachineOptions,
    OutArgument,
    PhotosArgument,
    PresetOption,
    SeedOption,
    SessionOptions,
    SetOption,
    UntilOption,
    expand_given,
    stages,
)
from splatpipe.pipeline.app.terminal.summary import CommandSummary, for_the_user, print_json, status_as_json
from splatpipe.pipeline.engine.errors import (
    EXIT_INTERRUPTED,
    EXIT_TERMINATED,
    EXIT_USAGE,
    StopSignal,
    UsageError,
    exit_code,
)
from splatpipe.pipeline.engine.machine import available_cores

if TYPE_CHECKING:
    from splatpipe.pipeline.engine.runs.runner import Runner

app = typer.Typer(
    name="splatpipe",
    help="From a folder of drone photos to a georeferenced, quality-checked 3D Gaussian splat.",
    epilog="Details of each command: splatpipe COMMAND --help. See also: README.md, docs/README.md",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


with_help(app)(batch)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        sys.stdout.write(f"splatpipe {version('splatpipe')}\n")
        raise typer.Exit


@app.callback()
def _root(
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


@with_help(app)
def run(
    photos: PhotosArgument,
    out: OutArgument,
    preset: PresetOption = "standard",
    config: ConfigOption = None,
    *,
    settings: CaptureSettings,
    until: UntilOption = None,
    rerun: Annotated[
        list[str] | None, typer.Option(metavar="STAGE", autocompletion=stages, help="Run this stage again. Repeatable.")
    ] = None,
    rerun_from: Annotated[
        str | None,
        typer.Option(metavar="STAGE", autocompletion=stages, help="Run this stage and all later ones again."),
    ] = None,
    machine: MachineOptions,
    seed: SeedOption = None,
    session: SessionOptions,
) -> None:
    """Turn a folder of photos into a Gaussian splat; valid results of earlier runs are reused."""
    from splatpipe.pipeline.engine.config import load_preset

    with session.summary(out) as done:
        resolved = overrides(config, settings.assignments(), seed).resolve(load_preset(preset))
        again = stages_to_rerun(rerun or [], rerun_from, until)
        request = request_of(photos, out, resolved, machine.device, machine.threads)
        run_line(request, done.watch, until=until, rerun=again, wait=session.wait)


@with_help(app)
def demo(
    out: OutArgument,
    preset: PresetOption = "demo",
    *,
    settings: LineSettings,
    machine: MachineOptions,
    seed: SeedOption = None,
    session: SessionOptions,
) -> None:
    """Run the pipeline on the demo capture that ships with splatpipe."""
    from splatpipe.demo import capture_path

    given = CaptureSettings(**vars(settings))
    run(capture_path(), out, preset, settings=given, machine=machine, seed=seed, session=session)


@with_help(app)
def stage(
    name: Annotated[str, typer.Argument(metavar="NAME", autocompletion=stages, help="The stage to run.")],
    out: OutArgument,
    assignments: SetOption = None,
    shard: Annotated[
        int | None,
        typer.Option(min=1, metavar="K", help="Run only this shard; other processes may run others at the same time."),
    ] = None,
    *,
    machine: MachineOptions,
    session: SessionOptions,
) -> None:
    """Run one stage of an existing OUT again, or one of its shards; no other stage except the one that divides it."""
    with session.summary(out) as done:
        check_stage(name)
        if shard is not None and assignments:
            raise UsageError("All shards of a stage have the same options.", hint="Omit either --set or --shard.")
        request = existing_request(out, overrides(None, assignments, None).tables, machine.device, machine.threads)
        run_one_stage(name, request, done.watch, shard=shard, wait=session.wait)


@with_help(app)
def georef(
    out: OutArgument,
    gcp: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Control points: gcp_list.txt or CSV; auto, or none. Default: as before."),
    ] = None,
    assignments: SetOption = None,
    *,
    machine: MachineOptions,
    session: SessionOptions,
) -> None:
    """Georeference a finished run again, with other control points or another CRS. Unaffected results are reused."""
    with session.summary(out) as done:
        control = [] if gcp is None else [{"georef": {"control": gcp}}]
        tables = [*control, *overrides(None, assignments, None).tables]
        request = existing_request(out, tables, machine.device, machine.threads)
        carry_out(request, done.watch, lambda runner: runner.walk(), wait=session.wait)


@with_help(app)
def surface(
    out: OutArgument,
    products: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Products to make: ortho, dsm, dtm, facades, cloud, mesh; existing ones are kept. Default: "
            "ortho,dsm,dtm; for a section or a volume, dsm, or dtm if the ground is needed.",
        ),
    ] = None,
    gsd: Annotated[
        str | None,
        typer.Option(
            metavar="2cm", help="Ground pixel size of the orthophoto; cells of the surface model are twice as wide."
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            help="Source of the depths: photos, splat, or both (from photos, with holes filled from the splat)."
        ),
    ] = None,
    section: Annotated[
        list[str] | None,
        typer.Option(metavar="X1,Y1,X2,Y2", help="Cut a section between two points of the run's CRS. Repeatable."),
    ] = None,
    volume: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Measure volumes inside the polygons of a GeoJSON.")
    ] = None,
    base: Annotated[
        str,
        typer.Option(
            metavar="rim|lowest|ground|HEIGHT",
            help="Base of volumes: a plane through the rim, a level at the rim's lowest point or at HEIGHT, or the "
            "ground (DTM), filled in under what stands on it.",
        ),
    ] = "rim",
    model: Annotated[
        str,
        typer.Option(
            metavar="dsm|dtm", help="Heights of volumes: the topmost surface, or the ground without trees and machines."
        ),
    ] = "dsm",
    assignments: SetOption = None,
    *,
    machine: MachineOptions,
    session: SessionOptions,
) -> None:
    """Make surface products of a finished run: orthophoto, surface, ground, façades, cloud, mesh; sections, volumes."""
    from splatpipe.pipeline.app.surfaces import MeasurementRequest, check_possible, measure_surface, measurement_lines
    from splatpipe.pipeline.engine.quantities import parse_length
    from splatpipe.stages.products import options_for

    with session.summary(out) as done:
        wanted = MeasurementRequest.of(section or [], volume, base, model)
        products = wanted.products if products is None and wanted.anything else products
        products_table = options_for(products, None if gsd is None else parse_length(gsd, "--gsd"), source)
        tables = [products_table, *overrides(None, assignments, None).tables]
        request = existing_request(out, tables, machine.device, machine.threads)
        check_possible(out, *tables)

        def make_and_measure(runner: Runner) -> None:
            runner.walk()
            if wanted.anything:
                measured = measure_surface(out, wanted, machine.threads or available_cores())
                done.details, done.result_lines = {"surface": measured}, measurement_lines(out, measured)

        carry_out(request, done.watch, make_and_measure, wait=session.wait)


with_help(app)(export)
with_help(app)(convert)


@with_help(app)
def render(out: OutArgument, *, wanted: RenderRequest, machine: MachineOptions, as_json: JsonOption = False) -> None:
    """Render a film or stills of a finished run: along its cameras, in an orbit, or from a keyframe file."""
    with CommandSummary(out, as_json) as done:
        from splatpipe.pipeline.app.renders import render_run

        done.details = {"render": render_run(out, wanted, machine.threads or available_cores(), machine.device)}


@with_help(app)
def view(
    out: OutArgument,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 for a free one.")] = 0,
    bind: Annotated[
        str,
        typer.Option(metavar="ADDRESS", help="Address to listen on; use 0.0.0.0 in a container with a published port."),
    ] = "127.0.0.1",
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
    mark: Annotated[bool, typer.Option("--mark", help="Mark control points in the photos.")] = False,
    points: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="With --mark: CSV of the points' coordinates: name,x,y,z."),
    ] = None,
) -> None:
    """Show a run in the browser: training progress and results; with --mark, mark control points."""
    from splatpipe.pipeline.app.terminal.console import print_line
    from splatpipe.pipeline.app.view.server import ViewOptions, serve

    if points is not None and not mark:
        raise UsageError("--points needs --mark.", hint="Add --mark.")
    serve(out, ViewOptions(port, bind, browser, mark, points), print_line)


@with_help(app)
def status(out: OutArgument, as_json: JsonOption = False) -> None:
    """Show the status of each stage: what is valid, what is out of date, and why."""
    from splatpipe.pipeline.app.terminal.console import show_status
    from splatpipe.pipeline.engine.runs.line import line_status
    from splatpipe.pipeline.engine.runs.session import status_of

    with CommandSummary(out, as_json) as done:
        statuses = list(line_status(*status_of(existing_request(out))))
        done.details = {"stages": [status_as_json(status) for status in statuses]}
    if not as_json:
        show_status(statuses)


@with_help(app)
def report(out: OutArgument, as_json: JsonOption = False) -> None:
    """Write OUT/report.html and OUT/report.pdf again from the existing results."""
    from splatpipe.pipeline.app.report import PDF_FILE, make_report
    from splatpipe.pipeline.app.terminal.console import print_line
    from splatpipe.pipeline.engine.runs.run_folder import LOG_FILE, open_run_folder
    from splatpipe.stages.line import LINE

    with CommandSummary(out, as_json) as done:
        open_run_folder(out, LINE)
        path = make_report(out, out / LOG_FILE, anew=True)
        paths = [str(path), str(out / PDF_FILE)]
        done.details = {"outputs": paths}
    for each in paths:
        print_line(each)


@with_help(app)
def tidy(out: OutArgument, as_json: JsonOption = False) -> None:
    """Remove artifacts that the current configuration no longer uses."""
    from splatpipe.pipeline.app.report.facts.wording import plural, size
    from splatpipe.pipeline.app.terminal.console import print_line
    from splatpipe.pipeline.engine.runs.line import line_status
    from splatpipe.pipeline.engine.runs.lock import locked
    from splatpipe.pipeline.engine.runs.session import status_of

    with CommandSummary(out, as_json) as done:
        line, store = status_of(existing_request(out))
        with locked(store.out, notify=print_line):
            keep = [entry for status in line_status(line, store) for entry in status.to_keep]
            removed, freed = store.remove_stale(keep)
        done.details = {"removed": removed, "freed_bytes": freed}
        print_line(f"Removed {plural(removed, 'stale artifact')}, {size(freed)}.")


@app.command(hidden=True)
def clean(out: OutArgument, as_json: JsonOption = False) -> None:
    """The former name of ``tidy``."""
    from splatpipe.pipeline.app.terminal.console import print_line

    print_line("splatpipe clean is now called splatpipe tidy; the stage clean removes floaters.")
    tidy(out, as_json)


@with_help(app)
def options(preset: PresetOption = "standard") -> None:
    """List every option with its value in a preset and its description."""
    from splatpipe.pipeline.app.terminal.console import show_table
    from splatpipe.pipeline.engine.config import load_preset, lookup, option_help

    resolved = Overrides([]).resolve(load_preset(preset))
    rows = [(name, str(lookup(resolved, name)), text) for name, text in option_help(type(resolved))]
    show_table(rows, ("option", "value", "what it does"))


@with_help(app)
def doctor(
    out: Annotated[
        Path | None,
        typer.Argument(callback=expand_given, help="Folder for the results of runs."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check this machine: its capabilities, and problems to resolve before a run."""
    from splatpipe.pipeline.app.doctor import examine
    from splatpipe.pipeline.app.machine_warnings import machine_warnings
    from splatpipe.pipeline.app.terminal.console import print_line, show_table

    place = out or Path.cwd()
    findings, warnings = examine(place), machine_warnings(place)
    if as_json:
        print_json({**findings, "warnings": [warning.as_json() for warning in warnings]})
        return
    show_table([(name, str(value)) for name, value in findings.items()], ("what", "found"))
    for warning in warnings:
        print_line(f"! {warning.message} {warning.hint}")


with_help(app)(start)
with_help(app)(node)
with_help(app)(check)
with_help(app, cls=OrderedCommand)(edit)


def _stop(number: int, _frame: FrameType | None) -> NoReturn:
    raise StopSignal(EXIT_INTERRUPTED if number == signal.SIGINT else EXIT_TERMINATED)


def main() -> NoReturn:
    """Run the command line; every error is turned into a message and an exit code here."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores SIGHUP on purpose
            signal.signal(number, _stop)
    try:
        app()
    except SystemExit as error:  # typer has reported what is wrong with the call
        if error.code == EXIT_USAGE and "--json" in sys.argv:
            print_json(
                {"exit_code": EXIT_USAGE, "error": {"message": "Invalid command line; see stderr.", "hint": "--help"}}
            )
        raise
    except StopSignal as error:
        from splatpipe.pipeline.app.terminal.console import print_line

        print_line(f"{error} {error.hint}")
        sys.exit(error.exit_code)
    except Exception as error:
        from splatpipe.pipeline.app.terminal.console import show_error

        user_error = for_the_user(error)
        show_error(user_error)
        sys.exit(exit_code(user_error))
    sys.exit(0)


if __name__ == "__main__":
    main()
