"""Files are replaced completely or not at all, also by a killed process."""

import subprocess
import sys
from pathlib import Path

from splatpipe.pipeline.engine.files.durable import remove_unfinished, write_durably

KILLED = """
import os, signal
from pathlib import Path
from splatpipe.pipeline.engine.files.durable import write_durably

def half(file):
    file.write(b"half")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)

write_durably(Path({path!r}), half)
"""


def test_partial_files_of_a_killed_process_are_recognised_and_removed(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    write_durably(path, "old")
    subprocess.run([sys.executable, "-c", KILLED.format(path=str(path))], check=False)
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 2
    remove_unfinished(tmp_path, "other.json")
    assert len(list(tmp_path.iterdir())) == 2
    remove_unfinished(tmp_path)
    assert list(tmp_path.iterdir()) == [path]
