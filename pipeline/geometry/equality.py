"""Equality of dataclasses that hold arrays, by value; the one that dataclasses make raises for arrays."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np


def equal_fields(one: Any, other: Any) -> bool:
    """Whether two dataclasses are of one type and all their fields are equal, arrays element by element."""
    return type(one) is type(other) and all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name)) for field in fields(one)
    )
