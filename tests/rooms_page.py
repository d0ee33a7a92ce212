"""``make rooms-page``: writes the graphs and tables of ``docs/rooms.md`` and ``docs/stages.md``.

The rooms come from import-linter's contracts in ``pyproject.toml`` and from the imports themselves, the stages from
``stages/line.py``.
"""

from __future__ import annotations

import ast
import functools
import json
import os
import re
import subprocess
import sys
import tempfile
import textwrap
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from generated_pages import write
from links import link_sources

from splatpipe.pipeline.engine.stage import Stage
from splatpipe.stages.line import LINE

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PACKAGE = "splatpipe"
IMPORTS = (
    "import grimp, json, sys\n"
    "graph = grimp.build_graph(sys.argv[1], cache_dir=None)\n"
    "print(json.dumps({each: sorted(graph.find_modules_directly_imported_by(each)) for each in graph.modules}))"
)
ROOMS = f"{PACKAGE}.pipeline"
STAGES = f"{PACKAGE}.stages"  # drawn among the rooms: above the libraries, below the apps
SOURCE = "source"  # what a stage reads of the user's files
OTHER_SOURCES = (".c", ".cpp", ".cu", ".cuh", ".h", ".ts", ".js", ".css", ".html", ".txt", ".cmake")
WIDTH = 120  # characters of a line
NOT_SOURCES = {"node_modules", "dist", "licences", "__pycache__"}

Edges = Mapping[str, set[str]]


def pages() -> dict[Path, str]:
    """Return the text of each page with its generated parts brought up to date."""
    parts = {
        "rooms.md": {"rooms": rooms_part(), "inner rooms": inner_rooms_part()},
        "stages.md": {"line": line_graph(), "reads": line_table()},
    }
    return {DOCS / name: _replaced(DOCS / name, texts) for name, texts in parts.items()}


def rooms_part() -> str:
    """Return the graph of the rooms and their table, in Markdown."""
    rooms = [room for room in containers()[ROOMS] if _is_package(room)]
    edges = reduced(room_imports([rooms[0], STAGES, *rooms[1:]]))
    return f"{graph(edges)}\n\n{rooms_table(rooms)}"


def inner_rooms_part() -> str:
    """Return a section for each room that a contract divides into inner rooms, in Markdown."""
    sections = []
    for container, members in containers().items():
        rooms = [member for member in members if _is_package(member)]
        if container in (ROOMS, STAGES) or not rooms:
            continue
        title = container.removeprefix(f"{ROOMS}.").removeprefix(f"{PACKAGE}.").replace(".", "/")
        beside = [f"`{_name(module)}`" for module in sorted(set(_modules(container)) - set(rooms))]
        files = "\n\n" + textwrap.fill(f"Beside them: {', '.join(beside)}.", WIDTH) if beside else ""
        drawn = f"{graph(reduced(room_imports(rooms)))}\n\n" if len(rooms) > 1 else ""
        sections.append(f"### {title}\n\n{drawn}{rooms_table(rooms)}{files}")
    return "\n\n".join(sections) or "No room has inner rooms."


def containers() -> dict[str, list[str]]:
    """Return the members of each container that a contract of layers names, highest layer first."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    found: dict[str, list[str]] = {}
    for contract in settings["tool"]["importlinter"]["contracts"]:
        if contract["type"] != "layers":
            continue
        layers = [layer for layer in contract["layers"] if not layer.startswith("(")]  # an optional one is in no wheel
        names = [name.strip() for layer in layers for name in re.split(r"[|:]", layer)]
        for container in contract.get("containers", ()):
            found.setdefault(container, []).extend(f"{container}.{name}" for name in names)
    return found


def room_imports(rooms: Iterable[str]) -> dict[str, set[str]]:
    """Return, for each room, the others that its modules import."""
    imports = source_imports()
    room_of = {module: room for room in rooms for module in imports if f"{module}.".startswith(f"{room}.")}
    edges: dict[str, set[str]] = {room: set() for room in rooms}
    for module, room in room_of.items():
        targets = {room_of.get(each) for each in imports[module]}
        edges[room] |= {target for target in targets if target and target != room}
    return edges


@functools.cache
def source_imports() -> Mapping[str, list[str]]:
    """Return what each module of the sources imports of splatpipe; in a process that has not imported a wheel's."""
    with tempfile.TemporaryDirectory() as folder:
        link_sources(Path(folder))
        environment = {**os.environ, "PYTHONPATH": folder}
        command = [sys.executable, "-P", "-c", IMPORTS, PACKAGE]
        done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    found: Mapping[str, list[str]] = json.loads(done.stdout)
    return found


def reduced(edges: Edges) -> dict[str, set[str]]:
    """Return the transitive reduction: without the edges that a longer way replaces.

    Raises:
        ValueError: if the edges have a circle.
    """
    reached: dict[str, set[str]] = {}

    def reach(node: str, way: tuple[str, ...] = ()) -> set[str]:
        if node in way:
            raise ValueError(f"a circle: {' imports '.join((*way, node))}")
        if node not in reached:
            reached[node] = set().union(*({each} | reach(each, (*way, node)) for each in edges[node]))
        return reached[node]

    for node in edges:
        reach(node)
    return {
        node: {each for each in targets if not any(each in reached[other] for other in targets)}
        for node, targets in edges.items()
    }


