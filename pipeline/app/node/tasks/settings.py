"""What the node was told on its command line, and its limits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

GIGABYTE = 10**9

# Limits of what a client may send. They are far above a survey's needs, and bound what a mistake or an attack can take.
MAX_FILES = 20_000  # of a task: a day's flights
MAX_PHOTO_BYTES = 2 * GIGABYTE  # a TIFF of 500 megapixels with 32 bits
MAX_FILM_BYTES = 100 * GIGABYTE
MAX_SURVEY_BYTES = 64 << 20  # as a run reads at most of a file of positions
MAX_TASK_BYTES = 500 * GIGABYTE
MAX_TASKS = 5_000  # kept at once
MAX_UPLOADING = 1_000  # not committed yet
LEAST_FREE_BYTES = 2 * GIGABYTE  # below this, no upload is begun
SPARE_BYTES = 200_000_000  # kept free by uploads, for the records of all tasks and the runs under way

GIVEN_UP_S = 24 * 3600.0  # an upload that its client has not continued for so long is removed
DAY_S = 24 * 3600.0


@dataclass(frozen=True)
class Settings:
    """The node's settings.

    Attributes:
        folder: Where everything is kept.
        parallel: Runs at once.
        threads: Threads of each run.
        keep_days: Ended tasks are removed after so many days; 0 for never.
        least_free_bytes: Free disk below which no task is begun.
    """

    folder: Path
    parallel: int = 1
    threads: int = 1
    keep_days: float = 0.0
    least_free_bytes: int = LEAST_FREE_BYTES
