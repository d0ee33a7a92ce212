"""``make test-cluster``: `splatpipe batch --profile configs/batch/slurm` on a Slurm of two hosts with enforced memory.

Three captures, one of them broken, must end as they do locally, with the same bits. Then jobs are cancelled, killed,
requeued and too large, a host is drained and another fails, and the batch itself is killed: each has to be told as what
it is, and the repeated command has to go on.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from daemons import Cluster, Problem
from disturbances import ALL
from nights import Night, compare_with_local

ROOT = Path(__file__).resolve().parents[2]
WORK = ROOT / "build" / "cluster"
INSIDE = "SPLATPIPE_TEST_CLUSTER"  # set in the mount namespace


def main() -> int:
    """Run the test; return the exit code: 0 if everything holds."""
    parser = argparse.ArgumentParser(prog="make test-cluster", description=__doc__)
    parser.add_argument("--only", default="", help="run one part: captures, or a disturbance by name")
    options = parser.parse_args()
    if INSIDE not in os.environ:
        os.environ[INSIDE] = "1"
        os.execvp("unshare", ["unshare", "--mount", sys.executable, str(Path(__file__).parent), *sys.argv[1:]])
    failed = []
    try:
        cluster = Cluster(WORK / "slurm")
        try:
            cluster.start()
            say(f"{cluster.run('sinfo', '--version')} runs on two hosts: {dict(cluster.node_states())}.")
            night = Night(cluster, WORK, say)
            if options.only in ("", "captures"):
                failed += tried("captures", lambda: compare_with_local(night))
            for disturbance in ALL:
                if options.only in ("", disturbance.__name__):
                    failed += tried(disturbance.__name__, lambda disturb=disturbance: disturb(night))
        finally:
            cluster.stop()
    except Problem as problem:
        say(f"FAILED: {problem}")
        return 1
    say(f"FAILED: {', '.join(failed)}." if failed else "The cluster does what is promised.")
    return 1 if failed else 0


def tried(name: str, run) -> list[str]:
    """Run one part; return its name if it fails."""
    say(f"== {name.replace('_', ' ')}")
    try:
        run()
    except Problem as problem:
        say(f"   FAILED: {problem}")
        return [name]
    return []


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
