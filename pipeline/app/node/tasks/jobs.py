"""Jobs: the runs that tasks share. A job's key is the digest of its photos' bytes and names and of its options.

FOLDER/jobs/KEY/job.json          the record
FOLDER/jobs/KEY/photos/NAME       hard links to the uploaded files
FOLDER/jobs/KEY/boundary.geojson  the boundary given as an option
FOLDER/jobs/KEY/options.toml      the options of the run
FOLDER/jobs/KEY/out/              the run's OUT
FOLDER/jobs/KEY/output.txt        what the run printed
FOLDER/jobs/KEY/assets/all.zip    what clients download, whole or in parts
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

from splatpipe.pipeline.app.node.tasks.uploads import PART, FileFacts
from splatpipe.pipeline.app.path_labels import PathLabels
from splatpipe.pipeline.engine.files.durable import remove_unfinished, sync_folder, write_durably
from splatpipe.pipeline.engine.files.json_file import json_text, read_json
from splatpipe.pipeline.engine.files.output_file import own_folder, token

JobState = Literal["new", "queued", "running", "packing", "done", "failed"]

RECORD_FILE = "job.json"
MAX_RECORD_BYTES = 64 << 20  # of 100,000 photos
STAGES = "stages"  # the folder of an OUT with the artifacts of its stages
COPIED_SUFFIX = ".db"  # SQLite opens a database for writing even for those who only read
MAX_SEED_DEPTH = 32  # folders below one another in a stage's artifact


@dataclass(frozen=True)
class Forecast:
    """What a run needs.

    Attributes:
        photos: Number of photos.
        memory_bytes: Peak memory.
        seconds: Duration with the node's threads.
        disk_bytes: Disk space at its end or while it runs.
        weights: Expected seconds of each stage, for the progress.
    """

    photos: int = 0
    memory_bytes: int = 0
    seconds: float = 0.0
    disk_bytes: int = 0
    weights: Mapping[str, float] = field(default_factory=dict)


NO_FORECAST = Forecast()


@dataclass(frozen=True)
class Job:
    """A run, as it is kept in its ``job.json``.

    Attributes:
        key: Its key.
        photos: Size and digest of each file, by name.
        options: The options of its tasks.
        outputs: Paths in OUT that make up all.zip; empty for the usual content.
        title: Name in report and viewer: that of the task that wanted it first; empty for none.
        state: ``new`` until its photos are in place and it is forecast; ``packing`` after its run.
        seed: Key of a job whose artifacts may be reused, because it has the same photos; empty for none.
        forecast: What it needs.
        tries: How often its run was started and came to an end by itself.
        seconds: Duration of its runs so far that have ended.
        error: Why it failed, a sentence.
        waiting: What it waits for besides its turn, a sentence; empty for nothing.
        queued_ms: When it joined the queue, milliseconds since the epoch.
        began_ms: When it was first started; 0 before.
        ended_ms: When it was done or failed; 0 before.
    """

    key: str
    photos: Mapping[str, FileFacts]
    options: Mapping[str, Any]
    outputs: tuple[str, ...] = ()
    title: str = ""
    state: JobState = "new"
    seed: str = ""
    forecast: Forecast = NO_FORECAST
    tries: int = 0
    seconds: float = 0.0
    error: str = ""
    waiting: str = ""
    queued_ms: int = 0
    began_ms: int = 0
    ended_ms: int = 0

    @property
    def has_ended(self) -> bool:
        """Whether it is done or has failed."""
        return self.state in ("done", "failed")

    def as_json(self) -> dict[str, Any]:
        """Its record."""
        return {**asdict(self), "photos": {name: [each.size, each.sha256] for name, each in self.photos.items()}}

    @staticmethod
    def from_json(value: Any) -> Job:
        """The job of a record.

        Raises:
            ValueError: if it is not one.
        """
        try:
            given = {name: each for name, each in value.items() if name in {every.name for every in fields(Job)}}
            given["photos"] = {name: FileFacts(int(size), str(sha)) for name, (size, sha) in given["photos"].items()}
            given["forecast"] = Forecast(**given["forecast"])
            given["outputs"] = tuple(given.get("outputs", ()))
            job = Job(**given)
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"it is no job: {error}") from error
        if job.state not in get_args(JobState):
            raise ValueError("its state is none")
        return job


def job_key(photos: Mapping[str, FileFacts], options: Mapping[str, Any], outputs: Iterable[str] = ()) -> str:
    """The key of the job of these photos and options."""
    named = sorted([name, each.sha256] for name, each in photos.items())
    what = {"photos": named, "options": dict(options), "outputs": list(outputs)}
    return hashlib.sha256(json.dumps(what, sort_keys=True, ensure_ascii=True).encode()).hexdigest()[:32]


class JobStore:
    """Reads, makes and changes jobs; safe to use from several threads.

    Args:
        folder: The node's folder.
        tell: Receives lines about records that cannot be read.
    """

    def __init__(self, folder: Path, tell: Callable[[str], None] = lambda _line: None) -> None:
        self._folder = own_folder(folder, "jobs")
        self._lock = threading.RLock()
        self._jobs: dict[str, Job] = {}
        self._unwritten: set[str] = set()
        self.unreadable: list[Path] = []
        for path in sorted(self._folder.iterdir()):
            with suppress(OSError):
                remove_unfinished(path)
            try:
                self._jobs[path.name] = replace(
                    Job.from_json(read_json(path / RECORD_FILE, MAX_RECORD_BYTES)), key=path.name
                )
            except (OSError, ValueError) as error:
                self.unreadable.append(path)
                if not isinstance(error, FileNotFoundError):
                    tell(f"{path / RECORD_FILE} cannot be read, so this run is made anew: {error}")

    def get(self, key: str) -> Job | None:
        """A job; None if there is none."""
        return self._jobs.get(key)

    def all(self) -> list[Job]:
        """All jobs, in the order of the queue."""
        return sorted(self._jobs.values(), key=lambda job: (job.queued_ms, job.key))

    def put(self, job: Job) -> None:
        """Add a job, or replace it.

        Raises:
            OSError: if its record cannot be written.
        """
        with self._lock:
            folder = own_folder(self._folder, job.key)
            write_durably(folder / RECORD_FILE, json_text(job.as_json()))
            sync_folder(self._folder)
            self._jobs[job.key] = job

    def change(self, key: str, **values: Any) -> Job:
        """Change fields of a job; a record that cannot be written because the disk is full is written later.

        Raises:
            KeyError: if there is none.
        """
        with self._lock:
            job = self._jobs[key] = replace(self._jobs[key], **values)
            self._unwritten.add(key)
        self.write_late([key])
        return job

    def write_late(self, keys: Iterable[str] | None = None) -> None:
        """Write the records that could not be written, as far as the disk allows."""
        with self._lock:
            for key in tuple(self._unwritten if keys is None else keys):
                with suppress(OSError):
                    if key in self._jobs:
                        write_durably(self.path(key) / RECORD_FILE, json_text(self._jobs[key].as_json()))
                    self._unwritten.discard(key)

    def forget(self, key: str) -> None:
        """Leave a job out from now on; its folder stays."""
        with self._lock:
            self._jobs.pop(key, None)
            self._unwritten.discard(key)

    def path(self, key: str) -> Path:
        """A job's folder."""
        return self._folder / key

    def photos(self, key: str) -> Path:
        """The folder that its run reads."""
        return self.path(key) / "photos"

    def out(self, key: str) -> Path:
        """The OUT of its run."""
        return self.path(key) / "out"

    def assets(self, key: str) -> Path:
        """The folder of what clients download."""
        return self.path(key) / "assets"

    def output(self, key: str) -> Path:
        """The file of what its run prints."""
        return self.path(key) / "output.txt"

    def labels(self, key: str) -> PathLabels:
        """Removes the node's folders from what is told of a job."""
        return PathLabels.of(self.out(key), self.photos(key))


