"""The options of ``splatpipe render``, declared once, and whether they can be met. Light to import."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from splatpipe.pipeline.app.terminal.parameters import expand_given
from splatpipe.pipeline.engine.errors import MachineError, UsageError
from splatpipe.pipeline.engine.files.output_file import own_folder

if TYPE_CHECKING:
    from splatpipe.pipeline.film.filming import What

FOLDER = "renders"  # below OUT
OWN_PATHS = ("cameras", "orbit")


@dataclass(frozen=True)
class RenderRequest:
    """What to render; each field's help says what it is."""

    path: Annotated[
        str,
        typer.Option(
            metavar="cameras|orbit|FILE",
            help="Camera path: along the cameras, an orbit, or a keyframe file (JSON, CSV).",
        ),
    ] = "cameras"
    what: Annotated[str, typer.Option(metavar="colour|depth|normals", help="What to render.")] = "colour"
    stills: Annotated[
        bool,
        typer.Option(
            "--stills", help="Pictures instead of a film: one for each photo, 12 of an orbit, or one for each keyframe."
        ),
    ] = False
    size: Annotated[
        str,
        typer.Option(metavar="WxH", help="In pixels. Default: 16:9, with as many pixels as the training photos."),
    ] = ""
    seconds: Annotated[
        float, typer.Option(min=0.1, max=600.0, help="Length of the film, if the path has no times.")
    ] = 10.0
    fps: Annotated[int, typer.Option(min=1, max=120, help="Frames per second.")] = 25
    to: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            callback=expand_given,
            help="Film file (.webm, or .mp4, four times slower) or folder of stills. Default: in OUT/renders.",
        ),
    ] = None

    def validate(self) -> tuple[What, tuple[int, int] | None]:
        """Validate; returns what to render, and its size in pixels or None.

        Raises:
            UsageError: if a value is invalid.
        """
        from splatpipe.pipeline.film.filming import MAX_SIDE, MIN_SIDE, What

        what: What | None = next((known for known in get_args(What) if known == self.what), None)
        if what is None:
            raise UsageError(
                f'--what "{self.what[:20]}" cannot be rendered.',
                hint=f"Choose {', '.join(get_args(What))}.",
            )
        if not self.size:
            return what, None
        match = re.fullmatch(r"([0-9]{2,4})x([0-9]{2,4})", self.size)
        size = (int(match[1]), int(match[2])) if match else (0, 0)
        if not all(MIN_SIDE <= side <= MAX_SIDE and (self.stills or side % 2 == 0) for side in size):
            raise UsageError(
                f'--size "{self.size[:20]}" is not a valid size.',
                hint=f"Write it like 1280x720: {MIN_SIDE} to {MAX_SIDE} pixels, even ones for a film.",
            )
        return what, size

    def target(self, out: Path) -> Path:
        """The output path; its parent folder is created.

        Raises:
            UsageError: if it is not suitable.
            MachineError: if the folder cannot be created.
        """
        from splatpipe.pipeline.film.video import CODECS
        from splatpipe.pipeline.render.view_measures import flat_stems

        stem = self.path if self.path in OWN_PATHS else flat_stems([Path(self.path).name])[0]
        target = self.to or out / FOLDER / f"{stem}-{self.what}{'' if self.stills else '.webm'}"
        if self.stills and target.exists() and not target.is_dir():
            raise UsageError(f"{target} is a file.", hint="Stills are written to a folder: choose another with -o.")
        if self.stills and target.suffix in CODECS:
            raise UsageError(f"{target} is a film file name.", hint="Stills are written to a folder: give one with -o.")
        if not self.stills and (target.suffix not in CODECS or target.is_dir()):
            raise UsageError(f"{target} is not a film file.", hint=f"A film ends in {' or '.join(CODECS)}.")
        folder = target if self.stills else target.absolute().parent
        try:
            if self.to is None:
                own_folder(out, FOLDER, *([target.name] if self.stills else []))
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MachineError(
                f"Cannot make {folder}: {error.strerror}.", hint="Choose another path with -o."
            ) from error
        return target
