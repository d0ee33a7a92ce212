"""The process that packs a run: `python -m splatpipe.pipeline.app.node.assets OUT ASSETS --log FILE [--outputs JSON]`.

It writes `all.zip` into ASSETS, and prints what that lacks and why, or what is wrong, for the task's log. Its exit
codes are those of splatpipe's commands.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import NoReturn

from splatpipe.pipeline.app.node.assets.layout import ALL
from splatpipe.pipeline.app.node.assets.outputs import parse_outputs
from splatpipe.pipeline.app.path_labels import PathLabels
from splatpipe.pipeline.engine.errors import EXIT_INTERRUPTED, EXIT_TERMINATED, SplatpipeError, StopSignal, exit_code
from splatpipe.pipeline.engine.files.output_file import own_folder


def main() -> None:
    """Pack a run; a signal ends it without a trace."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _stop)
    parser = argparse.ArgumentParser(prog="python -m splatpipe.pipeline.app.node.assets")
    parser.add_argument("out", type=Path, help="folder of the finished run")
    parser.add_argument("assets", type=Path, help="folder for all.zip, outside of that")
    parser.add_argument("--log", type=Path, help="the task's log so far, which becomes task_output.txt")
    parser.add_argument("--outputs", default="", help="JSON array of the paths that all.zip is restricted to")
    arguments = parser.parse_args()
    try:
        lines = _pack(arguments)
    except StopSignal as error:
        sys.exit(error.exit_code)
    except Exception as error:
        hint = error.hint if isinstance(error, SplatpipeError) else ""
        said = PathLabels.of(arguments.out).plain(f"The results were not packed: {error} {hint}")
        print_lines([" ".join(said.split())])
        sys.exit(exit_code(error))
    print_lines(lines)


def _pack(arguments: argparse.Namespace) -> tuple[str, ...]:
    outputs = parse_outputs(arguments.outputs)

    from splatpipe.pipeline.app.node.assets.packing import pack_run

    return pack_run(arguments.out, own_folder(arguments.assets) / ALL, outputs, arguments.log).lines


def print_lines(lines: Sequence[str]) -> None:
    """Print lines of the task's log, one each."""
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


def _stop(number: int, _frame: FrameType | None) -> NoReturn:
    raise StopSignal(EXIT_INTERRUPTED if number == signal.SIGINT else EXIT_TERMINATED)


if __name__ == "__main__":
    main()
