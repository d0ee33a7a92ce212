"""The process that writes a report: `python -m splatpipe.pipeline.app.report OUT [--hurry]`."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from splatpipe.pipeline.app.report import write_report


def main() -> None:
    """Write it; in a hurry the plain one first, since the other may not come to its end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal's Ctrl-C reaches the command, which decides
    out = Path(sys.argv[1])
    if "--hurry" in sys.argv[2:]:
        write_report(out, drawn=False)
    write_report(out)


if __name__ == "__main__":
    main()
