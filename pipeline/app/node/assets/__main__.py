"""The process that packs a run: `python -m splatpipe.pipeline.app.node.assets OUT all.zip`; `--help` has the options.

It prints one JSON object: `bytes`, `entries`, and `lines` for the task's log; or `error` and `hint`. Its exit codes are
those of splatpipe's commands.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import NoReturn

from splatpipe.pipeline.app.node.assets.outputs import parse_outputs
from splatpipe.pipeline.app.path_labels import PathLabels
from splatpipe.pipeline.engine.errors import EXIT_INTERRUPTED, EXIT_TERMINATED, SplatpipeError, StopSignal, exit_code


def main() -> None:
    """Pack a run; a signal ends it without a trace."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _stop)
    parser = argparse.ArgumentParser(prog="python -m splatpipe.pipeline.app.node.assets", description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the finished run")
    parser.add_argument("target", type=Path, help="the archive to write, outside of that folder")
    parser.add_argument("--outputs", default="", help="JSON array of the paths that it is restricted to")
    parser.add_argument("--task-output", type=Path, help="the task's log so far")
    arguments = parser.parse_args()
    try:
        _pack(arguments)
    except StopSignal as error:
        sys.exit(error.exit_code)
    except Exception as error:
        hint = error.hint if isinstance(error, SplatpipeError) else ""
        labels = PathLabels.of(arguments.out)
        _tell({"error": labels.plain(str(error)), "hint": labels.plain(hint)})
        if exit_code(error) == exit_code(RuntimeError()):
            raise  # a bug: its traceback is for the node's own log
        sys.exit(exit_code(error))


def _pack(arguments: argparse.Namespace) -> None:
    outputs = parse_outputs(arguments.outputs)

    from splatpipe.pipeline.app.node.assets.packing import pack_run

    packed = pack_run(arguments.out, arguments.target, outputs, arguments.task_output)
    _tell({"bytes": packed.size, "entries": packed.entries, "lines": packed.lines})


def _tell(value: Mapping[str, object]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


def _stop(number: int, _frame: FrameType | None) -> NoReturn:
    raise StopSignal(EXIT_INTERRUPTED if number == signal.SIGINT else EXIT_TERMINATED)


if __name__ == "__main__":
    main()