def link_files(names: Iterable[str], source: Path, target: Path) -> None:
    """Put files into another folder by hard links, or by copies where the file system has none; what is there stays.

    Args:
        names: Their names.
        source: Where they are.
        target: The other folder, made if it is missing.

    Raises:
        OSError: if that is not possible.
    """
    target.mkdir(exist_ok=True)
    for name in names:
        if not (target / name).exists():
            link_file(source / name, target / name)


def link_file(source: Path, target: Path) -> None:
    """Make a second name of a file, or a copy where the file system has no links; nothing half is left.

    Raises:
        OSError: if neither is possible.
    """
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise
    except OSError:
        aside = target.with_name(f".{token()}{PART}")
        try:
            shutil.copyfile(source, aside)
            aside.replace(target)
        finally:
            aside.unlink(missing_ok=True)


def seed_artifacts(source: Path, target: Path) -> int:
    """Take over the whole artifacts of another OUT with the same photos: the engine reuses those that are valid.

    An artifact appears under its name when it is whole, and is never changed then; unfinished ones begin with a dot.

    Args:
        source: The other OUT.
        target: The new OUT.

    Returns:
        Number of artifacts that were taken over.

    Raises:
        OSError: if they cannot be linked.
    """
    taken = 0
    if not (source / STAGES).is_dir():
        return 0
    (target / STAGES).mkdir(parents=True, exist_ok=True)
    for artifact in sorted((source / STAGES).iterdir()):
        place = target / STAGES / artifact.name
        if artifact.name.startswith(".") or artifact.is_symlink() or not artifact.is_dir() or place.exists():
            continue
        aside = target / STAGES / f".{token()}{PART}"
        try:
            _link_tree(artifact, aside, MAX_SEED_DEPTH)
            aside.rename(place)
            taken += 1
        except FileNotFoundError:  # it was removed meanwhile
            continue
        finally:
            shutil.rmtree(aside, ignore_errors=True)
    return taken


def _link_tree(source: Path, target: Path, depth: int) -> None:
    if depth == 0:
        raise OSError(f"{source} has too many folders below one another")
    target.mkdir()
    with os.scandir(source) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                _link_tree(Path(entry.path), target / entry.name, depth - 1)
            elif entry.is_file(follow_symlinks=False) and entry.name.endswith(COPIED_SUFFIX):
                shutil.copyfile(entry.path, target / entry.name)
            elif entry.is_file(follow_symlinks=False):
                link_file(Path(entry.path), target / entry.name)
