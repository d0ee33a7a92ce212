"""``make test-cluster``: `splatpipe batch --profile configs/batch/slurm` on a Slurm of two hosts with enforced memory.

Three captures, one of them broken, must end as they do locally, with the same bits. Then jobs are cancelled, killed,
requeued and too large, a host is drained and another fails, and the batch itself is killed: each has to be told as what
it is, and the repeated command has to go on.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from daemons import Cluster, Problem
from disturbances import ALONE, TOGETHER
from nights import Night, compare_with_local

ROOT = Path(__file__).resolve().parents[2]
WORK = ROOT / "build" / "cluster"
AT_ONCE = 4  # batches of one job with one processor each
INSIDE = "SPLATPIPE_TEST_CLUSTER"  # set in the mount namespace


def main() -> int:
    """Run the test; return the exit code: 0 if everything holds."""
    parser = argparse.ArgumentParser(prog="make test-cluster", description=__doc__)
    parser.add_argument("--only", default="", help="the parts to run, with commas: compare_with_local, or disturbances")
    options = parser.parse_args()
    if INSIDE not in os.environ:
        os.environ[INSIDE] = "1"
        os.execvp("unshare", ["unshare", "--mount", sys.executable, str(Path(__file__).parent), *sys.argv[1:]])
    failed: list[str] = []
    try:
        cluster = Cluster(WORK / "slurm")
        try:
            cluster.start()
            say(f"{cluster.run('sinfo', '--version')} runs on two hosts: {dict(cluster.node_states())}.")
            night = Night(cluster, WORK, say)
            try:
                wanted = options.only.split(",") if options.only else []

                def run(parts: Iterable[Callable[[Night], None]], at_once: int = 1) -> list[str]:
                    chosen = [part for part in parts if not wanted or part.__name__ in wanted]
                    with ThreadPoolExecutor(at_once) as pool:
                        try:
                            held = list(pool.map(lambda part: holds(part, night), chosen))
                        except KeyboardInterrupt:
                            pool.shutdown(wait=False, cancel_futures=True)
                            night.end()
                            raise
                    return [part.__name__ for part, good in zip(chosen, held, strict=True) if not good]

                failed = [*run([compare_with_local]), *run(TOGETHER, AT_ONCE), *run(ALONE)]
            finally:
                night.end()
        finally:
            cluster.stop()
    except Problem as problem:
        say(f"FAILED: {problem}")
        return 1
    say(f"FAILED: {', '.join(failed)}." if failed else "The cluster does what is promised.")
    return 1 if failed else 0


def holds(part: Callable[[Night], None], night: Night) -> bool:
    """Run one part; return whether it holds."""
    name = part.__name__.replace("_", " ")
    say(f"== {name}")
    try:
        part(night.saying(lambda text: say(f"   {name}: {text}")))
    except Problem as problem:
        say(f"   {name} FAILED: {problem}")
        return False
    return True


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
