"""Which instruction set the native kernels run on."""

from __future__ import annotations

import os
from collections.abc import Sequence

from splatpipe.pipeline.engine.errors import MachineError, UsageError
from splatpipe.pipeline.native import _native

__all__ = ["_native", "choose_isa", "isa_name", "isa_names", "use_isa_of_environment"]

VARIABLE = "SPLATPIPE_ISA"
INSTRUCTION_SETS = ("avx512", "avx2", "baseline")
"""All instruction sets that kernels are compiled for on some machine, best first."""


def choose_isa(wanted: str, available: Sequence[str]) -> str:
    """The instruction set requested by SPLATPIPE_ISA.

    Args:
        wanted: An instruction set; ``auto`` or empty for the best.
        available: Those that this machine supports, best first.

    Raises:
        UsageError: if there is no such instruction set.
        MachineError: if this machine lacks it.
    """
    if wanted in ("", "auto"):
        return available[0]
    if wanted not in INSTRUCTION_SETS:
        raise UsageError(
            f'{VARIABLE} asks for "{wanted}", which is not a supported instruction set.',
            hint=f"Choose auto, {', '.join(INSTRUCTION_SETS[:-1])} or {INSTRUCTION_SETS[-1]}.",
        )
    if wanted not in available:
        raise MachineError(
            f"{VARIABLE} asks for {wanted}, which this CPU does not have.",
            hint=f"Leave it unset for the best, or choose from {', '.join(available)}.",
        )
    return wanted


def use_isa_of_environment() -> None:
    """Run the native kernels on the instruction set of SPLATPIPE_ISA; errors as in ``choose_isa``."""
    _native.set_isa(choose_isa(os.environ.get(VARIABLE, ""), _native.isas()))


def isa_name() -> str:
    """The instruction set in use: this CPU's best, or the one requested by SPLATPIPE_ISA."""
    return _native.isa()


def isa_names() -> list[str]:
    """Instruction sets that this CPU supports, best first."""
    return _native.isas()


use_isa_of_environment()
