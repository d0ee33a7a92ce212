"""The surface products by the names that people ask for them by, and the options that this means. Light to import."""

from __future__ import annotations

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

SOURCES = {"photos": (True, False), "splat": (False, True), "both": (True, True)}
"""Whether depths are found in photos, and whether they are rendered from the splat."""
USUAL = "ortho,dsm"

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
        told = f'There is no product "{unknown[0][:40]}".' if unknown else "No product is given."
        raise UsageError(told, hint=f"Choose from: {', '.join(NEEDS)}.")
    return tuple(name for name in NEEDS if name in asked)


def options_for(products: str | None, gsd_m: float | None, source: str | None) -> dict[str, Any]:
    """Options that ask for products, over those of a run: what it makes already, it goes on making.

    Args:
        products: Their names, separated by commas; None for the usual ones.
        gsd_m: Side of a pixel on the ground; None for as before.
        source: Whose depths they are made from; None for the photos', and for the splat's, too, where a run has them.

    Raises:
        UsageError: if there is no such product or source.
    """
    if source is not None and source not in SOURCES:
        raise UsageError(f'There is no source "{source[:40]}".', hint=f"Choose {', '.join(SOURCES)}.")
    asked = parse_products(USUAL if products is None else products)
    table: dict[str, Any] = {stage: {"enabled": True} for name in asked for stage in (*NEEDS[name], name)}
    if source is not None:
        for stage, enabled in zip(("depths", "splat_depths"), SOURCES[source], strict=True):
            table[stage] = {"enabled": enabled}
    sizes = {
        "dsm": {"cell_m": CELL_PIXELS * (gsd_m or 0.0)},
        "ortho": {"gsd_m": gsd_m},
        "facades": {"gsd_m": gsd_m},
        "cloud": {"spacing_m": gsd_m},
    }
    for name in set(sizes) & set(asked) if gsd_m is not None else ():
        table[name] |= sizes[name]
    return table
