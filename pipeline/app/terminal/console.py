"""Shows events and errors: a progress bar with rate and time left on a terminal, else plain lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape as without_markup
from rich.panel import Panel
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from splatpipe.pipeline.app.report.facts.wording import duration
from splatpipe.pipeline.app.report.verdict import CAMERAS, Verdict
from splatpipe.pipeline.app.terminal.running_stage import RunningStage, ShardTimes, Step
from splatpipe.pipeline.app.terminal.sentences import sentence
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.line import StageStatus
from splatpipe.pipeline.engine.stage import JSON, stage_name

PLAIN_INTERVAL_S = 10.0  # between progress lines in a log file
PLAIN_WIDTH = 120  # columns of a table in a log file
MIN_OFFSET_M = 0.01  # smallest offset of a flight's positions that is shown
MAX_POINTS = 40  # more are only in metrics.json
GROUPS = {"gps": "photo positions", "control": "control points", "check": "check points"}
MARKS = {"good": ("✓", "green"), "doubt": ("!", "yellow"), "bad": ("✗", "red")}
COLOURS = {"valid": "green", "stale": "yellow", "missing": "red", "waiting": "dim"}
# Control characters with which a file name could control a terminal; tab and line feed are kept.
CONTROLS = dict.fromkeys((*range(9), *range(11, 32), *range(127, 160)), "\ufffd")


class _RateColumn(ProgressColumn):
    """Done, total and unit, and the rate per second."""

    def render(self, task: Task) -> Text:
        unit = task.fields.get("unit", "")
        rate = f"  {_rate(task.speed, unit)}" if task.speed else ""
        return Text(f"{_count(task.completed)}/{_count(task.total or 0)} {unit}{rate}", style="cyan")


def _rate(per_second: float, unit: str) -> str:
    if per_second < 1:
        return f"{1 / per_second:.1f} s each"
    return f"{per_second:.{1 if per_second < 100 else 0}f} {unit}/s"


def _count(value: float) -> str:
    return f"{value:,.0f}"


class RunConsole:
    """Shows a run's events on stderr; a sink for the runner."""

    def __init__(self) -> None:
        self._console = Console(file=sys.stderr, highlight=False, emoji=False)
        self._order: list[str] = []
        self._live: Progress | None = None
        self._running: dict[str, RunningStage] = {}
        self._shards = ShardTimes()

    def __call__(self, event: Event) -> None:
        show = getattr(self, f"_{event.kind}", None)
        if show is not None:
            show(event.stage, event.data)

    def close(self) -> None:
        """Remove the bars, so that further output starts on its own line."""
        self._running.clear()
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _run_started(self, _stage: str, data: Mapping[str, JSON]) -> None:
        self.close()
        self._order = list(data["stages"])

    def _stage_started(self, stage: str, data: Mapping[str, JSON]) -> None:
        now_s = time.monotonic()
        shown = self._running[stage] = RunningStage(now_s, now_s)
        self._shards.begin(stage, None if stage in self._order else data.get("shard"))  # None: the shard is run alone
        if not self._console.is_terminal:
            self._console.print(f"{self._label(stage)} started ({data['reason']})", markup=False)
            return
        if self._live is None:
            self._live = self._bars()
        shown.task = self._live.add_task(escape(f"{self._label(stage)} ({data['reason']})"), total=None, unit="")

    def _bars(self) -> Progress:
        bars = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            _RateColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
            speed_estimate_period=60,
        )
        bars.start()
        return bars

    def _progress(self, stage: str, data: Mapping[str, JSON]) -> None:
        done, total, what, unit = data["done"], data["total"], str(data["what"]), str(data["unit"])
        now_s = time.monotonic()
        shown = self._running.setdefault(stage, RunningStage(now_s))
        begins = what != shown.step.what or done < shown.done
        shown.done = done
        if begins:
            shown.step = Step(what, now_s, done)
        of_all = self._shards.left(stage, now_s - shown.began_s, done, total) if unit == "iterations" else ""
        if self._live is not None and shown.task is not None:
            description = escape(f"{self._label(stage)} {what}{of_all}")
            if begins:
                self._live.reset(shown.task, total=total)
            self._live.update(shown.task, completed=done, total=total, description=description, unit=unit)
        elif not self._console.is_terminal and now_s - shown.printed_s > PLAIN_INTERVAL_S:
            shown.printed_s = now_s
            left_s = shown.step.left_s(now_s, done, total)
            left = "" if left_s is None else f", about {duration(left_s)} left"
            self._console.print(
                f"{self._label(stage)} {what}: {_count(done)}/{_count(total)} {unit}{left}{of_all}", markup=False
            )

    def _stage_finished(self, stage: str, data: Mapping[str, JSON]) -> None:
        self._ended(stage)
        self._shards.end(stage, float(data["seconds"]))
        self._line("✓", "green", stage, f"{duration(data['seconds'])}  {sentence(stage, data['summary'])}")

    def _stage_reused(self, stage: str, data: Mapping[str, JSON]) -> None:
        self._shards.end(stage, float(data["seconds"]))
        self._line("=", "blue", stage, f"reused  {sentence(stage, data['summary'])}")

    def _stage_failed(self, stage: str, data: Mapping[str, JSON]) -> None:
        self._ended(stage)
        self._line("✗", "red", stage, str(data["message"]))

    def _ended(self, stage: str) -> None:
        """Remove a stage's bar; without any, the space for them."""
        shown = self._running.pop(stage, None)
        if self._live is not None and shown is not None and shown.task is not None:
            self._live.remove_task(shown.task)
            if not self._live.tasks:
                self.close()

    def _note(self, stage: str, data: Mapping[str, JSON]) -> None:
        self._line("·", "cyan", stage, str(data["message"]))

    def _warning(self, stage: str, data: Mapping[str, JSON]) -> None:
        hint = f" {data['hint']}" if data["hint"] else ""
        self._line("!", "yellow", stage, f"{data['message']}{hint}")

    def _line(self, sign: str, colour: str, stage: str, text: str) -> None:
        target = self._live.console if self._live is not None else self._console
        target.print(f"[{colour}]{sign}[/] {escape(self._label(stage))} {escape(text)}", soft_wrap=True)

    def _label(self, stage: str) -> str:
        of = stage_name(stage)
        if of not in self._order:
            return stage.ljust(10)
        return f"{self._order.index(of) + 1:>2}/{len(self._order)} {stage:<10}"


