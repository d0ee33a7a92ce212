"""What the commands' arguments and options are, once for all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from splatpipe.pipeline.engine.errors import UsageError


def expanded(path: Path) -> Path:
    """A path with ``~`` for a user's folder; as it is where nobody has one, as in a container.

    Raises:
        UsageError: if it begins with ``~`` and there is no such folder.
    """
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise UsageError(f"There is no home folder for {path}.", hint="Give the whole path, or set HOME.") from error


def presets(incomplete: str) -> list[str]:
    """The presets whose names begin so, for a shell that completes."""
    from splatpipe.pipeline.engine.config import preset_names

    return [name for name in preset_names() if name.startswith(incomplete)]


def stages(incomplete: str) -> list[str]:
    """The stages whose names begin so."""
    from splatpipe.stages.line import LINE

    return [stage.name for stage in LINE if stage.name.startswith(incomplete)]


def devices(incomplete: str) -> list[str]:
    """The devices whose names begin so."""
    return [name for name in ("auto", "cpu", "cuda") if name.startswith(incomplete)]


PhotosArgument = Annotated[
    Path, typer.Argument(callback=expanded, help="Folder of photos, or one with images/ and sparse/0 (COLMAP).")
]
OutArgument = Annotated[
    Path, typer.Argument(callback=expanded, help="Folder for the results; a run goes on where it was stopped.")
]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="TOML file with options, over the preset's.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.OPTION=VALUE", help="One option, over all else. Repeatable."),
]
ShardOption = Annotated[
    int | None,
    typer.Option(min=1, metavar="K", help="Make this shard alone; other processes may make others at the same time."),
]
DeviceOption = Annotated[str, typer.Option(autocompletion=devices, help="auto, cpu or cuda.")]
ThreadsOption = Annotated[int, typer.Option(min=0, max=1024, help="Threads; 0 for all cores. The result is the same.")]
SeedOption = Annotated[int | None, typer.Option(min=0, max=2**31 - 1, help="Seed of every random choice.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout at the end.")]
WaitOption = Annotated[
    bool, typer.Option("--wait", help="Wait where another splatpipe works in OUT, instead of being refused.")
]
NotifyOption = Annotated[
    str | None,
    typer.Option(
        metavar="COMMAND",
        help="A shell command called at the end, good or bad; it finds SPLATPIPE_STATE (done, failed, stopped), "
        "SPLATPIPE_CAPTURE, SPLATPIPE_REPORT and SPLATPIPE_OUT in its environment.",
    ),
]
PresetOption = Annotated[str, typer.Option(autocompletion=presets, help="preview (minutes), standard or high.")]
TimeBudgetOption = Annotated[
    str | None,
    typer.Option(metavar="10m|90s|1h30m", help="For the whole command; the training is planned to fill what is left."),
]
MaxMemoryOption = Annotated[
    str | None, typer.Option(metavar="8G|512M", help="Most memory that training may take, 10⁹ bytes a G.")
]
BoundaryOption = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="The area that counts, GeoJSON; what is outside stays coarse. auto, or none."),
]
UntilOption = Annotated[str | None, typer.Option(metavar="STAGE", autocompletion=stages, help="Stop after this stage.")]
RerunOption = Annotated[
    list[str] | None, typer.Option(metavar="STAGE", autocompletion=stages, help="Run this stage again. Repeatable.")
]
RerunFromOption = Annotated[
    str | None, typer.Option(metavar="STAGE", autocompletion=stages, help="Run this stage and all after it again.")
]
PathOption = Annotated[
    str,
    typer.Option(metavar="cameras|orbit|FILE", help="The way: through the cameras, around, or keyframes (JSON, CSV)."),
]
WhatOption = Annotated[str, typer.Option(metavar="colour|depth|normals", help="What is shown.")]
StillsOption = Annotated[
    bool, typer.Option("--stills", help="Pictures, not a film: every photo's view, 12 around, or every keyframe.")
]
SizeOption = Annotated[
    str, typer.Option(metavar="WxH", help="In pixels; else 16:9, as many as photos had in training.")
]
SecondsOption = Annotated[float, typer.Option(min=0.1, max=600.0, help="Length of a film whose path has no times.")]
FpsOption = Annotated[int, typer.Option(min=1, max=120, help="Frames a second.")]
TargetOption = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        callback=lambda path: path and expanded(path),
        help="A film (.webm, or .mp4, four times slower) or the stills' folder; else below OUT/renders.",
    ),
]
