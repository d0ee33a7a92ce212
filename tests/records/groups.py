"""The groups of slow tests: their sources, and whether these changed since a group's last whole pass."""

from __future__ import annotations

import datetime
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tomli_w
from sources import file_digest, folder_files, sha

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path("tests/records/groups.toml")
RECORD = Path("tests/records/passed.toml")
HEAD = "# Last whole pass of each group of slow tests: written by `make test`, to be committed.\n\n"
EVERYWHERE = "constraints.txt"
OLD_DAYS = 60  # a pass older than that was with other system libraries, compilers and browsers


@dataclass(frozen=True)
class Group:
    """A group of slow tests.

    Attributes:
        name: Its name; also that of its folder in tests/slow, if pytest runs it.
        what: What it tests, for people.
        sources: Files, folders and patterns, relative to the root.
        command: What runs it; empty: pytest, on its folder.
        needs: A path, relative to the root, without which the group cannot run; empty: none.
    """

    name: str
    what: str
    sources: tuple[str, ...]
    command: tuple[str, ...] = ()
    needs: str = ""

    @property
    def folder(self) -> Path:
        """The folder of its tests, relative to the root; it need not exist."""
        return Path("tests/slow") / self.name

    def digest(self, root: Path) -> str:
        """Return the sha256 (hex) of the group's sources, tests and tested versions; comments and order do not count.

        Raises:
            AssertionError: if a source does not exist.
        """
        files = set(_files(root, str(self.folder)))
        for pattern in self.sources:
            found = set(_files(root, pattern))
            assert found, f"{TABLE}: {self.name} names {pattern}, which does not exist"
            files |= found
        versions = sorted(line for line in (root / EVERYWHERE).read_text().splitlines() if "==" in line)
        return sha([versions, *([str(path.relative_to(root)), file_digest(path)] for path in sorted(files))])


@dataclass(frozen=True)
class Pass:
    """A whole pass of a group: the digest of its sources, and the day."""

    sources: str
    day: datetime.date


def _files(root: Path, pattern: str) -> Iterator[Path]:
    for path in root.glob(pattern):
        if path.is_dir() and not pattern.endswith("*"):
            yield from folder_files(path)
        elif path.is_file():
            yield path


def groups(root: Path = ROOT) -> list[Group]:
    """Return the groups, in the order in which they run."""
    table = tomllib.loads((root / TABLE).read_text(encoding="utf-8"))
    return [
        Group(name, entry["what"], tuple(entry["sources"]), tuple(entry.get("command", ())), entry.get("needs", ""))
        for name, entry in table.items()
    ]


def passes(root: Path = ROOT) -> dict[str, Pass]:
    """Return each group's last whole pass."""
    if not (root / RECORD).is_file():
        return {}
    table = tomllib.loads((root / RECORD).read_text(encoding="utf-8"))
    return {name: Pass(entry["sources"], entry["day"]) for name, entry in table.items()}


def record_pass(group: Group, digest: str, day: datetime.date, root: Path = ROOT) -> None:
    """Record a whole pass of a group whose sources had this digest when it began."""
    known = {**passes(root), group.name: Pass(digest, day)}
    table = {each.name: vars(known[each.name]) for each in groups(root) if each.name in known}
    (root / RECORD).write_text(HEAD + tomli_w.dumps(table), encoding="utf-8")
