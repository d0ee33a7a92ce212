"""The annotations of arrays are checked while the tests run."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from splatpipe.pipeline.geometry.similarity import Similarity


def test_an_array_of_another_shape_is_refused() -> None:
    placement = Similarity(1.0, np.eye(3), np.zeros(3))
    assert placement.apply(np.zeros((2, 3))).shape == (2, 3)
    with pytest.raises(TypeCheckError):
        placement.apply(np.zeros((2, 4)))