def escape(text: str) -> str:
    """Escape a text so that neither rich nor a terminal interprets anything in it as markup or a command."""
    return without_markup(text.translate(CONTROLS))


def show_error(error: SplatpipeError) -> None:
    """Show an error as a short panel instead of a traceback."""
    lines = [escape(error.message)]
    if error.hint:
        lines.append(f"[bold]→[/] {escape(error.hint)}")
    Console(file=sys.stderr, highlight=False, emoji=False).print(
        Panel("\n".join(lines), title="splatpipe", border_style="red")
    )


def show_status(statuses: Iterable[StageStatus]) -> None:
    """Print the table of ``splatpipe status``."""
    table = Table(box=None, pad_edge=False)
    for title in ("stage", "state", "took", "what"):
        table.add_column(title, overflow="fold")
    for status in statuses:
        for row in (status, *status.shards):
            artifact = row.artifact
            took = duration(float(artifact.manifest["seconds"])) if artifact else ""
            what = sentence(row.stage.name, artifact.summary) if artifact else row.reason
            name = row.stage.name if row is status else f"  {row.stage.name}"
            table.add_row(name, f"[{COLOURS[row.state]}]{row.state}[/]", took, Text(what), end_section=False)
    Console(highlight=False, emoji=False).print(table)


def show_verdict(verdict: Verdict) -> None:
    """Print the verdict on a run, the report's first lines; ``show_bad_cameras`` prints why cameras are bad."""
    console = Console(file=sys.stderr, highlight=False, emoji=False)
    mark, colour = MARKS[verdict.level]
    console.print(f"\n[bold {colour}]{mark} {escape(verdict.headline)}.[/]  {escape(verdict.text)}", soft_wrap=True)
    for finding in verdict.findings:
        if (finding.title, finding.level) == (CAMERAS, "bad"):
            continue
        mark, colour = MARKS[finding.level]
        console.print(f"  [{colour}]{mark}[/] [bold]{escape(finding.title)}[/]  {escape(finding.text)}", soft_wrap=True)


def show_outputs(out: Path, seconds: float | None, files: Iterable[Path], result_lines: Sequence[str] = ()) -> None:
    """Print a run's outputs.

    Args:
        out: OUT.
        seconds: Duration of the run; None if everything was reused.
        files: Its files.
        result_lines: Measurement results, one line each.
    """
    console = Console(file=sys.stderr, highlight=False, emoji=False)
    done = "All results are up to date: nothing to do." if seconds is None else f"Done in {duration(seconds)}."
    console.print(f"\n[bold]{done}[/]", soft_wrap=True)
    sizes: dict[Path, int] = {}
    for path in files:  # files in a folder are shown as the folder
        entry = out / path.relative_to(out).parts[0]
        sizes[entry] = sizes.get(entry, 0) + path.stat().st_size
    for path, size in sizes.items():
        console.print(f"  {escape(str(path))}  [dim]{_bytes(size)}[/]", soft_wrap=True)
    for line in result_lines:
        console.print(f"[bold]{escape(line)}[/]", soft_wrap=True)
    if seconds is None:
        console.print(f"[dim]To run again, change an option or --rerun a stage. Results: {escape(str(out))}[/]")


