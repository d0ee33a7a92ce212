"""The size of a small viewer for web hosts, and its nodes."""

import json
from pathlib import Path

import numpy as np

COUNT, MAX_PER_NODE = 1200, 100

UP_FROM_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # the tiny scene's −y is up


def nodes_of(site: Path) -> list[dict]:
    nodes: list[dict] = json.loads((site / "web/levels.json").read_text())["nodes"]
    return nodes
