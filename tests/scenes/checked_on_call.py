"""Checks of annotations that are compiled when a function is first called: most functions are imported and not called.

jaxtyping's import hook compiles the checks of every function of a module as it is imported, two thirds of a test
process's start.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from types import FunctionType
from typing import Any

import jaxtyping

_compile = jaxtyping.jaxtyped


def install() -> None:
    """Let jaxtyping's import hook, which looks its decorator up by name, use ``check_on_call``."""
    jaxtyping.jaxtyped = check_on_call  # type: ignore[assignment]


def check_on_call(target: Any = None, *, typechecker: Any) -> Any:
    """Stand in for ``jaxtyping.jaxtyped``: the same checks of functions, methods, properties and dataclasses."""
    if target is None:
        return functools.partial(check_on_call, typechecker=typechecker)
    if isinstance(target, FunctionType):
        return _checked(target, typechecker)
    if isinstance(target, classmethod | staticmethod):
        return type(target)(check_on_call(target.__func__, typechecker=typechecker))
    if isinstance(target, property) and target.fset is None:
        return property(check_on_call(target.fget, typechecker=typechecker))
    if inspect.isclass(target) and is_dataclass(target) and isinstance(target.__init__, FunctionType):
        if not hasattr(target.__init__, "__wrapped__"):  # otherwise inherited, and checked there
            target.__init__ = _checked(target.__init__, typechecker)  # type: ignore[misc]
        return target
    return _compile(target, typechecker=typechecker)


def _checked(function: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
    compiled: list[Callable[..., Any]] = []

    @functools.wraps(function)
    def on_call(*arguments: Any, **named: Any) -> Any:
        if not compiled:
            compiled.append(_compile(function, typechecker=typechecker))
        return compiled[0](*arguments, **named)

    return on_call