def show_bad_cameras(verdict: Mapping[str, JSON]) -> None:
    """Print a final, prominent warning if the cameras are wrong; nothing otherwise.

    Args:
        verdict: The verdict of the stage `sparse`.
    """
    reasons = [reason for reason in verdict.get("reasons", []) if reason["level"] == "bad"]
    if not reasons:
        return
    lines = ["All results derived from them are unreliable."]
    for reason in reasons:
        lines += [escape(reason["text"])] + ([f"[bold]→[/] {escape(reason['hint'])}"] if reason["hint"] else [])
    panel = Panel("\n".join(lines), title="The camera poses are unreliable", border_style="red")
    Console(file=sys.stderr, highlight=False, emoji=False).print(panel)


def show_accuracy(report: Mapping[str, JSON], points: Sequence[Mapping[str, JSON]]) -> None:
    """Print the accuracy report as a table on stderr, and the surveyed points if few; nothing if there is none.

    Args:
        report: `accuracy` of metrics.json, or `accuracy.json`.
        points: The points of `control.json`.
    """
    splat = report.get("splat") or {"tables": {}, "points": []}
    found = [(title, (report.get("tables") or {}).get(name)) for name, title in GROUPS.items()]
    found += [(f"splat at {name}", splat["tables"].get(name)) for name in ("control", "check")]
    groups = [(title, table) for title, table in found if table is not None]
    if not groups:
        return
    gsd = report.get("gsd_m")
    console = Console(file=sys.stderr, highlight=False, emoji=False)
    if not console.is_terminal:
        console.width = PLAIN_WIDTH
    console.print("\n[bold]Accuracy[/], root mean square in metres" + (f"; GSD {gsd:.4f} m" if gsd else ""))
    accuracy_table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))  # within 80 columns
    for title in ("", "n", "east", "north", "up", "horiz.", "3D", "95 % horiz", "95 % up"):
        accuracy_table.add_column(title, justify="right" if title else "left", no_wrap=True)
    for title, table in groups:
        figures = [_metres(table.get(f"rmse_{name}_m")) for name in ("east", "north", "up", "horizontal", "3d")]
        bounds = [_bounds(table.get(f"interval_95_{name}_m")) for name in ("horizontal", "vertical")]
        accuracy_table.add_row(title, str(table["count"]), *figures, *bounds)
    console.print(accuracy_table)
    for line in _offsets([flight for _, table in groups for flight in table.get("flights", [])]):
        console.print(line, soft_wrap=True)
    if 0 < len(points) <= MAX_POINTS:
        console.print(_points_table(points, {point["name"]: point for point in splat["points"]}))
        for point in points:
            if point.get("why"):
                console.print(f"{point['name']}: {point['why']}.", markup=False, soft_wrap=True)


def _offsets(flights: Iterable[Mapping[str, JSON]]) -> list[str]:
    """Each flight's common position offset, which the table excludes."""
    offsets = [(flight["flight"] + 1, *flight["offset_m"]) for flight in flights]
    return [
        f"Positions of flight {number}: common offset east {east:+.3f}, north {north:+.3f}, up {up:+.3f} m."
        for number, east, north, up in offsets
        if max(abs(east), abs(north), abs(up)) >= MIN_OFFSET_M
    ]


def _points_table(points: Sequence[Mapping[str, JSON]], splat: Mapping[str, Mapping[str, JSON]]) -> Table:
    """Residuals of each surveyed point: estimated minus surveyed, metres."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for title in ("point", "", "photos", "east", "north", "up", "px", "splat: east", "north", "up"):
        table.add_column(title, justify="left" if title in ("point", "") else "right", overflow="fold")
    nothing = [None, None, None]
    for point in points:
        used = [seen for seen in point["observations"] if seen.get("used", True)]
        squares = [x * x + y * y for x, y in (seen["residual_px"] for seen in used if seen.get("residual_px"))]
        pixels = f"{(sum(squares) / len(squares)) ** 0.5:.2f}" if squares else "–"
        own = splat.get(point["name"], {}).get("residual_m") or nothing
        table.add_row(
            Text(str(point["name"])),
            Text(str(point["role"]).replace("_", " ")),
            str(len(used)),
            *(_metres(value) for value in point.get("residual_m") or nothing),
            pixels,
            *(_metres(value) for value in own),
        )
    return table


def _metres(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _bounds(interval: Sequence[float] | None) -> str:
    return "–" if interval is None else f"{interval[0]:.3f}–{interval[1]:.3f}"


def show_table(rows: Iterable[Sequence[str]], titles: Sequence[str]) -> None:
    """Print a plain table on stdout."""
    table = Table(box=None, pad_edge=False)
    for title in titles:
        table.add_column(title, overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    Console(highlight=False, emoji=False).print(table)


def print_line(text: str) -> None:
    """Print one line for the user on stderr."""
    Console(file=sys.stderr, highlight=False, emoji=False).print(escape(text), soft_wrap=True)


def _bytes(size: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"
