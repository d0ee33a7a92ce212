"""When the frames of a film were taken, beside the photo list: what a rolling shutter's correction needs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json, write_json

FILM_NAME = "film.json"


@dataclass(frozen=True)
class FilmTimes:
    """When frames were taken.

    Attributes:
        frame_s: From one frame of the film to the next, seconds (mean).
        times_s: By photo name, from the film's start.
        cuts_s: When the film goes on with another picture.
    """

    frame_s: float
    times_s: Mapping[str, float]
    cuts_s: tuple[float, ...] = ()

    def part_of(self, name: str) -> int:
        """How many cuts lie before a frame."""
        return sum(cut <= self.times_s[name] for cut in self.cuts_s)


def save_film_times(film: FilmTimes, part: Path) -> None:
    """Write ``film.json`` into the folder of the part ``ingest.photos``."""
    write_json(
        part / FILM_NAME,
        {"frame_s": film.frame_s, "times_s": dict(sorted(film.times_s.items())), "cuts_s": list(film.cuts_s)},
    )


def load_film_times(part: Path) -> FilmTimes | None:
    """Read what ingest wrote of a film; None if the photos are no film's frames.

    Raises:
        SplatpipeError: if the file is broken.
    """
    path = part / FILM_NAME
    if not path.is_file():
        return None
    try:
        read = read_json(path)
        times = {str(name): float(time_s) for name, time_s in read["times_s"].items()}
        film = FilmTimes(float(read["frame_s"]), times, tuple(float(cut) for cut in read["cuts_s"]))
        if not all(map(math.isfinite, (film.frame_s, *times.values(), *film.cuts_s))):
            raise ValueError("a time is not finite")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SplatpipeError(
            f"The times of the film's frames in {part} cannot be read: {error}", hint="Run again with --rerun ingest."
        ) from error
    return film
