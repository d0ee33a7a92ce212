"""The table of field inputs: a row for each, with the sentences that matter of what was printed."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from itertools import groupby

from field_case import FieldInput

# A finding of `check`, or a message of a run, whose stage and time are left out.
MESSAGE = re.compile(r"([✗!·]) +(?:\d+/\d+ \w+ +)?(.*)")
RESULT = re.compile(r"[✓=] +\d+/\d+ \w+ +(?:[\d.]+ \w+|reused) +(.*)")  # of a stage
VERDICT = re.compile(r"(\d+ photos\. .*)")
PANEL = re.compile(r"│ (.*) │")
# Between them and the answer lie progress and lists of files.
NOISE = re.compile(
    r"(?: |check\.html|(?:check|edit|convert|source)  |Done in|All results|To run again|! Run up to|[╭╰✓=])"
)
NAMES = re.compile(r"(\S+\.\w+), \S+\.\w+(?:, \S+\.\w+)+")  # more than two
SENTENCES, SENTENCE_CHARS, ERROR_CHARS = 2, 120, 200


def table_row(case: FieldInput, answers: Sequence[tuple[str, str, int]], faults: Sequence[str]) -> str:
    """Return a row of Markdown.

    Args:
        case: The input.
        answers: Each command, what it printed, and its exit code.
        faults: What is wrong with that.
    """
    said = []
    for text, same in groupby(answers, key=lambda answer: _answer(*answer[1:])):
        labels = [_label(command) for command, _, _ in same]
        said.append(text if len(answers) == 1 else f"{', '.join(labels)}: {text}")
    verdict = "WRONG: " + "; ".join(faults) if faults else f"mended: {case.mended}" if case.mended else "right"
    return f"| {case.name} | {'<br>'.join(said).replace('|', '&#124;')} | {verdict} |"


def _label(command: str) -> str:
    """A command and the file that distinguishes it from the others of its input."""
    words = shlex.split(command)
    return f"{words[0]} {words[words.index('--boundary') + 1 if '--boundary' in words else 1]}"


def _answer(printed: str, code: int) -> str:
    """What a command answered, in a line: its messages, else its result."""
    lines = printed.splitlines()
    panel = " ".join(found[1].strip() for line in lines if (found := PANEL.fullmatch(line)))
    found_messages = [found for line in lines if not NOISE.match(line) and (found := MESSAGE.fullmatch(line))]
    messages = [_short(found[2], whole=found[1] == "✗") for found in found_messages]
    results = [found[1] for line in lines if (found := RESULT.fullmatch(line) or VERDICT.fullmatch(line))]
    rest = [line for line in lines if line.strip() and not NOISE.match(line) and not PANEL.fullmatch(line)]
    if panel:
        said = [re.sub(r"\.? → ", ". ", panel)]
    else:
        said = messages[:SENTENCES] or results[-1:] or rest[:SENTENCES]
        more = len(messages) - SENTENCES
        said += [f"and {more} more"] if more > 0 else []
    return "; ".join(text.rstrip(".") for text in said) + (f" (exit {code})" if code else "")


def _short(text: str, *, whole: bool) -> str:
    """The first sentence of a message; of an error with what to do, as far as there is room."""
    text = NAMES.sub(r"\1, …", text)
    first = text if whole else re.split(r"(?<=[^.\d])\. ", text)[0]
    room = ERROR_CHARS if whole else SENTENCE_CHARS
    return first if len(first) <= room else first[: room - 1].rsplit(" ", 1)[0] + " …"
