"""Builds the image with buildah in a chroot: no daemon, no registry; debootstrap makes a substitute for the base."""

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
SUITE = "bookworm"  # Debian 12, as in the base's name
DOCKERFILE = Path("docker") / "Dockerfile"
DRIVERS = ("overlay", "vfs")  # the second works everywhere, but copies all files for every layer
TOOLS = ("buildah", "debootstrap", "runc")
# Folders that Debian's slim images leave out: documentation (but licences) and translations; apt keeps no caches.
OMITTED_FOLDERS = ("usr/share/doc", "usr/share/info", "usr/share/lintian", "usr/share/locale", "usr/share/man")
DPKG_SLIM = (
    "".join(f"path-exclude /{folder}/*\n" for folder in OMITTED_FOLDERS) + "path-include /usr/share/doc/*/copyright\n"
)
APT_CLEAN = """\
DPkg::Post-Invoke { "rm -f /var/cache/apt/archives/*.deb /var/cache/apt/*.bin || true"; };
Dir::Cache::pkgcache "";
Dir::Cache::srcpkgcache "";
Acquire::Languages "none";
"""


class Problem(Exception):
    """The image does not meet its requirements, or cannot be tested here."""


@dataclass(frozen=True)
class Image:
    """An unpacked image.

    Attributes:
        root: Its file system.
        entrypoint: Its ENTRYPOINT.
        environment: ``NAME=value``.
        user: User named in the image.
        folder: Its WORKDIR.
        labels: Names of its labels.
    """

    root: Path
    entrypoint: list[str]
    environment: list[str]
    user: str
    folder: str
    labels: list[str]


class ImageTools:
    """buildah with its own storage.

    Args:
        storage: Folder for images and layers.

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
        """Run a buildah command and return its output; with ``quiet=False`` it goes to the terminal."""
        command = [*self._command, *map(str, arguments)]
        done = subprocess.run(command, stdout=subprocess.PIPE if quiet else None, text=True, check=False)
        if done.returncode:
            raise Problem(f"buildah {arguments[0]} failed.")
        return (done.stdout or "").strip()

    def has(self, name: str) -> bool:
        """Whether the storage has an image of that name."""
        return name in self.buildah("images", "--format", "{{.Name}}:{{.Tag}}").split()

    @contextmanager
    def open_image(self) -> Iterator[Image]:
        """Yield the built image, unpacked; nothing stays mounted afterwards."""
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
    base = base_of(root)
    if not tools.has(base):
        say(f"A stand-in for {base}, by debootstrap:")
        _make_base(tools, base, root / "build" / "image" / "base")
    arguments: list[object] = ["--isolation", "chroot", "--pull-never", "--layers", "--target", "cpu", "-t", TAG]
    revision = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=False)
    arguments += ["--build-arg", f"REVISION={revision.stdout.strip() or 'unknown'}"]
    arguments += ["--build-arg", f"TORCH_INDEX={torch_index}", *_index(root / "build" / "image")]
    tools.buildah("bud", *arguments, "-f", root / DOCKERFILE, root, quiet=False)


def base_of(root: Path) -> str:
    """The name of the image's base."""
    found = re.search(r"^ARG BASE=(\S+)$", (root / DOCKERFILE).read_text(encoding="utf-8"), re.MULTILINE)
    if found is None:
        raise Problem(f"{DOCKERFILE} names no base.")
    return found.group(1)


def _make_base(tools: ImageTools, base: str, folder: Path) -> None:
    make_base_folder(folder)
    container = tools.buildah("from", "scratch")
    tools.buildah("add", "-q", container, folder, "/")
    tools.buildah("commit", "-q", container, base)
    tools.buildah("rm", container)
    shutil.rmtree(folder)


def make_base_folder(folder: Path) -> None:
    """Make a stand-in for the base by debootstrap.

    Args:
        folder: Its root; emptied.
    """
    shutil.rmtree(folder, ignore_errors=True)
    command = ["debootstrap", "--variant=minbase", SUITE, str(folder)]
    if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
        raise Problem(f"debootstrap failed; its log: {folder / 'debootstrap' / 'debootstrap.log'}.")
    for leftover in ("var/cache/apt/archives", "var/lib/apt/lists"):
        shutil.rmtree(folder / leftover)
        (folder / leftover / "partial").mkdir(parents=True)
    _make_slim(folder)


def _make_slim(folder: Path) -> None:
    """Leave out of a base, and of packages installed on it later, what Debian's slim images leave out."""
    (folder / "etc" / "dpkg" / "dpkg.cfg.d" / "slim").write_text(DPKG_SLIM, encoding="utf-8")
    (folder / "etc" / "apt" / "apt.conf.d" / "clean").write_text(APT_CLEAN, encoding="utf-8")
    for omitted in OMITTED_FOLDERS:
        for path in (folder / omitted).rglob("*"):
            if not path.is_dir() and path.name != "copyright":
                path.unlink()
    for cache in (folder / "var" / "cache" / "apt").glob("*.bin"):
        cache.unlink()


def _index(work: Path) -> list[object]:
    """Return arguments that pass pip's package index to the build alone: secrets, and mounts of local folders."""
    arguments = index_secrets(work)
    values = [value for name, value in _pip_settings().items() if name not in ("cert", "constraint")]
    for place in sorted({place for value in values for place in _local_paths(value)}):
        arguments += ["-v", f"{place}:{place}:ro"]
    return arguments


def index_secrets(work: Path, address_of: Callable[[Path], str] | None = None) -> list[object]:
    """Return arguments that pass this machine's package indexes and their certificates to a build, as secrets.

    Args:
        work: Folder for the secrets' files.
        address_of: Returns the address at which the build finds a local folder of packages; None if it is mounted.
    """
    settings = _pip_settings()
    if address_of is not None:
        for name, value in settings.items():
            if name == "find-links":
                settings[name] = " ".join(
                    address_of(Path(word)) if Path(word).is_dir() else word for word in value.split()
                )
    certificate = settings.pop("cert", "")
    lines = (f"{name} = {value.replace(chr(10), ' ')}" for name, value in settings.items() if name != "constraint")
    secret = work / "pip.conf"
    secret.write_text("[global]\n" + "\n".join(lines) + "\n", encoding="utf-8")
    secret.chmod(0o600)
    arguments: list[object] = ["--secret", f"id=pip,src={secret}"]
    if (npm := Path.home() / ".npmrc").is_file():
        arguments += ["--secret", f"id=npm,src={npm}"]
    if certificate:
        arguments += ["--secret", f"id=cert,src={certificate}"]
    return arguments


def _pip_settings() -> dict[str, str]:
    """This machine's configuration of pip."""
    listed = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True
    ).stdout
    settings: dict[str, str] = {}
    for line in listed.splitlines():
        name, _, value = line.partition("=")
        settings[name.rpartition(".")[2]] = str(ast.literal_eval(value))
    return settings


def _local_paths(value: str) -> list[Path]:
    """Return the local folders and files that a setting names; for an index, also the folder of its files."""
    words = value.split()
    paths = [Path(word) for word in words if word.startswith("/")]
    paths += [Path(word.removeprefix("file://")).parent for word in words if word.startswith("file:///")]
    return [path for path in paths if path.exists()]
