"""Every name that demo, benchmarks and tests import exists: nothing else checks this before they run."""

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

from repository import ROOT

IMPORTING = ("demo", "benchmarks", "tests")
DOOR = ROOT / "pipeline" / "door" / "__init__.py"  # of splatpipe itself
PATHS = (
    "tests",
    "tests/scenes",
    "tests/harness",
    "tests/lines",
    "tests/records",
    *(str(path.relative_to(ROOT)) for path in ROOT.glob("benchmarks/*/")),
)  # where plain names are found


def file_of(module: str, importer: Path) -> Path | None:
    """Return the source of one of our modules, as imported by a given file; None for third-party modules."""
    parts = module.split(".")
    if parts[0] == "splatpipe":
        stems = [ROOT.joinpath(*parts[1:])] if len(parts) > 1 else [DOOR.parent]
    else:
        stems = [folder.joinpath(*parts) for folder in (importer.parent, *(ROOT / each for each in PATHS))]
    found = [path for stem in stems for path in (*map(stem.with_suffix, (".py", ".pyi")), stem / "__init__.py")]
    return next((path for path in found if path.is_file()), None)


def bound(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """The names that statements bind, those in branches as well, but not in functions and classes."""
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from ((alias.asname or alias.name).split(".")[0] for alias in node.names)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        else:
            yield from bound(ast.iter_child_nodes(node))


@cache
def names_of(path: Path) -> frozenset[str]:
    """Return the names that can be imported from one of our sources."""
    names = set(bound(ast.parse(path.read_bytes()).body))
    if path.name == "__init__.py":
        names |= {each.stem for each in (ROOT if path == DOOR else path.parent).iterdir()}
    return frozenset(names)


def whole_name(node: ast.ImportFrom, path: Path) -> str:
    """The module that a statement imports from, as a path of ``splatpipe`` where it is relative."""
    if not node.level:
        return node.module or ""
    package = ("splatpipe", *path.relative_to(ROOT).parent.parts)
    return ".".join([*package[: len(package) - node.level + 1], *filter(None, [node.module])])


def missing(path: Path, source: bytes) -> list[str]:
    """Return the names that a source imports from our modules but that are not defined there."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.ImportFrom):
            continue
        module = whole_name(node, path)
        where = file_of(module, path)
        if where is not None:
            found += [f"{module}.{alias.name}" for alias in node.names if alias.name not in names_of(where)]
        elif module.split(".")[0] == "splatpipe" and not ROOT.joinpath(*module.split(".")[1:]).is_dir():
            found.append(module)
    return found


def test_every_name_imported_from_our_own_modules_exists() -> None:
    sources = [path for folder in IMPORTING for path in sorted((ROOT / folder).rglob("*.py"))]
    found = {str(path.relative_to(ROOT)): missing(path, path.read_bytes()) for path in sources}
    assert len(sources) > 100
    assert {path: names for path, names in found.items() if names} == {}


def test_a_missing_name_or_module_is_noticed() -> None:
    source = b"from .scene import build_scene, gone\nfrom . import house, lost\nfrom splatpipe.nowhere import a"
    found = missing(ROOT / "demo" / "site" / "house.py", source)
    assert found == ["splatpipe.demo.site.scene.gone", "splatpipe.demo.site.lost", "splatpipe.nowhere"]
