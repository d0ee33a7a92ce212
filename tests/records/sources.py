"""The sources that a stage's body reaches, and their digest.

Reached are the module of the body and everything that it imports from splatpipe, wherever the import statement is, with
their packages. A package includes the non-Python files in its folder: kernels, scripts, templates. Comments, docstrings
and formatting of Python and C++ do not count.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

PACKAGE = "splatpipe"
NAMED_MODULE = re.compile(rf"{PACKAGE}(\.\w+)+(?=(:\w+)?$)")  # a module imported by name from a string
GENERATED_FOLDERS = ("dist", "node_modules", "__pycache__")
GENERATED = (".so", ".pyc")
UNCOUNTED = (".py", ".pyi", ".so", ".pyc", ".typed")  # read as modules, or irrelevant to the results
RECORD = "versions.toml"  # in a package that all stages reach, and contains the digests
OMITTED_FIELDS = ("ctx", "kind", "type_comment")  # fields of a syntax tree that are redundant, or formatting
CPP = (".cpp", ".h", ".cu", ".cuh")
CPP_NUMBER = r"(?<!\w)\d(?:'?\w)*"  # an apostrophe between digits does not begin a character literal
CPP_PIECES = re.compile(
    rf"""(?P<text>{CPP_NUMBER}|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*')|//[^\n]*|/\*.*?\*/""", re.DOTALL
)
BLANKS = re.compile(r"(?<=\w)\s+(?=\w)|(?P<needless>\s+)")


class Sources:
    """The Python modules below a folder with ``pipeline`` and ``stages``, which must not change meanwhile.

    Args:
        root: The folder: a checkout, or an export of one.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._files: dict[str, Path | None] = {}

    def digest(self, *entries: str) -> str:
        """Return the sha256 (hex) of everything that a stage's bodies reach.

        Args:
            entries: The stage's body and its shards', ``module:function``.
        """
        pieces = []
        for module in sorted({each for entry in entries for each in self.reached(entry.partition(":")[0])}):
            file = self._file(module)
            assert file is not None
            pieces.append([module, _module_digest(file.read_text(encoding="utf-8"))])
            if file.name == "__init__.py":
                pieces += [[f"{module}/{name}", digest] for name, digest in data_digests(file.parent).items()]
        return sha(pieces)

    def reached(self, module: str) -> set[str]:
        """Return the module and all its direct and indirect imports, except those for type checkers only."""
        found: set[str] = set()
        pending = {module}
        while pending:
            name = pending.pop()
            found.add(name)
            above = name.rpartition(".")[0]
            named = {above, *self._imports(name)} if above else self._imports(name)
            pending |= {other for other in named if other not in found and self._file(other)}
        return found

    def _file(self, module: str) -> Path | None:
        if module not in self._files:
            self._files[module] = self._find(module)
        return self._files[module]

    def _find(self, module: str) -> Path | None:
        package, *rest = module.split(".")
        path = self._root.joinpath(*rest)
        if package != PACKAGE or not rest:
            return None
        return next(
            (file for file in (path / "__init__.py", path.with_name(f"{path.name}.py")) if file.is_file()), None
        )

    def _imports(self, module: str) -> set[str]:
        file = self._file(module)
        assert file is not None, f"there is no module {module}"
        package = module if file.name == "__init__.py" else module.rpartition(".")[0]
        return _imports(file.read_text(encoding="utf-8"), package)


@cache
def _tree(text: str) -> ast.Module:
    return ast.parse(text)


@cache
def _imports(text: str, package: str) -> set[str]:
    found = set()
    for node in _run_nodes(_tree(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
        elif (
            isinstance(node, ast.Constant) and isinstance(node.value, str) and (named := NAMED_MODULE.match(node.value))
        ):
            found.add(named.group())
    return {name for name in found if name.split(".")[0] == PACKAGE}


def _run_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes except those for type checkers only."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not (isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING")):
            yield from _run_nodes(child)


@cache
def _module_digest(text: str) -> str:
    return sha(_shape(_tree(text)))


def _shape(node: Any) -> Any:
    """Return a syntax tree as JSON, the same in all Python versions: empty fields and docstrings are omitted."""
    if isinstance(node, ast.AST):
        fields = {name: value for name, value in ast.iter_fields(node) if name not in OMITTED_FIELDS}
        shapes = {name: _shape(value) for name, value in fields.items() if value is not None and value != []}
        return [type(node).__name__, {name: value for name, value in shapes.items() if value != []}]
    if isinstance(node, list):
        return [_shape(item) for item in node if not _is_docstring(item)]
    return f"{type(node).__name__} {node!r}"


def _is_docstring(node: Any) -> bool:
    """Whether a node is a bare string: the docstring of a module, class, function, field or constant."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def data_digests(folder: Path) -> dict[str, str]:
    """Return digests of a package's non-Python files, by relative name; subpackages have their own."""
    return {name: _data_digest(path) for name, path in _data(folder)}


def _data(folder: Path) -> Iterator[tuple[str, Path]]:
    for path in sorted(folder.iterdir()):
        if path.is_dir() and path.name not in GENERATED_FOLDERS and not (path / "__init__.py").is_file():
            yield from ((f"{path.name}/{name}", file) for name, file in _data(path))
        elif path.is_file() and path.suffix not in UNCOUNTED and path.name != RECORD and not path.name.startswith("."):
            yield path.name, path


def file_digest(path: Path) -> str:
    """Return the sha256 (hex) of a file; in Python and C++, comments, docstrings and formatting do not count."""
    return _module_digest(path.read_text(encoding="utf-8")) if path.suffix == ".py" else _data_digest(path)


def folder_files(folder: Path) -> Iterator[Path]:
    """Yield all files in a folder and below it, except what a build or an import leaves there."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and path.name not in GENERATED_FOLDERS:
            yield from folder_files(path)
        elif path.is_file() and path.suffix not in GENERATED and not path.name.startswith("."):
            yield path


def _data_digest(path: Path) -> str:
    if path.suffix not in CPP:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return _cpp_digest(path.read_text(encoding="utf-8"))


@cache
def _cpp_digest(text: str) -> str:
    bare = CPP_PIECES.sub(lambda piece: piece["text"] or " ", text)
    return sha(BLANKS.sub(lambda blank: "" if blank["needless"] else " ", bare))


def sha(value: Any) -> str:
    """Return the sha256 (hex) of a JSON value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
