"""Runs an earlier state of the code and the present one on a small input, and compares each stage's output."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from record import RECORD_FILE, StageSources, differing, present, recorded
from small_capture import CONFIG, write_capture
from trees import Say, Tree, complete, git, take_commit, take_working

HERE = Path(__file__).resolve().parent
MAX_LISTED = 3  # number of differing files that are reported
LOOKED_BACK = 20  # commits that changed the record; a typical branch has fewer


@dataclass(frozen=True)
class Verdict:
    """What must be done about a stage.

    Attributes:
        accepted: Whether its present version is recorded for its present sources.
        why: The reason, in a few words.
    """

    accepted: bool
    why: str


class Comparison:
    """An earlier commit and the working folder side by side.

    Args:
        checkout: The working folder, a git checkout.
        folder: Working folder for both; its contents are dropped, except for built kernels.
        say: Receives progress messages.
    """

    def __init__(self, checkout: Path, folder: Path, say: Say) -> None:
        self._checkout, self._folder, self._say = checkout, folder, say
        for name in ("before", "now", "capture", "earlier", "later"):
            shutil.rmtree(folder / name, ignore_errors=True)

    def last_right(self, names: Sequence[str]) -> str:
        """Return the newest commit whose record is right for the stages: HEAD, or one that changed the record."""
        history = git(self._checkout, "rev-list", f"--max-count={LOOKED_BACK}", "HEAD", "--", str(RECORD_FILE))
        for commit in dict.fromkeys(["HEAD", *history.decode().split()]):
            try:
                tree = take_commit(self._checkout, commit, self._folder / "before")
            except subprocess.CalledProcessError:
                continue  # predates these folders
            before, then = recorded(tree.root), present(tree.root)
            shutil.rmtree(tree.path)
            if before and all(before.get(name) == then.get(name) for name in names):
                return git(self._checkout, "rev-parse", commit).decode().strip()
        sys.exit(
            "No commit here has a right record of these stages. Name one to compare with: make versions SINCE=COMMIT"
        )

    def verdicts(self, commit: str) -> dict[str, Verdict]:
        """Compare with a commit: a verdict on each stage that differs there."""
        before = take_commit(self._checkout, commit, self._folder / "before")
        now = take_working(self._checkout, self._folder / "now")
        then, current = present(before.root), present(now.root)
        verdicts = {
            name: _without_running(then.get(name), current[name])
            for name in differing(current, then)
            if name in current
        }
        wanted = [name for name, verdict in verdicts.items() if verdict is None]
        if wanted:
            complete((before, now), now, self._folder / "kernels", self._say)
            found = self._run(before, now, wanted)
            for name in wanted:
                verdicts[name] = _verdict(found[name], self._files(name))
        return {name: verdict for name, verdict in verdicts.items() if verdict is not None}

    def _run(self, before: Tree, now: Tree, wanted: Sequence[str]) -> dict[str, Any]:
        photos = write_capture(now.root / "demo" / "capture", self._folder / "capture")
        config = self._folder / "capture" / "config.toml"
        config.write_text(CONFIG, encoding="utf-8")
        earlier, later = self._folder / "earlier", self._folder / "later"
        threads = len(os.sched_getaffinity(0))
        self._say("running the line of that commit")
        options = ["--config", str(config), "--device", "cpu", "--threads", str(threads)]
        for name in reversed(wanted):  # the last one needs most others, and existing results are reused
            if not self._manifests(name):
                _check(before.python("-m", before.command, "run", str(photos), str(earlier), *options, "--until", name))
        self._say(f"running the present {', '.join(wanted)} on what it left")
        job = {"earlier": str(earlier), "out": str(later), "photos": str(photos), "threads": threads, "stages": wanted}
        _check(now.python(str(HERE / "rerun.py"), json.dumps(job)))
        result: dict[str, Any] = json.loads((later / "rerun.json").read_text(encoding="utf-8"))
        return result

    def _manifests(self, stage: str) -> list[Path]:
        """Return the manifests of the artifact of the earlier run, if any."""
        return list((self._folder / "earlier" / "stages").glob(f"{stage}-*/manifest.json"))

    def _files(self, stage: str) -> dict[str, str]:
        """Return the files of the earlier run, with their digests."""
        (path,) = self._manifests(stage)
        parts = json.loads(path.read_text(encoding="utf-8"))["parts"].values()
        return {file["path"]: file["sha256"] for part in parts for file in part["files"]}


def _without_running(then: StageSources | None, now: StageSources) -> Verdict | None:
    """Return the verdict if no run is needed; otherwise None."""
    if then is None:
        return Verdict(True, "is new")
    if now.version > then.version:
        return Verdict(True, f"version raised from {then.version} to {now.version}")
    if now.version < then.version:
        return Verdict(False, f"version {now.version} is lower than the {then.version} that it had")
    return None


def _verdict(found: Mapping[str, Any], before: Mapping[str, str]) -> Verdict:
    now, reused = found["files"], found["reused"]
    names = {*now, *before} if reused else {*now} & {*before}
    changed = sorted(name for name in names if now.get(name) != before.get(name))
    if "failed" in found:
        bits = f"fails on what was left before: {found['failed']}"
    elif changed:
        more = f" and {len(changed) - MAX_LISTED} more files" if len(changed) > MAX_LISTED else ""
        bits = f"other bits in {', '.join(changed[:MAX_LISTED])}{more}"
    else:
        bits = f"the same bits in all {len(names)} files"
    if reused:
        return Verdict(not changed, bits)
    return Verdict(True, f"has other options, inputs or parts, so nothing from before is reused (else: {bits})")


def _check(done: subprocess.CompletedProcess[str]) -> None:
    if done.returncode:
        sys.exit(f"That failed (exit code {done.returncode}):\n{done.stdout[-1000:]}{done.stderr[-3000:]}")
