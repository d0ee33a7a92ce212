"""A batch's page: one card per capture, always up to date; while the batch is running it reloads itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from markupsafe import Markup

from splatpipe.pipeline.app.batch.pages.state import FINISHED, STALE_S, BatchState, CaptureState, Level, State
from splatpipe.pipeline.app.page_file import page_text, printable, relative_link
from splatpipe.pipeline.app.path_labels import PathLabels
from splatpipe.pipeline.app.report.facts.wording import duration, local_moment, plural, roughly, size
from splatpipe.pipeline.app.thumbnails import Thumbnail, thumbnail
from splatpipe.pipeline.engine.files.durable import write_durably

TEMPLATES = Path(__file__).resolve().parent / "templates"
REFRESH_S = 10  # the page's reload interval; the batch rewrites the page somewhat less often
PICTURE_SIDE = 480  # pixels, of a card on a good display
SMALL_SIDE = 240  # if there are so many that the page would load slowly
MANY_CAPTURES = 60  # captures
MAX_LINES = 50  # lines shown of a reason; the full text is in the report
GROUPS: Sequence[tuple[State, str]] = (  # those that need attention first
    ("failed", "Failed"),
    ("running", "Running"),
    ("stopped", "Stopped"),
    ("done", "Done"),
    ("reused", "Finished before"),
    ("waiting", "Waiting"),
)
STAGE_WORDS: Mapping[State, str] = {"running": "in {}", "failed": "in {}", "stopped": "in {}", "waiting": "before {}"}


@dataclass(frozen=True)
class Card:
    """A capture's card.

    Attributes:
        name: Its printable name.
        state: Its state.
        picture: A thumbnail, or None.
        stage: The current stage in words; empty if there is nothing to show.
        percent: Progress; None if it is not running.
        left: Progress and time left in words; empty if it is not running.
        facts: Figures in words: photos, time, attempts.
        verdict: The report's headline.
        level: The verdict's level.
        reason: First line of why it failed or was stopped.
        more: Further lines of the reason.
        hint: What to do about it.
        earlier: Why earlier attempts failed.
        links: Titles and URLs.
    """

    name: str
    state: State
    picture: Thumbnail | None
    stage: str
    percent: int | None
    left: str
    facts: str
    verdict: str
    level: Level
    reason: str
    more: tuple[str, ...]
    hint: str
    earlier: tuple[str, ...]
    links: tuple[tuple[str, Markup], ...]


@dataclass(frozen=True)
class Group:
    """The captures in one state."""

    state: State
    title: str
    cards: tuple[Card, ...]


def write_page(state: BatchState, path: Path) -> None:
    """Write a batch's page atomically.

    Args:
        state: The batch's state.
        path: The page, in the batch's folder; images and links are relative to it.

    Raises:
        OSError: if it cannot be written.
        MachineError: if this installation lacks the page's script or style.
    """
    write_durably(path, batch_page(state, path.parent))


def batch_page(state: BatchState, folder: Path) -> str:
    """The page as one self-contained HTML text.

    Args:
        state: The batch's state.
        folder: The batch's folder.

    Raises:
        MachineError: if this installation lacks the page's script or style.
    """
    side = SMALL_SIDE if len(state.captures) > MANY_CAPTURES else PICTURE_SIDE
    groups = []
    for name, title in GROUPS:
        captures = sorted((it for it in state.captures if it.state == name), key=lambda it: it.level != "bad")
        cards = tuple(_card(it, folder, side) for it in captures)
        if cards:
            groups.append(Group(name, title, cards))
    level, headline = _headline(state)
    return page_text(
        TEMPLATES,
        "batch.html.j2",
        PathLabels.of(folder),
        style="batch.css",
        script="batch.js" if state.at_work else None,
        name=state.name,
        at_work=state.at_work,
        level=level,
        headline=headline,
        text=_text(state),
        warnings=state.warnings,
        unlisted=state.unlisted,
        groups=groups,
        total=len(state.captures),
        written_s=state.as_of_s,
        written=local_moment(state.as_of_s),
        silence_s=STALE_S,
        refresh_s=REFRESH_S,
    )


def _headline(state: BatchState) -> tuple[Level, str]:
    counts, total = state.counts, len(state.captures)
    finished = counts.get("done", 0) + counts.get("reused", 0)
    failed = counts.get("failed", 0)
    lost = f", {failed:,} failed" if failed else ""
    if state.at_work:
        return ("bad" if failed else ""), f"Running: {finished:,} of {plural(total, 'capture')} finished{lost}"
    if not total:
        return "doubt", "There were no captures to process"
    if state.message:
        return "bad", f"Ended early: {finished:,} of {plural(total, 'capture')} finished{lost}"
    if state.all_succeeded:
        doubtful = sum(capture.level in ("doubt", "bad") for capture in state.captures)
        headline = "The capture succeeded" if total == 1 else f"All {total:,} captures succeeded"
        if doubtful:
            return "doubt", f"{headline}; {doubtful:,} to check"
        return "good", headline
    if failed:
        return "bad", f"{failed:,} of {plural(total, 'capture')} failed; {finished:,} finished"
    return "doubt", f"Stopped: {finished:,} of {plural(total, 'capture')} finished"


def _text(state: BatchState) -> str:
    """Start time, duration and resources in words."""
    until_s = state.as_of_s if state.ended_s is None else state.ended_s
    poor = sum(capture.level == "bad" and capture.state in FINISHED for capture in state.captures)
    sentences = [state.message, f"{poor:,} of the finished captures have poor results." if poor else ""]
    sentences += [f"Began {local_moment(state.began_s)}."]
    if state.ended_s is not None:
        sentences.append(f"Ended {local_moment(until_s)}, after {duration(max(0.0, until_s - state.began_s))}.")
    elif state.left_s is not None:
        sentences.append(
            f"About {roughly(state.left_s)} left, until {local_moment(until_s + state.left_s)} (forecast)."
        )
    if state.free_bytes is not None and (state.at_work or not state.all_succeeded):
        needed = f"; the remaining stages need about {size(state.needed_bytes)}" if state.needed_bytes else ""
        sentences.append(f"{size(state.free_bytes)} are free on the disk{needed}.")
    return " ".join(filter(None, sentences))


def _card(capture: CaptureState, folder: Path, side: int) -> Card:
    running = capture.state == "running"
    facts = [plural(capture.photos, "photo") if capture.photos is not None else ""]
    if capture.seconds > 0.0:
        facts.append(duration(capture.seconds))
    if capture.tries > 1:
        facts.append(f"attempt {capture.tries}" if running else plural(capture.tries, "attempt"))
    percent = round(100 * min(max(capture.progress, 0.0), 1.0))
    left = f"{percent} %"
    if capture.left_s is not None:
        left += f", about {roughly(capture.left_s)} left"
    reason, *more = [line.strip() for line in capture.reason.splitlines() if line.strip()] or [""]
    begun = capture.state != "waiting" or capture.progress > 0.0
    return Card(
        name=printable(capture.name),
        state=capture.state,
        picture=_picture(capture.picture, folder, side),
        stage=STAGE_WORDS.get(capture.state, "").format(capture.stage) if capture.stage and begun else "",
        percent=percent if running else None,
        left=left if running else "",
        facts=" · ".join(filter(None, facts)),
        verdict="" if reason else capture.verdict,  # the verdict would repeat the state and the reason
        level=capture.level,
        reason=reason,
        more=tuple(more[:MAX_LINES]) + ((f"and {len(more) - MAX_LINES:,} more",) if len(more) > MAX_LINES else ()),
        hint=capture.hint,
        earlier=capture.earlier,
        links=tuple(
            (text, relative_link(target))
            for text, target in (("Report", capture.report), ("Viewer", capture.viewer))
            if _lies_in(folder, target)
        ),
    )


def _picture(relative: str, folder: Path, side: int) -> Thumbnail | None:
    return thumbnail(folder / relative, side) if _lies_in(folder, relative) else None


def _lies_in(folder: Path, relative: str) -> bool:
    """Whether it is a file below the folder: the page must not link anywhere else."""
    path = PurePosixPath(relative)
    if not relative or path.is_absolute() or ".." in path.parts:
        return False
    try:
        return (folder / path).is_file()
    except (OSError, ValueError):
        return False
