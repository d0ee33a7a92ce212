"""Runs a module of ours so that it dies with the process that started it, even if that is killed.

    python -m splatpipe.pipeline.app.node.tasks.under_parent PARENT MODULE ARGUMENT...

The request to the kernel survives the change of the program, so that the module has no further process around it.
"""

from __future__ import annotations

import os
import sys

from splatpipe.pipeline.engine.python_module import python_module
from splatpipe.pipeline.engine.runs.children import die_with_parent

NICENESS = 5  # the node answers first

MODULE = "splatpipe.pipeline.app.node.tasks.under_parent"


def main() -> None:
    """Become the module named on the command line."""
    parent, module, *arguments = sys.argv[1:]
    die_with_parent(int(parent))
    os.nice(NICENESS)
    command = python_module(module, *arguments)
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
