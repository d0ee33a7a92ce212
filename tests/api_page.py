"""``make api-page``: writes the public names and signatures of ``docs/api.md`` from the code.

What ``import splatpipe`` offers is stable: a changed signature shows in this page, and is a decision.
"""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from generated_pages import write

import splatpipe

PAGE = Path(__file__).resolve().parents[1] / "docs" / "api.md"
MARK = "<!-- Below this line: make api-page -->"
WIDTH = 120  # characters of a line
RAISED = ("__init__", "Exception")  # the constructor of an error is public, too


def written() -> str:
    """Return the whole page: the hand-written part above the mark, and the interface below it."""
    by_hand, mark, _ = PAGE.read_text(encoding="utf-8").partition(MARK)
    if not mark:
        raise ValueError(f"{PAGE} has no line {MARK}")
    return f"{by_hand}{MARK}\n\n{interface()}"


def interface() -> str:
    """Return a section for each public name, functions first, with its signature as Python, in Markdown."""
    names = [name for name in splatpipe.__all__ if not name.startswith("_")]
    found = {name: definition(name) for name in sorted(names, key=lambda name: (name[0].isupper(), name))}
    return "\n\n".join(f"## {name}\n\n```python\n{code}\n```" for name, code in found.items()) + "\n"


def definition(name: str) -> str:
    """Return the signature of a public function or class, with the first line of its docstring."""
    module = f"splatpipe.pipeline.{splatpipe._MODULES[name]}"  # type: ignore[attr-defined]
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None, module
    body = ast.parse(Path(spec.origin).read_bytes()).body
    node = next(each for each in body if isinstance(each, ast.FunctionDef | ast.ClassDef) and each.name == name)
    lines = list(_class(node) if isinstance(node, ast.ClassDef) else _function(node, ""))
    return "\n".join([*_types_in(body, "\n".join(lines)), *lines])


def _types_in(body: Sequence[ast.stmt], text: str) -> Iterator[str]:
    """Yield the module's own names that signatures use: types and defaults."""
    for each in body:
        name = _code(each.targets[0]) if isinstance(each, ast.Assign) else ""
        if name and re.search(rf"(: |= |\| ){name}\b", text):
            yield _code(each)


def _class(node: ast.ClassDef) -> Iterator[str]:
    bases = ", ".join(map(_code, node.bases))
    yield f"class {node.name}({bases}):" if bases else f"class {node.name}:"
    yield f"    {_summary(node)}"
    for each in node.body:
        if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name) and not each.target.id.startswith("_"):
            yield f"    {_code(each)}"
        elif isinstance(each, ast.FunctionDef) and (not each.name.startswith("_") or (each.name, bases) == RAISED):
            yield from _function(each, "    ")


def _function(node: ast.FunctionDef, indent: str) -> Iterator[str]:
    kinds = [_code(decorator) for decorator in node.decorator_list]
    yield from (f"{indent}@{kind.removeprefix('cached_')}" for kind in kinds)
    returns = "" if node.returns is None else f" -> {_code(node.returns)}"
    arguments = list(_arguments(node.args))
    line = f"{indent}def {node.name}({', '.join(arguments)}){returns}:"
    if len(line) <= WIDTH:
        yield line
    else:
        yield f"{indent}def {node.name}("
        yield from (f"{indent}    {argument}," for argument in arguments)
        yield f"{indent}){returns}:"
    yield f"{indent}    {_summary(node)}"


def _arguments(arguments: ast.arguments) -> Iterator[str]:
    """Yield each argument as in a signature."""
    required = [None] * (len(arguments.args) - len(arguments.defaults))
    for argument, default in zip(arguments.args, [*required, *arguments.defaults], strict=True):
        yield _argument(argument, default)
    if arguments.vararg is not None or arguments.kwonlyargs:
        yield "*" if arguments.vararg is None else f"*{_code(arguments.vararg)}"
    for argument, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True):
        yield _argument(argument, default)
    if arguments.kwarg is not None:
        yield f"**{_code(arguments.kwarg)}"


def _argument(argument: ast.arg, default: ast.expr | None) -> str:
    return _code(argument) + ("" if default is None else f" = {_code(default)}")


def _code(node: ast.AST) -> str:
    return ast.unparse(node).replace("'", '"')


def _summary(node: ast.ClassDef | ast.FunctionDef) -> str:
    first = (ast.get_docstring(node) or "").partition("\n")[0]
    return f'"""{first}"""' if first else "..."


if __name__ == "__main__":
    sys.exit(write({PAGE: written()}))
