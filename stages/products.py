"""The surface products by the names users give, and the options that each name sets. Light to import."""

from __future__ import annotations

from typing import Any

from splatpipe.pipeline.engine.errors import UsageError

CELL_PIXELS = 2.0  # orthophoto pixels per DSM cell side if the user sets the pixel size
NEEDS = {
    "dsm": ("depths",),
    "dtm": ("depths", "dsm"),
    "ortho": ("depths", "dsm"),
    "facades": ("depths", "dsm"),
    "cloud": ("depths", "dsm", "dtm"),
    "mesh": ("depths", "dsm"),
}
"""Products, and the stages that each needs in addition to its own."""

SOURCES = {"photos": (True, False), "splat": (False, True), "both": (True, True)}
"""Whether depths are computed from the photos, and whether they are rendered from the splat."""
USUAL = "ortho,dsm,dtm"

NO_PRODUCTS: dict[str, Any] = {stage: {"enabled": False} for stage in ("depths", *NEEDS)}
# Least time for a whole run with products; a shorter one is spent on the splat, and they can be made later.
PRODUCTS_FROM_BUDGET_S = 3600.0


def parse_products(text: str) -> tuple[str, ...]:
    """Return the product names in a list like ``ortho, dsm``, in the order of the stages.

    Raises:
        UsageError: if a name is unknown, or the list is empty.
    """
    asked = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in asked if name not in NEEDS]
    if unknown or not asked:
        message = f'There is no product "{unknown[0][:40]}".' if unknown else "No product is given."
        raise UsageError(message, hint=f"Choose from: {', '.join(NEEDS)}.")
    return tuple(name for name in NEEDS if name in asked)


def options_for(products: str | None, gsd_m: float | None, source: str | None) -> dict[str, Any]:
    """Return options that enable products, to be laid over a run's; products already enabled stay enabled.

    Args:
        products: Their names, separated by commas; None for the usual ones.
        gsd_m: Ground size of a pixel, metres; None to leave it unchanged.
        source: Source of the depths; None for the photos, and also the splat if the run already uses it.

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
