"""``import splatpipe`` is light, lazy and typed, and its names and signatures are those of docs/api.md."""

from __future__ import annotations

import ast

import api_page
import pytest
from repository import ROOT

import splatpipe

DOOR = ROOT / "pipeline" / "door" / "__init__.py"


def test_names_and_signatures_are_those_of_the_page() -> None:
    assert api_page.PAGE.read_text(encoding="utf-8") == api_page.written(), (
        "The library's interface has changed, which is a decision: if it is meant, run make api-page."
    )


def test_every_public_name_is_loaded_when_it_is_used_and_nothing_else_is_public() -> None:
    for name in splatpipe.__all__:
        assert getattr(splatpipe, name) is not None
    assert dir(splatpipe) == splatpipe.__all__ == sorted(splatpipe.__all__)
    with pytest.raises(AttributeError, match="no attribute 'rasterize'"):
        splatpipe.rasterize  # type: ignore[attr-defined]  # noqa: B018


def test_type_checkers_see_the_names_where_they_are_loaded_from() -> None:
    tree = ast.parse(DOOR.read_bytes())
    branch = next(node for node in tree.body if isinstance(node, ast.If))  # if TYPE_CHECKING
    seen = {
        alias.name: f"{node.module}".removeprefix("splatpipe.pipeline.")
        for node in branch.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == splatpipe._MODULES  # type: ignore[attr-defined]
    assert {*seen, "__version__"} == set(splatpipe.__all__)


def test_what_is_public_has_a_docstring_that_says_what_it_takes() -> None:
    for name in splatpipe.__all__:
        if name != "__version__":
            value = getattr(splatpipe, name)
            assert value.__doc__, name
            assert callable(value)
            if not isinstance(value, type):
                assert "Args:" in value.__doc__ and "Raises:" in value.__doc__, name
