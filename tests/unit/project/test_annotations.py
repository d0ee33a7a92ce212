"""The annotations of arrays are checked while the tests run: those of functions, methods and dataclasses."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from splatpipe.pipeline.geometry import alignment, similarity
from splatpipe.pipeline.geometry.similarity import Similarity


def test_an_array_of_another_shape_is_refused() -> None:
    placement = Similarity(1.0, np.eye(3), np.zeros(3))
    assert placement.apply(np.zeros((2, 3))).shape == (2, 3)
    with pytest.raises(TypeCheckError):
        placement.apply(np.zeros((2, 4)))


def test_a_dataclass_is_checked_when_it_is_made() -> None:
    with pytest.raises(TypeCheckError):
        Similarity(1.0, np.eye(2), np.zeros(3))


def test_modules_are_instrumented_once_and_keep_their_functions_names() -> None:
    for module in (alignment, similarity):
        functions = [each for each in vars(module).values() if getattr(each, "__module__", "") == module.__name__]
        assert functions and all(each.__name__ in vars(module) for each in functions if hasattr(each, "__name__"))
