"""Slurm's nodes and queue: the size of the largest node, and why jobs are waiting in the queue."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import read_json

QUEUE_FILE = "queue.json"  # below a call's folder
ASK_INTERVAL_S = 20.0
TIMEOUT_S = 10.0  # a controller that answers later is too busy to be asked
MEGABYTE = 10**6  # as that of the plans, whose numbers the plugin hands to Slurm
COMMENT = re.compile(r"rule_(\w+)_wildcards_([0-9A-Za-z-]+)(?:_([0-9]+))?$")
REASONS = {
    "Resources": "no node has enough free",
    "Priority": "other jobs come first",
    "PartitionConfig": "no node of its partition is large enough",
    "PartitionNodeLimit": "no node of its partition is large enough",
    "PartitionTimeLimit": "its time limit is above that of its partition",
    "PartitionDown": "its partition is down",
    "ReqNodeNotAvail": "the nodes that could run it are down or drained",
    "Nodes required for job are DOWN": "the nodes that could run it are down or drained",
    "NodeDown": "its node is down",
    "BeginTime": "Slurm starts it again in a moment",
}


def largest_node(partition: str) -> tuple[int, int]:
    """Processors and memory of the largest node that a partition has.

    Args:
        partition: The partition; empty for all.

    Returns:
        Processors and bytes, each 0 if Slurm does not say.
    """
    words = ["sinfo", "--noheader", "--format=%c %m", *(["--partition", partition] if partition else [])]
    sizes = [line.replace("+", "").split() for line in _answer(words).splitlines()]
    with suppress(ValueError):
        return max((int(cpus) for cpus, _ in sizes), default=0), MEGABYTE * max((int(mb) for _, mb in sizes), default=0)
    return 0, 0


def store_queue(folder: Path) -> None:
    """Store why jobs of a call are waiting, for its monitor.

    Args:
        folder: The call's folder, in which Snakemake submits the jobs.
    """
    waiting = {}
    for line in _answer(["squeue", "--noheader", "--states=PENDING", "--format=%Z|%r|%k"]).splitlines():
        where, reason, comment = [*line.split("|", 2), "", ""][:3]
        found = COMMENT.match(comment)
        if found is not None and where == str(folder):
            rule, key, shard = found.groups()
            job = f"{rule.removesuffix('_shard')}.{shard}" if shard else rule
            waiting[f"{key}/{job}"] = reason_text(reason)
    if waiting != read_queue(folder):
        with suppress(OSError):  # on a full disk, which the jobs report
            write_durably(folder / QUEUE_FILE, json.dumps(waiting))


def read_queue(folder: Path) -> Mapping[str, str]:
    """Why jobs of a call are waiting, by ``capture's key/job``."""
    with suppress(FileNotFoundError):
        stored: Mapping[str, str] = read_json(folder / QUEUE_FILE)
        return stored
    return {}


def reason_text(reason: str) -> str:
    """Slurm's reason of a waiting job in a sentence."""
    words = REASONS.get(reason.partition(",")[0].strip())
    return f"Waiting in Slurm's queue: {words} ({reason})." if words else f"Waiting in Slurm's queue: {reason}."


def _answer(words: list[str]) -> str:
    """Output of one of Slurm's commands; empty if it fails."""
    try:
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout if done.returncode == 0 else ""
