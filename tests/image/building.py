"""Builds the image with buildah in a chroot: no daemon, no registry, a stand-in for the base made by debootstrap."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

TAG = "splatpipe:cpu"
SUITE = "bookworm"  # Debian 12, as the base's name says
CERT_INSIDE = "/etc/index-certificates.pem"  # beside Debian's own, which a package of the image writes
DOCKERFILE = Path("docker") / "Dockerfile"
DRIVERS = ("overlay", "vfs")  # the second works everywhere, and copies everything for every layer
TOOLS = ("buildah", "debootstrap", "runc")


class Problem(Exception):
    """Why the image is not what it has to be, or cannot be tried here."""


@dataclass(frozen=True)
class Image:
    """An image, unpacked.

    Attributes:
        root: Its file system.
        entrypoint: Its ENTRYPOINT.
        environment: ``NAME=value``.
        user: As the image names it.
        folder: Its WORKDIR.
        labels: Its labels' names.
    """

    root: Path
    entrypoint: list[str]
    environment: list[str]
    user: str
    folder: str
    labels: list[str]


class ImageTools:
    """buildah on a storage of its own.

    Args:
        storage: Where images and layers are kept.

    Raises:
        Problem: if this machine lacks something.
    """

    def __init__(self, storage: Path) -> None:
        missing = [name for name in TOOLS if shutil.which(name) is None]
        if missing:
            raise Problem(f"Needs {', '.join(missing)}: apt install {' '.join(missing)}.")
        if os.geteuid() != 0:
            raise Problem("Needs root, for chroot and mounts: sudo make test-image.")
        self._command = ["buildah"]
        for driver in DRIVERS:
            places = ["--root", str(storage / driver), "--runroot", str(storage / f"{driver}-run")]
            self._command = ["buildah", *places, "--storage-driver", driver]
            if subprocess.run([*self._command, "info"], capture_output=True, check=False).returncode == 0:
                break

    def buildah(self, *arguments: object, quiet: bool = True) -> str:
        """What a buildah command printed; with ``quiet=False`` it goes to the terminal."""
        command = [*self._command, *map(str, arguments)]
        done = subprocess.run(command, stdout=subprocess.PIPE if quiet else None, text=True, check=False)
        if done.returncode:
            raise Problem(f"buildah {arguments[0]} failed.")
        return (done.stdout or "").strip()

    def has(self, name: str) -> bool:
        """Whether an image of that name is in the storage."""
        return name in self.buildah("images", "--format", "{{.Name}}:{{.Tag}}").split()

    @contextmanager
    def open_image(self) -> Iterator[Image]:
        """The image that was built, unpacked; nothing of it stays mounted."""
        container = "splatpipe-test"
        if container in self.buildah("containers", "--format", "{{.ContainerName}}").split():
            self.buildah("rm", container)
        self.buildah("from", "--pull-never", "--name", container, TAG)
        root = Path(self.buildah("mount", container))
        try:
            yield self._image(root)
        finally:
            self.buildah("rm", container)

    def _image(self, root: Path) -> Image:
        config = json.loads(self.buildah("inspect", "--type", "image", TAG))["OCIv1"]["config"]
        return Image(
            root,
            config["Entrypoint"],
            config["Env"],
            config.get("User", ""),
            config.get("WorkingDir", "/"),
            sorted(config.get("Labels", {})),
        )


def build_image(tools: ImageTools, root: Path, torch_index: str, say: Callable[[str], None]) -> None:
    """Build the target ``cpu`` from a checkout."""
    base = _base(root)
    if not tools.has(base):
        say(f"A stand-in for {base}, by debootstrap:")
        _make_base(tools, base, root / "build" / "image" / "base")
    arguments: list[object] = ["--isolation", "chroot", "--pull-never", "--layers", "--target", "cpu", "-t", TAG]
    revision = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=False)
    arguments += ["--build-arg", f"REVISION={revision.stdout.strip() or 'unknown'}"]
    arguments += ["--build-arg", f"TORCH_INDEX={torch_index}", *_index(root / "build" / "image")]
    tools.buildah("bud", *arguments, "-f", root / DOCKERFILE, root, quiet=False)


def _base(root: Path) -> str:
    found = re.search(r"^ARG BASE=(\S+)$", (root / DOCKERFILE).read_text(encoding="utf-8"), re.MULTILINE)
    if found is None:
        raise Problem(f"{DOCKERFILE} names no base.")
    return found.group(1)


def _make_base(tools: ImageTools, base: str, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    command = ["debootstrap", "--variant=minbase", SUITE, str(folder)]
    if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
        raise Problem(f"debootstrap failed; its log: {folder / 'debootstrap' / 'debootstrap.log'}.")
    for leftover in ("var/cache/apt/archives", "var/lib/apt/lists"):
        shutil.rmtree(folder / leftover)
        (folder / leftover / "partial").mkdir(parents=True)
    container = tools.buildah("from", "scratch")
    tools.buildah("add", "-q", container, folder, "/")
    tools.buildah("commit", "-q", container, base)
    tools.buildah("rm", container)
    shutil.rmtree(folder)


def _index(work: Path) -> list[object]:
    """The package index as this machine's pip is told it, for the build alone: a secret, mounts, a certificate."""
    listed = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True
    ).stdout
    settings: dict[str, str] = {}
    for line in listed.splitlines():
        name, _, value = line.partition("=")
        settings[name.rpartition(".")[2]] = str(ast.literal_eval(value))
    certificate = settings.pop("cert", "")
    lines = (f"{name} = {value.replace(chr(10), ' ')}" for name, value in settings.items())
    secret = work / "pip.conf"
    secret.write_text("[global]\n" + "\n".join(lines) + "\n", encoding="utf-8")
    secret.chmod(0o600)
    arguments: list[object] = ["--secret", f"id=pip,src={secret}"]
    for place in sorted({place for value in settings.values() for place in _folders(value)}):
        arguments += ["-v", f"{place}:{place}:ro"]
    if certificate:
        arguments += ["-v", f"{certificate}:{CERT_INSIDE}:ro", "--build-arg", f"PIP_CERT={CERT_INSIDE}"]
        arguments += ["--build-arg", f"NODE_EXTRA_CA_CERTS={CERT_INSIDE}"]
    return arguments


def _folders(value: str) -> list[Path]:
    """Folders of this machine that a setting names; of an index the one that its files lie in, too."""
    words = value.split()
    folders = [Path(word) for word in words if word.startswith("/")]
    folders += [Path(word.removeprefix("file://")).parent for word in words if word.startswith("file:///")]
    return [folder for folder in folders if folder.is_dir()]
