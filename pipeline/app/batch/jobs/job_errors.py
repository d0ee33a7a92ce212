"""How jobs of a batch ended (cancelled, preempted, out of memory or time), as Snakemake and its executor report it.

The executor is Slurm or Kubernetes. Snakemake's own process records one JSON object per line: only it learns that a job
died before it began, or was ended from outside.
"""

from __future__ import annotations

import json
import logging
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import appended_file
from splatpipe.pipeline.engine.files.small_file import read_end, read_small

SNAKEMAKE_LOGGER = "snakemake.logging"
ERRORS_FILE = "engine.jsonl"  # below a call's folder
MAX_LOG_BYTES = 16 << 20
LOG_TAIL_BYTES = 1 << 16
MEMORY = re.compile(rb"slurmstepd\S*: error: .*\boom[-_]kill\b")
MAX_MESSAGE_LETTERS = 300  # characters of an engine's own words
STATE = re.compile(r"status is: '([A-Z_]+)'")
BOILERPLATE = re.compile(
    r"sbatch call:.*|For further error details see .*|Detailed failure reason unavailable .*|The error message was|"
    r"Job submission failed with exception:|SLURM sbatch failed\.",
    re.DOTALL,
)

# What an engine did to a job, whatever the job itself could still say.
ENDED_BY_ENGINE: Mapping[str, tuple[str, str]] = {
    "OUT_OF_MEMORY": (
        "It was ended because it used more memory than its job had requested.",
        "Each retry requests more; for more from the start, set mem_mb of this job under set-resources in the profile.",
    ),
    "TIMEOUT": (
        "It was ended at its job's time limit.",
        "Repeat the command to resume; for a longer limit, set runtime of this job under set-resources in the profile.",
    ),
    "DEADLINE": ("It was ended at its job's deadline.", "Repeat the command to resume."),
    "PREEMPTED": ("Its job was preempted by another.", "Repeat the command to resume."),
    "CANCELLED": ("Its job was cancelled (scancel).", "Repeat the command to resume."),
    "NODE_FAIL": ("The node on which it ran has failed.", "Repeat the command to resume."),
    "BOOT_FAIL": ("The node on which it was to run did not start.", "Repeat the command to resume."),
}


@dataclass(frozen=True)
class EngineError:
    """The engine's report of the end of one of a job's attempts.

    Attributes:
        message: The engine's words.
        job: Its own number of the job, e.g. Slurm's; empty if it gave none.
        log: The file with the output of the job; empty if there is none.
        killed_for_memory: Whether its log says so: Slurm may report such a job as just failed.
    """

    message: str
    job: str = ""
    log: str = ""
    killed_for_memory: bool = False

    @property
    def decides(self) -> bool:
        """Whether the engine's reason counts, whatever the job itself has recorded."""
        return self._state in ENDED_BY_ENGINE

    @property
    def reason(self) -> str:
        """Why the attempt ended, in a sentence."""
        if self.decides:
            return ENDED_BY_ENGINE[self._state][0]
        if self._state:
            return f"Slurm ended its job {self.job} as {self._state}, before it could say why."
        words = " ".join(BOILERPLATE.sub("", self.message).split()).strip("'. ")
        return f"Its job failed: {words[:MAX_MESSAGE_LETTERS]}." if words else "Its job failed without a message."

    @property
    def hint(self) -> str:
        """What to do about it."""
        if self.decides:
            return ENDED_BY_ENGINE[self._state][1]
        return f"Its output may say more: {self.log}" if self.log else ""

    @property
    def _state(self) -> str:
        found = STATE.search(self.message)
        return "OUT_OF_MEMORY" if self.killed_for_memory else found[1] if found else ""


class ErrorRecorder(logging.Filter):
    """Records the errors of jobs that pass through Snakemake's logger, and lets every message pass.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path

    def filter(self, record: logging.LogRecord) -> bool:
        if str(getattr(record, "event", "")) == "job_error" and (outputs := getattr(record, "output", None)):
            marker = PurePosixPath(str(outputs[0]).split(" ")[0])  # …/capture/job, and a word on how it is stored
            logs = [str(log) for log in getattr(record, "log", None) or () if log]
            aux = getattr(record, "aux", None) or {}
            message, job = getattr(record, "rule_msg", None) or "", aux.get("external_jobid") or ""
            log = "".join(logs[-1:])
            error = EngineError(str(message), str(job), log, killed_for_memory=_mentions_memory(log))
            with appended_file(self._path) as file:
                file.write(json.dumps({"of": [marker.parent.name, marker.name], **asdict(error)}).encode() + b"\n")
        return True


def _mentions_memory(log: str) -> bool:
    """Whether Slurm has written into a job's output that the kernel killed one of its processes for memory."""
    with suppress(OSError, SplatpipeError):
        return MEMORY.search(read_end(Path(log), LOG_TAIL_BYTES)) is not None
    return False


def record_errors(folder: Path) -> None:
    """Record the errors of the jobs of the Snakemake that will run in this process.

    Args:
        folder: The call's folder.
    """
    logging.getLogger(SNAKEMAKE_LOGGER).addFilter(ErrorRecorder(folder / ERRORS_FILE))


def read_errors(folder: Path) -> Mapping[tuple[str, str], Sequence[EngineError]]:
    """A call's errors by capture's key and job, in order; malformed lines are skipped."""
    found: dict[tuple[str, str], list[EngineError]] = defaultdict(list)
    try:
        lines = read_small(folder / ERRORS_FILE, MAX_LOG_BYTES).splitlines()
    except FileNotFoundError:
        return found
    for line in lines:
        try:
            stored = json.loads(line)
            capture, job = stored.pop("of")
            found[str(capture), str(job)].append(EngineError(**stored))
        except (ValueError, TypeError, KeyError, AttributeError):
            continue
    return found
