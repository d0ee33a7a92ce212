"""Runs an image as a container by an OCI runtime, as strictly as a cluster would."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from building import Image, Problem

USER = 54321  # in no passwd file of the image
SHM = "size=65536k"  # Docker's default
DOCKER_KILLS_S = 10.0
TIMEOUT_S = 3600.0  # for a busy machine; a hanging container fails the test
POLL_S = 0.1
MEMORY = 4 << 30  # memory limit of its control group, bytes
PERIOD_US = 100_000  # period of the control group that limits processors
DEVICES = ["nosuid", "noexec"]


@dataclass(frozen=True)
class Mounts:
    """Folders mounted into the container.

    Attributes:
        photos: Read-only, at ``/photos``.
        out: At ``/out``, the only writable place except ``/dev/shm``.
    """

    photos: Path
    out: Path


@dataclass(frozen=True)
class ContainerEnd:
    """How a stopped container ended.

    Attributes:
        code: Exit code; 137 if it had to be killed, as Docker does after ten seconds.
        seconds: From the signal to the end.
        progress: The stage's last progress before the signal.
        output: The container's last output.
    """

    code: int
    seconds: float
    progress: str
    output: str


class Container:
    """A container of an image that runs one command after another.

    Args:
        image: The image.
        bundle: A folder for the runtime's configuration.
        mounts: Its mounted folders.
    """

    def __init__(self, image: Image, bundle: Path, mounts: Mounts) -> None:
        self._image, self._bundle, self._mounts = image, bundle, mounts
        self._name = f"splatpipe-test-{os.getpid()}"
        os.chown(mounts.out, USER, USER)

    def must_end(self, code: int, command: list[str], say: Callable[[str], None], cores: int = 0) -> str:
        """Run a command to its end, on ``cores`` processors (0: all); return its output.

        Raises:
            Problem: if it ends with another code.
        """
        started_s = time.monotonic()
        with self._running(command, cores) as process:
            process.wait(TIMEOUT_S)
        say(f"splatpipe {' '.join(command)}: exit code {process.returncode}, {time.monotonic() - started_s:.0f} s.")
        if process.returncode != code:
            raise Problem(f"It has to be {code}.\n{self._output()}")
        if "Traceback" in self._output() or "not writable" in self._output():
            raise Problem(f"It complains:\n{self._output()}")
        return self._output()

    def stop_inside(self, command: list[str], stage: str, done: float) -> ContainerEnd:
        """Run a command and send SIGTERM to it once a stage has passed a given progress."""
        before = sum(1 for _ in self._events())
        with self._running(command) as process:
            progress = self._await_progress(process, before, stage, done)
            subprocess.run(["runc", "kill", self._name, "TERM"], check=True)
            sent_s = time.monotonic()
            try:
                process.wait(DOCKER_KILLS_S)
            except subprocess.TimeoutExpired:
                subprocess.run(["runc", "kill", self._name, "KILL"], check=True)
                process.wait(TIMEOUT_S)
            return ContainerEnd(process.returncode, time.monotonic() - sent_s, progress, self._output())

    def _await_progress(self, process: subprocess.Popen[bytes], before: int, stage: str, done: float) -> str:
        until_s = time.monotonic() + TIMEOUT_S
        while time.monotonic() < until_s:
            for event in list(self._events())[before:]:
                data = event["data"]
                if event["stage"] == stage and event["kind"] == "progress" and data["done"] > done:
                    return f"{data['what']} {data['done']:.0f} of {data['total']:.0f}"
            if process.poll() is not None:
                raise Problem(f"It ended before it could be stopped inside {stage}.\n{self._output()}")
            time.sleep(POLL_S)
        raise Problem(f"It never came to {stage}.\n{self._output()}")

    def _events(self) -> Iterator[dict]:
        log = self._mounts.out / "events.jsonl"
        if log.exists():
            for line in log.read_text(encoding="utf-8").splitlines(keepends=True):
                if line.endswith("\n"):
                    yield json.loads(line)

    def _output(self) -> str:
        return (self._bundle / "output.txt").read_text(encoding="utf-8", errors="replace")[-3000:]

    @contextmanager
    def _running(self, command: list[str], cores: int = 0) -> Iterator[subprocess.Popen[bytes]]:
        shutil.rmtree(self._bundle, ignore_errors=True)
        self._bundle.mkdir(parents=True)
        (self._bundle / "config.json").write_text(json.dumps(self._config(command, cores)), encoding="utf-8")
        arguments = ["runc", "run", "--bundle", str(self._bundle), self._name]
        with (self._bundle / "output.txt").open("wb") as output:
            process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        try:
            yield process
        finally:
            if process.poll() is None:
                subprocess.run(["runc", "delete", "--force", self._name], check=False)
                process.wait(TIMEOUT_S)

    def _config(self, command: list[str], cores: int) -> dict:
        """Return the configuration of ``docker run --read-only --network none --user 54321:54321 --memory 4g -v …``."""
        kinds = ("pid", "network", "ipc", "uts", "mount")
        resources: dict = {"memory": {"limit": MEMORY}}
        if cores:
            resources["cpu"] = {"quota": cores * PERIOD_US, "period": PERIOD_US}
        return {
            "ociVersion": "1.0.2",
            "process": {
                "terminal": False,
                "user": {"uid": USER, "gid": USER},
                "args": ["env", "-u", "HOME", *self._image.entrypoint, *command],  # runtimes set HOME
                "env": self._image.environment,
                "cwd": self._image.folder,
                "noNewPrivileges": True,
                "capabilities": {},
            },
            "root": {"path": str(self._image.root), "readonly": True},
            "hostname": "splatpipe",
            "mounts": [
                _mount("/proc", "proc", *DEVICES),
                _mount("/dev", "tmpfs", "nosuid", "mode=755", "size=65536k"),
                _mount("/dev/shm", "tmpfs", *DEVICES, "mode=1777", SHM),
                _mount("/sys", "sysfs", *DEVICES, "ro"),
                _mount("/sys/fs/cgroup", "cgroup", *DEVICES, "ro"),
                _mount("/photos", str(self._mounts.photos), "rbind", "ro"),
                _mount("/out", str(self._mounts.out), "rbind", "rw"),
            ],
            "linux": {"namespaces": [{"type": kind} for kind in kinds], "resources": resources},
        }


def _mount(place: str, source: str, *options: str) -> dict:
    kind = "bind" if source.startswith("/") else source
    return {"destination": place, "type": kind, "source": source, "options": list(options)}
