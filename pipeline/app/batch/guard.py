"""A process that watches a `splatpipe batch`: if that is killed, it ends the workflow and updates the status files.

    python -m splatpipe.pipeline.app.batch.guard CALL

On stdin it receives Snakemake's process group, and at the end a message of success; if stdin closes without that, the
command has died. It inherits the batch's lock, so that a repeated command waits until nothing is running any more.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

from splatpipe.pipeline.app.batch.jobs.plan import Call

KILLED = "The batch command itself was killed, by a user or by the system for lack of memory; its jobs were stopped."


def main() -> None:
    """Wait for the end of the batch command whose call folder is on the command line."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the batch command
    call = Call(Path(sys.argv[1]))
    group, local = 0, True
    for line in sys.stdin:
        message = json.loads(line)
        if message.get("done"):
            return
        group, local = int(message["group"]), bool(message["local"])
    _clean_up(call, group, local)


def _clean_up(call: Call, group: int, local: bool) -> None:
    from splatpipe.pipeline.app.batch.jobs.snakemake_process import end_group, group_has_ended
    from splatpipe.pipeline.app.batch.monitor import BatchMonitor
    from splatpipe.pipeline.app.batch.pages.publication import publish

    if group:
        end_group(call, group, local=local, has_ended=lambda: group_has_ended(group))
    with suppress(OSError):
        call.write_end(time.time(), None, KILLED)
        publish(BatchMonitor(call).state(), call.out)


if __name__ == "__main__":
    main()
