"""The record of a task, as it is kept in its ``task.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, get_args

State = Literal["uploading", "fetching", "wanted", "completed", "failed", "canceled"]
ENDED = ("completed", "failed", "canceled")

QUEUED, RUNNING, FAILED, COMPLETED, CANCELED = 10, 20, 30, 40, 50  # the API's codes of a task's status
NEVER_STARTED = -1  # processing time of a task that has not begun, or was cancelled


@dataclass(frozen=True)
class Task:
    """A task: what a client has asked for, and what has become of it. Its run is a job, which equal tasks share.

    Attributes:
        uuid: Its identifier.
        name: Its name for people; may be empty.
        created_ms: When it was created, milliseconds since the epoch; a client may state its own.
        options: Options by name, typed; only those that the node offers.
        dropped: Names of options that the node does not offer.
        outputs: Paths in the run's folder to put into all.zip instead of the usual content; empty for that.
        webhook: Address that is told the end; empty for none.
        zip_url: Address of a zip with the photos; empty if they are uploaded.
        state: ``uploading`` until it is committed, ``fetching`` while the zip is loaded, then ``wanted`` until the job
            ends or the task is cancelled.
        job: Key of its job; empty before that is known.
        images: Number of its photos, from the commit on.
        notes: Lines at the beginning of its log.
        error: Why it failed, a sentence.
        processing_ms: Duration of its run once that has ended; -1 before, or if it was cancelled.
        ended_ms: When it completed, failed or was cancelled; 0 before.
        touched_ms: When its client last did something to it: uploads that are given up are removed.
        told: Whether the webhook has been told its end.
    """

    uuid: str
    name: str
    created_ms: int
    options: Mapping[str, Any] = field(default_factory=dict)
    dropped: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    webhook: str = ""
    zip_url: str = ""
    state: State = "uploading"
    job: str = ""
    images: int = 0
    notes: tuple[str, ...] = ()
    error: str = ""
    processing_ms: int = NEVER_STARTED
    ended_ms: int = 0
    touched_ms: int = 0
    told: bool = False

    @property
    def is_committed(self) -> bool:
        """Whether its upload is complete."""
        return self.state != "uploading"

    @property
    def has_ended(self) -> bool:
        """Whether it completed, failed or was cancelled."""
        return self.state in ENDED

    def as_json(self) -> dict[str, Any]:
        """Its record."""
        return asdict(self)

    @staticmethod
    def from_json(value: Any) -> Task:
        """The task of a record.

        Raises:
            ValueError: if it is not one.
        """
        if not isinstance(value, dict):
            raise ValueError("it is not an object")
        known = {each.name for each in fields(Task)}
        given: dict[str, Any] = {
            name: tuple(each) if isinstance(each, list) else each for name, each in value.items() if name in known
        }
        try:
            task = Task(**given)
        except TypeError as error:
            raise ValueError(str(error)) from error
        if task.state not in get_args(State) or not isinstance(task.options, dict):
            raise ValueError("its state or its options are none")
        return task
