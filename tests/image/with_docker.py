"""``make test-docker``: builds the CPU image with Docker as docs/containers.md says, and runs it and the compose file.

A Docker daemon of its own runs without a bridge, on a base made by debootstrap. The image has to keep what is promised:
read-only, without a network, as any user, within little memory, and with folders that do not exist.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

from building import DOCKERFILE, Problem, base_of, index_secrets, make_base_folder

ROOT = Path(__file__).resolve().parents[2]
WORK = ROOT / "build" / "docker"
PROGRAMS = {"docker": "docker.io", "dockerd": "docker.io", "debootstrap": "debootstrap"}
TAG = "splatpipe:cpu"
PHOTOS = 6
USER = "54321:54321"
TIMEOUT_S = 60.0
SHORT = ("--preset", "preview", "--set", "train.iterations=100")


def main() -> int:
    """Run the test; return the exit code: 0 if everything holds."""
    parser = argparse.ArgumentParser(prog="make test-docker", description=__doc__)
    parser.add_argument("--torch-index", default="", help="index of torch alone; empty for that of the rest")
    parser.add_argument("--no-build", action="store_true", help="take the image that the last call left")
    options = parser.parse_args()
    try:
        missing = sorted({package for name, package in PROGRAMS.items() if shutil.which(name) is None})
        if missing:
            raise Problem(f"Needs {', '.join(missing)}: apt install {' '.join(missing)}.")
        if os.geteuid() != 0:
            raise Problem("Needs root, for a daemon of its own: sudo make test-docker.")
        WORK.mkdir(parents=True, exist_ok=True)
        with daemon():
            if not options.no_build:
                build(options.torch_index)
            check_memory()
            check_compose()
            check_restrictions()
    except Problem as problem:
        say(f"FAILED: {problem}")
        return 1
    say("The image and the compose file do what is promised.")
    return 0


@contextmanager
def daemon() -> Iterator[None]:
    """Run a Docker daemon with its own folder and socket; it and what it started end afterwards."""
    socket = WORK / "socket"
    command = ["dockerd", "--data-root", WORK / "data", "--exec-root", WORK / "exec", "--pidfile", WORK / "pid"]
    command += ["-H", f"unix://{socket}", "--iptables=false", "--ip6tables=false", "--bridge=none"]
    with (WORK / "dockerd.txt").open("wb") as log:
        process = subprocess.Popen([*map(str, command)], stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    os.environ["DOCKER_HOST"] = f"unix://{socket}"
    try:
        until_s = time.monotonic() + TIMEOUT_S
        while docker("version", "--format", "{{.Server.Version}}").returncode:
            if process.poll() is not None or time.monotonic() > until_s:
                raise Problem(f"dockerd does not start; its output is in {WORK / 'dockerd.txt'}.")
            time.sleep(0.5)
        say(f"Docker {docker('version', '--format', '{{.Server.Version}}').stdout.strip()} runs.")
        yield
    finally:
        for container in docker("ps", "-q").stdout.split():
            docker("kill", container)
        process.terminate()
        process.wait(TIMEOUT_S)


def docker(*arguments: object, buildkit: bool = True) -> subprocess.CompletedProcess[str]:
    """Run a Docker command."""
    environment = {**os.environ, "DOCKER_BUILDKIT": "1" if buildkit else "0", "BUILDKIT_PROGRESS": "plain"}
    command = ["/usr/bin/docker" if Path("/usr/bin/docker").exists() else "docker", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


@contextmanager
def served_folders() -> Iterator[Callable[[Path], str]]:
    """Yield a function that serves a local folder of packages to the build, which has no mounts."""
    servers = []

    def address_of(folder: Path) -> str:
        handler = partial(QuietHandler, directory=str(folder))
        servers.append(ThreadingHTTPServer(("127.0.0.1", 0), handler))
        Thread(target=servers[-1].serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{servers[-1].server_port}/"

    try:
        yield address_of
    finally:
        for server in servers:
            server.shutdown()


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves a folder without a line for every request."""

    def log_message(self, *_arguments: object) -> None:
        pass


