"""The process that writes a report: `python -m splatpipe.pipeline.app.report OUT PARENT [--hurry] [--anew]`."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from splatpipe.pipeline.app.report import write_report
from splatpipe.pipeline.engine.runs.children import die_with_parent


def main() -> None:
    """Write the report; with ``--hurry`` first without images, since there may be no time for the full one."""
    die_with_parent(int(sys.argv[2]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C also reaches the command, which decides
    out = Path(sys.argv[1])
    if "--hurry" in sys.argv[3:]:
        write_report(out, drawn=False)
    write_report(out, anew="--anew" in sys.argv[3:])


if __name__ == "__main__":
    main()
