"""One class of errors for whoever uses splatpipe: what other libraries raise becomes a ``SplatpipeError``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError, UsageError, card_fault


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn what is not splatpipe's fault into a ``SplatpipeError``; other errors are bugs, and stay what they are."""
    try:
        yield
    except SplatpipeError:
        raise
    except Exception as error:
        known = known_error(error)
        if known is None:
            raise
        raise known from error


def known_error(error: Exception) -> SplatpipeError | None:
    """The error for the user: of this machine, its disks, names and cards; None for a bug."""
    if isinstance(error, SplatpipeError):
        return error
    if isinstance(error, OSError):
        return MachineError(str(error), "Check the free space and the permissions.")
    if isinstance(error, ValueError) and str(error).startswith("embedded null"):
        return UsageError("A name of a file or folder has a character 0.", hint="Give another name.")
    if isinstance(error, UnicodeEncodeError) and (sys.getfilesystemencoding() != "utf-8" or _is_undecoded(error)):
        return MachineError(
            "A name of a file or folder has letters that this environment cannot write: its encoding is "
            f"{sys.getfilesystemencoding()}.",
            "Unset PYTHONUTF8, or set LC_ALL=C.UTF-8; or rename the file or folder.",
        )
    return card_fault(error)


def _is_undecoded(error: UnicodeEncodeError) -> bool:
    """Whether a text has bytes of a file's name that are not of the encoding of names."""
    return any("\udc80" <= sign <= "\udcff" for sign in error.object[error.start : error.end])
