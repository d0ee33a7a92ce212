"""``make develop``: installs splatpipe as links to its sources instead of copies of them.

``.venv/links/splatpipe`` gets a link to each folder that a wheel would contain a copy of, and a ``.pth`` file names it:
a plain path, which editors and type checkers follow, too. The compiled kernels are copied from the wheel to the
sources; its metadata and commands are installed unchanged, so that pip uninstalls the links like any other files.
"""

from __future__ import annotations

import base64
import hashlib
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]
LINKS = Path(sys.prefix) / "links"
PATH_FILE = "splatpipe_links.pth"
CHECK = "import splatpipe.pipeline as p, sys; sys.exit(not p.__file__.startswith(sys.argv[1]))"


def link_sources(folder: Path) -> None:
    """Make a folder from which splatpipe can be imported as it is in the sources, with what a wheel leaves out."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        folders = tomllib.load(file)["tool"]["scikit-build"]["wheel"]["packages"]
    for installed, source in folders.items():
        link = folder / installed
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(ROOT / source)


def main(wheel: Path) -> None:
    """Install links in place of a wheel."""
    link_sources(LINKS)
    for library in (LINKS / "splatpipe" / "pipeline" / "native").glob("lib*.so"):
        library.unlink()  # CUDA's, which this wheel may lack
    with zipfile.ZipFile(wheel) as archive, tempfile.TemporaryDirectory() as scratch:
        for name in archive.namelist():
            if name.endswith(".so"):
                target = LINKS / name
                target.unlink(missing_ok=True)  # not overwritten: a running program may have it mapped
                target.write_bytes(archive.read(name))
        thin = Path(scratch) / wheel.name
        _write_thin_wheel(archive, thin)
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "-q", "--no-deps"]
        subprocess.run([*pip, "--force-reinstall", str(thin)], check=True)
    done = subprocess.run([sys.executable, "-P", "-c", CHECK, f"{LINKS}/"], check=False)
    if done.returncode:
        sys.exit(f"splatpipe is not imported from {LINKS}: what else of it is in {sys.prefix}?")


def _write_thin_wheel(archive: zipfile.ZipFile, target: Path) -> None:
    """Write a wheel with the metadata, and the path file in place of the package."""
    members = {
        name: archive.read(name)
        for name in archive.namelist()
        if PurePosixPath(name).parts[0].endswith(".dist-info") and not name.endswith(("/RECORD", "/"))
    }
    members[PATH_FILE] = f"{LINKS}\n".encode()
    record = next(name for name in archive.namelist() if name.endswith(".dist-info/RECORD"))
    rows = [f"{name},sha256={_digest(content)},{len(content)}" for name, content in members.items()]
    with zipfile.ZipFile(target, "w") as thin:
        for name, content in members.items():
            thin.writestr(name, content)
        thin.writestr(record, "\n".join([*rows, f"{record},,", ""]))


def _digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()


if __name__ == "__main__":
    if sys.argv[1] == "--sources":
        link_sources(Path(sys.argv[2]))
    else:
        main(Path(sys.argv[1]))