def build(torch_index: str) -> None:
    """Build the image as documented, on a base made by debootstrap."""
    base = base_of(ROOT)
    if docker("image", "inspect", base).returncode:
        say(f"A stand-in for {base}, by debootstrap:")
        folder = WORK / "base"
        make_base_folder(folder)
        with subprocess.Popen(["tar", "-C", str(folder), "-c", "."], stdout=subprocess.PIPE) as tar:
            command = ["docker", "import", "-", base]
            subprocess.run(command, stdin=tar.stdout, stdout=subprocess.DEVNULL, check=True)
        shutil.rmtree(folder)
    small = WORK / "secret"
    small.mkdir(exist_ok=True)
    (small / "Dockerfile").write_text(f"FROM {base}\nRUN --mount=type=secret,id=pip true\n", encoding="utf-8")
    refusal = docker("build", small, buildkit=False)
    if refusal.returncode == 0 or "BuildKit" not in refusal.stderr:
        raise Problem(f"Without BuildKit it has to be refused: {refusal.stderr[-500:]}")
    say(f"Without BuildKit: {refusal.stderr.strip().splitlines()[-1]}")
    began_s = time.monotonic()
    with served_folders() as address_of:
        arguments = ["--network", "host", *index_secrets(WORK, address_of), "--build-arg", f"TORCH_INDEX={torch_index}"]
        done = docker("build", *arguments, "-f", ROOT / DOCKERFILE, "--target", "cpu", "-t", TAG, ROOT)
    (WORK / "build.txt").write_text(done.stdout + done.stderr, encoding="utf-8")
    if done.returncode:
        raise Problem(f"The build failed; its output is in {WORK / 'build.txt'}.\n{done.stderr[-1500:]}")
    size = int(docker("image", "inspect", "--format", "{{.Size}}", TAG).stdout)
    say(f"Built in {time.monotonic() - began_s:.0f} s: {size / 1e6:.0f} MB unpacked.")
    history = docker("history", "--no-trunc", TAG).stdout
    if any(secret in history for secret in ("pip.conf\n", "index-url")):
        raise Problem("The image's history names the package index.")


def photos() -> Path:
    """A folder of a few of the demo's photos, copied: the container sees no others."""
    folder = WORK / "photos"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for photo in sorted((ROOT / "demo" / "capture" / "photos").glob("*.JPG"))[:PHOTOS]:
        shutil.copy(photo, folder)
    return folder


def new_out(name: str) -> Path:
    """An OUT that the container's user may write to."""
    out = WORK / "out" / name
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    os.chown(out, *map(int, USER.split(":")))
    return out


def contained(options: Sequence[object], *command: object) -> subprocess.CompletedProcess[str]:
    """Run splatpipe in a container under the restrictions that docs/containers.md names."""
    strict = ["--user", USER, "--read-only", "--network", "none", "--cap-drop", "ALL"]
    return docker("run", "--rm", *strict, "--security-opt", "no-new-privileges:true", *options, TAG, *command)


def check_restrictions() -> None:
    """The demo's photos under all restrictions, and again: everything is reused."""
    places = ["-v", f"{photos()}:/photos:ro", "-v", f"{new_out('strict')}:/out"]
    for turn in ("it ran", "again"):
        began_s = time.monotonic()
        done = contained([*places, "--memory", "4g", "--cpus", "2"], "run", "/photos", "/out", *SHORT)
        if done.returncode:
            raise Problem(f"It ended with {done.returncode}.\n{done.stderr[-1500:]}")
        say(f"Read-only, no network, user {USER}, 4 GB: {turn} in {time.monotonic() - began_s:.0f} s.")


def check_memory() -> None:
    """Too little memory is told at once; a worker that the kernel kills gives 3, process 1 gives 137."""
    places = ["-v", f"{photos()}:/photos:ro"]
    for limit in ("500m", "700m"):
        began_s = time.monotonic()
        out = new_out(limit)
        done = contained([*places, "-v", f"{out}:/out", "--memory", limit], "run", "/photos", "/out", *SHORT)
        errors = " ".join(done.stderr.replace("│", " ").split())
        say(f"--memory {limit}: exit code {done.returncode} after {time.monotonic() - began_s:.0f} s. {errors[-330:]}")
        if done.returncode != 4 or "Training does not fit" not in errors or (out / "stages").exists():
            raise Problem("It has to be refused at once, with 4.")
    for limit, code, killed in (("110m", 3, "the stage's process"), ("40m", 137, "process 1")):
        sizes = [*places, "-v", f"{new_out(limit)}:/out", "--memory", limit, "--memory-swap", limit]
        done = contained(sizes, "run", "/photos", "/out", *SHORT, "--until", "ingest")
        errors = " ".join(done.stderr.replace("│", " ").split())
        say(f"--memory {limit} kills {killed}: exit code {done.returncode}. {errors[-250:]}")
        if done.returncode != code:
            raise Problem(f"It has to be {code}.")


def check_compose() -> None:
    """The compose file: a run, and folders that do not exist."""
    program = shutil.which("docker-compose")
    if program is None:
        say("There is no docker-compose (apt install docker-compose): its file is not tried.")
        return
    version = subprocess.run([program, "version", "--short"], capture_output=True, text=True, check=True).stdout.strip()
    here, out = photos(), new_out("compose")
    wrong = WORK / "photoos"
    run = ["run", "--rm", "run", "run", "/photos", "/out", "--preset", "preview", "--until", "ingest"]
    for place, code in ((here, 0), (wrong, 1)):
        environment = {**os.environ, "PHOTOS": str(place), "OUT": str(out), "SPLATPIPE_USER": USER}
        command = [program, "-f", str(ROOT / "docker" / "compose.yaml"), *run]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        say(f"compose {version}, PHOTOS={place.name}: exit code {done.returncode}. {done.stderr.strip()[-200:]}")
        if bool(done.returncode) != bool(code) or wrong.exists():
            raise Problem("It has to run with a folder, and to refuse a missing one without making it.")


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
