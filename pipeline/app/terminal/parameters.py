"""Arguments and options of several commands, alone and in groups; a command declares its own in its signature."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from splatpipe.pipeline.app.terminal.summary import CommandSummary
from splatpipe.pipeline.engine.errors import UsageError


def expand_user(path: Path) -> Path:
    """Expand ``~`` in a path; other paths are returned unchanged.

    Raises:
        UsageError: if it begins with ``~`` and there is no such home folder, as in a container.
    """
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise UsageError(f"There is no home folder for {path}.", hint="Give the full path, or set HOME.") from error


def expand_given(path: Path | None) -> Path | None:
    """``expand_user`` of an optional path."""
    return None if path is None else expand_user(path)


def presets(incomplete: str) -> list[str]:
    """Presets whose names begin with ``incomplete``, for shell completion."""
    from splatpipe.pipeline.engine.config import preset_names

    return [name for name in preset_names() if name.startswith(incomplete)]


def stages(incomplete: str) -> list[str]:
    """Stages whose names begin with ``incomplete``."""
    from splatpipe.stages.line import LINE

    return [stage.name for stage in LINE if stage.name.startswith(incomplete)]


def devices(incomplete: str) -> list[str]:
    """Devices whose names begin with ``incomplete``."""
    return [name for name in ("auto", "cpu", "cuda") if name.startswith(incomplete)]


PhotosArgument = Annotated[
    Path,
    typer.Argument(
        callback=expand_user,
        help="Folder of photos, or a COLMAP folder with images/ and sparse/0, or a film (MP4, MOV).",
    ),
]
OutArgument = Annotated[
    Path, typer.Argument(callback=expand_user, help="Folder for the results; a stopped run resumes.")
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="TOML file of options, which override the preset's.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="SECTION.OPTION=VALUE", help="Set one option; overrides the preset and --config. Repeatable."
    ),
]
ThreadsOption = Annotated[
    int, typer.Option(min=0, max=1024, help="Threads; 0 for all cores. Does not change the result.")
]
SeedOption = Annotated[int | None, typer.Option(min=0, max=2**31 - 1, help="Seed for all random numbers.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout at the end.")]
NotifyOption = Annotated[
    str | None,
    typer.Option(
        metavar="COMMAND",
        help="Shell command to run at the end, on success or failure. Its environment has SPLATPIPE_STATE (done, "
        "failed, stopped), SPLATPIPE_CAPTURE, SPLATPIPE_REPORT and SPLATPIPE_OUT.",
    ),
]
PresetOption = Annotated[str, typer.Option(autocompletion=presets, help="preview (minutes), standard or high.")]
UntilOption = Annotated[str | None, typer.Option(metavar="STAGE", autocompletion=stages, help="Stop after this stage.")]
FormatOption = Annotated[
    str | None,
    typer.Option("--format", "-f", metavar="NAME", help="Format, if OUT's extension does not set it: spz2, model."),
]


@dataclass(frozen=True)
class MachineOptions:
    """Where a command computes."""

    device: Annotated[str, typer.Option(autocompletion=devices, help="auto, cpu or cuda.")] = "auto"
    threads: ThreadsOption = 0


@dataclass(frozen=True)
class SessionOptions:
    """How a command works in OUT, and how it ends."""

    wait: Annotated[
        bool, typer.Option("--wait", help="If another splatpipe is working in OUT, wait for it instead of failing.")
    ] = False
    notify: NotifyOption = None
    as_json: JsonOption = False

    @contextmanager
    def summary(self, out: Path) -> Iterator[CommandSummary]:
        """The summary of a command that works in OUT; the user's own command is called at its end."""
        with CommandSummary(out, self.as_json) as done:
            done.notify_by(self.notify)
            yield done


@dataclass(frozen=True)
class LineSettings:
    """Options of the line by name, and those that have an abbreviation."""

    by_name: SetOption = None
    time_budget: Annotated[
        str | None,
        typer.Option(
            metavar="10m|90s|1h30m",
            help="Time for the whole command; training is planned to use what the other stages leave.",
        ),
    ] = None
    max_memory: Annotated[
        str | None, typer.Option(metavar="8G|512M", help="Memory limit of training; 1G is 10⁹ bytes.")
    ] = None

    def assignments(self) -> list[str]:
        """All as assignments; those by name come last and take precedence.

        Raises:
            UsageError: if a budget cannot be read.
        """
        from splatpipe.pipeline.engine.quantities import parse_bytes, parse_duration

        budgets = []
        if self.time_budget is not None:
            budgets.append(f"train.time_budget_s={parse_duration(self.time_budget, '--time-budget')!r}")
        if self.max_memory is not None:
            budgets.append(f"train.max_memory_bytes={parse_bytes(self.max_memory, '--max-memory')}")
        return [*budgets, *(self.by_name or ())]


@dataclass(frozen=True)
class CaptureSettings(LineSettings):
    """The same for a user's own photos."""

    boundary: Annotated[
        str | None,
        typer.Option(
            metavar="FILE", help="Area of interest (GeoJSON); everything outside stays coarse. auto, or none."
        ),
    ] = None

    def assignments(self) -> list[str]:
        """As of ``LineSettings``."""
        return [*([] if self.boundary is None else [f"georef.boundary={self.boundary}"]), *super().assignments()]
