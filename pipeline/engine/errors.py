"""Error classes: each error carries a message, a hint on what to do and its exit code."""

from __future__ import annotations

import re
import time

EXIT_INPUT = 1
EXIT_USAGE = 2
EXIT_STAGE = 3
EXIT_MACHINE = 4
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143


class SplatpipeError(Exception):
    """The input cannot be read or reconstructed.

    Args:
        message: One sentence for the user: what is wrong, naming the file or option.
        hint: What to do about it; empty where nothing helps.
    """

    exit_code = EXIT_INPUT

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint


class UsageError(SplatpipeError):
    """The command, an option or a configuration file is wrong."""

    exit_code = EXIT_USAGE


class StageError(SplatpipeError):
    """A stage failed for a reason other than its input: a crash or a bug in splatpipe."""

    exit_code = EXIT_STAGE


class MachineError(SplatpipeError):
    """This machine lacks something: space, permission, memory, a device."""

    exit_code = EXIT_MACHINE


CARD_HINT = "Run the command again: it resumes from its last checkpoint. --device cpu does not use the card."
_CARD_ERROR = re.compile(r"CUDA (?:driver )?error: (?!out of memory)([^\n]+)")  # as torch words it


def card_fault(error: BaseException) -> MachineError | None:
    """The error to show for a fault of the graphics card; None for any other error.

    Kernels run while the program goes on, so torch raises their faults as a bare RuntimeError wherever it waits for the
    card next. The card then refuses all further work of this process.
    """
    said = _CARD_ERROR.search(str(error)) if isinstance(error, RuntimeError) else None
    return (
        None if said is None else MachineError(f"The graphics card failed: {said[1].strip().rstrip('.')}.", CARD_HINT)
    )


ERRORS = {error.__name__: error for error in (SplatpipeError, UsageError, StageError, MachineError)}


class StopSignal(BaseException):
    """Ctrl-C, SIGTERM or SIGHUP. Not an Exception, so that nothing mistakes it for a failure.

    Args:
        exit_code: The program's exit code.
    """

    def __init__(self, exit_code: int) -> None:
        super().__init__("Stopped.")
        self.exit_code = exit_code
        self.at_s = time.monotonic()  # the program promises to end within seconds of this
        self.hint = "Finished work is kept: repeat the command to resume."


def exit_code(error: BaseException | None) -> int:
    """The exit code of a command that ended with this error; None means success."""
    if error is None:
        return 0
    if isinstance(error, SplatpipeError | StopSignal):
        return error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return EXIT_INTERRUPTED
    return EXIT_MACHINE if isinstance(error, OSError) else EXIT_STAGE
