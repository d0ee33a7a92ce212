"""`splatpipe render`, and what it answers."""

import json
import subprocess
from pathlib import Path

from command import splatpipe

SECONDS = 2.0  # length of the shared run's film


def render(out: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Render images or a film of a run."""
    return splatpipe("render", out, *arguments, "--json")


def rendered(out: Path, *arguments: object) -> dict[str, object]:
    """Render, successfully; return the summary."""
    done = render(out, *arguments)
    assert done.returncode == 0, done.stderr
    summary: dict[str, object] = json.loads(done.stdout)["render"]
    return summary
