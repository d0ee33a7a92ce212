"""Arguments and options shared by the commands."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

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
ShardOption = Annotated[
    int | None,
    typer.Option(min=1, metavar="K", help="Run only this shard; other processes may run others at the same time."),
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
TimeBudgetOption = Annotated[
    str | None,
    typer.Option(
        metavar="10m|90s|1h30m",
        help="Time for the whole command; training is planned to use what the other stages leave.",
    ),
]
MaxMemoryOption = Annotated[
    str | None, typer.Option(metavar="8G|512M", help="Memory limit of training; 1G is 10⁹ bytes.")
]
BoundaryOption = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Area of interest (GeoJSON); everything outside stays coarse. auto, or none."),
]
UntilOption = Annotated[str | None, typer.Option(metavar="STAGE", autocompletion=stages, help="Stop after this stage.")]
RerunOption = Annotated[
    list[str] | None, typer.Option(metavar="STAGE", autocompletion=stages, help="Run this stage again. Repeatable.")
]
RerunFromOption = Annotated[
    str | None, typer.Option(metavar="STAGE", autocompletion=stages, help="Run this stage and all later ones again.")
]
PathOption = Annotated[
    str,
    typer.Option(
        metavar="cameras|orbit|FILE", help="Camera path: along the cameras, an orbit, or a keyframe file (JSON, CSV)."
    ),
]
WhatOption = Annotated[str, typer.Option(metavar="colour|depth|normals", help="What to render.")]
StillsOption = Annotated[
    bool,
    typer.Option(
        "--stills", help="Pictures instead of a film: one for each photo, 12 of an orbit, or one for each keyframe."
    ),
]
SizeOption = Annotated[
    str, typer.Option(metavar="WxH", help="In pixels. Default: 16:9, with as many pixels as the training photos.")
]
SecondsOption = Annotated[float, typer.Option(min=0.1, max=600.0, help="Length of the film, if the path has no times.")]
FpsOption = Annotated[int, typer.Option(min=1, max=120, help="Frames per second.")]
TargetOption = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        callback=lambda path: path and expand_user(path),
        help="Film file (.webm, or .mp4, four times slower) or folder of stills. Default: in OUT/renders.",
    ),
]
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
