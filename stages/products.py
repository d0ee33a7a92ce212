"""The surface products by the names that people ask for them by, and the options that this means. Light to import."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from splatpipe.pipeline.engine.errors import UsageError

CELL_PIXELS = 2.0  # of the orthophoto along a cell of the surface model, where somebody says how large pixels are
NEEDS = {
    "dsm": ("depths",),
    "ortho": ("depths", "dsm"),
    "facades": ("depths", "dsm"),
    "cloud": ("depths", "dsm"),
    "mesh": ("depths", "dsm"),
}
"""Products, and the stages that each needs besides its own."""

NO_PRODUCTS: dict[str, Any] = {stage: {"enabled": False} for stage in ("depths", *NEEDS)}
PRODUCTS_FROM_BUDGET_S = 3600.0  # of a whole run: a shorter one is for the splat, and products are made afterwards


def parse_products(text: str) -> tuple[str, ...]:
    """Names of products, in the line's order, of a list like ``ortho, dsm``.

    Raises:
        UsageError: if there is none of that name, or none at all.
    """
    asked = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in asked if name not in NEEDS]
    if unknown or not asked:
        told = f'There is no product "{unknown[0][:40]}".' if unknown else "No product is named."
        raise UsageError(told, hint=f"Choose of: {', '.join(NEEDS)}.")
    return tuple(name for name in NEEDS if name in asked)


def options_for(products: Sequence[str], gsd_m: float | None) -> dict[str, Any]:
    """Options that ask for products, over those of a run: what it makes already, it goes on making.

    Args:
        products: Names.
        gsd_m: Side of a pixel on the ground; None for as before.
    """
    table: dict[str, Any] = {}
    for name in products:
        for stage in (*NEEDS[name], name):
            table[stage] = {"enabled": True}
    if gsd_m is not None:
        sizes = {
            "dsm": {"cell_m": CELL_PIXELS * gsd_m},
            "ortho": {"gsd_m": gsd_m},
            "facades": {"gsd_m": gsd_m},
            "cloud": {"spacing_m": gsd_m},
        }
        for name in set(sizes) & set(products):
            table[name] |= sizes[name]
    return table