def graph(edges: Edges) -> str:
    """Return a Mermaid graph with an arrow from each room to those that it uses."""
    lines = ["```mermaid", "flowchart TD"]
    lines += [f"    {_id(node)}[{_name(node)}]" for node in edges]
    lines += [f"    {_id(node)} --> {_id(each)}" for node in edges for each in edges if each in edges[node]]
    return "\n".join([*lines, "```"])


def rooms_table(rooms: Iterable[str]) -> str:
    """Return a row for each room: what it holds, its modules, their lines, the largest; and its other sources."""
    rows = [["room", "holds", "modules", "lines", "largest module", "other sources"]]
    for room in rooms:
        modules = {path: _lines(path) for path in _sources(room, (".py",)) if path.name != "__init__.py"}
        others = list(_sources(room, OTHER_SOURCES))
        largest = max(modules, key=lambda path: (modules[path], path.name), default=None)
        rows.append(
            [
                f"`{_name(room)}`",
                _holds(room),
                f"{len(modules)}",
                f"{_rounded(sum(modules.values())):,}",
                f"`{_shown(largest)}`, {_rounded(modules[largest]):,}" if largest else "",
                f"{len(others)} files, {_rounded(sum(map(_lines, others))):,} lines" if others else "",
            ]
        )
    if not any(row[-1] for row in rows[1:]):
        rows = [row[:-1] for row in rows]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    lines.insert(1, "|" + "---|" * len(rows[0]))
    return "\n".join(lines)


def line_graph() -> str:
    """Return the graph of the stages: an arrow leads from a stage to those that need what it makes."""
    needs = {SOURCE: set[str](), **{stage.name: _needs(stage) for stage in LINE}}
    kept = reduced(needs)
    lines = ["```mermaid", "flowchart TD", f"    {_id(SOURCE)}([photos and survey files])"]
    for stage in LINE:
        box = f"[[{stage.name}]]" if stage.deliverables else f"[{stage.name}]"
        lines.append(f"    {_id(stage.name)}{box}")
    lines += [f"    {_id(need)} --> {_id(stage.name)}" for stage in LINE for need in needs if need in kept[stage.name]]
    return "\n".join([*lines, "```"])


def line_table() -> str:
    """Return a row for each stage: the parts that it reads, by stage, and those that it writes; bold: delivered."""
    rows = ["| stage | reads | writes |", "|---|---|---|"]
    for stage in LINE:
        read: dict[str, list[str]] = {}
        for part in stage.reads:
            owner, _, name = part.partition(".")
            read.setdefault(owner, []).append(name)
        reads = "; ".join(f"{owner}: {', '.join(names)}" for owner, names in read.items())
        writes = ", ".join(f"**{part}**" if part in stage.deliverables else part for part in stage.parts)
        rows.append(f"| `{stage.name}` | {reads} | {writes} |")
    return "\n".join(rows)


def _needs(stage: Stage) -> set[str]:
    """The stages, or the user's files, whose parts a stage reads."""
    return {part.partition(".")[0] for part in stage.reads}


def _replaced(page: Path, parts: Mapping[str, str]) -> str:
    """A page's text with new text between each pair of its marks."""
    text = page.read_text(encoding="utf-8")
    for name, part in parts.items():
        begin, end = f"<!-- {name}: make rooms-page -->", f"<!-- end of {name} -->"
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        if not found or not closed:
            raise ValueError(f"{page} has no lines {begin} and {end}")
        text = f"{before}{begin}\n\n{part}\n\n{end}{after}"
    return text


def _folder(module: str) -> Path:
    return ROOT.joinpath(*module.split(".")[1:])


def _is_package(module: str) -> bool:
    return _folder(module).is_dir()


def _modules(package: str) -> Iterator[str]:
    """The modules and packages directly inside a package."""
    for path in _folder(package).iterdir():
        if path.suffix == ".py" and path.name != "__init__.py":
            yield f"{package}.{path.stem}"
        elif (path / "__init__.py").is_file():
            yield f"{package}.{path.name}"


def _sources(room: str, suffixes: tuple[str, ...]) -> Iterator[Path]:
    """The source files of a room, those of its inner rooms included."""
    folder = _folder(room)
    for path in sorted(folder.rglob("*")):
        if path.suffix in suffixes and not NOT_SOURCES & set(path.relative_to(folder).parts):
            yield path


def _lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def _rounded(count: int) -> int:
    """A count to two significant digits, so that small edits do not change the page."""
    return int(float(f"{count:.1e}"))


def _holds(room: str) -> str:
    """The first sentence of a package's docstring, without its full stop."""
    file = _folder(room) / "__init__.py"
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) if file.is_file() else None
    first = " ".join((docstring or "").split("\n\n")[0].split())
    return re.split(r"\.(?: |$)", first)[0].replace("|", "\\|").replace("``", "`")


def _shown(path: Path) -> Path:
    """A module's path below the rooms' folder, or below the repository's."""
    return path.relative_to(_folder(ROOMS) if path.is_relative_to(_folder(ROOMS)) else ROOT)


def _name(module: str) -> str:
    return module.rpartition(".")[2]


def _id(module: str) -> str:
    """A node's name in Mermaid, for which ``end`` and the like are reserved."""
    return f"{_name(module)}_"


if __name__ == "__main__":
    sys.exit(write(pages()))
