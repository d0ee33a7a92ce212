"""COLMAP's and Ceres' libraries in our processes: no log files in /tmp, no stack of C++ at SIGTERM."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import os, signal, threading, time
import splatpipe.pipeline
def stop(number, frame):
    raise KeyboardInterrupt
signal.signal(signal.SIGTERM, stop)
def load():
    import pycolmap, pyceres
    pycolmap.logging.info("said to the log")
    pycolmap.logging.logtostderr = False  # as its bundle adjustment does
    pycolmap.logging.error("an error")
{how}
try:
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(5)
except KeyboardInterrupt:
    print("stopped")
"""


@pytest.mark.parametrize("how", ["load()", "t = threading.Thread(target=load); t.start(); t.join()"])
def test_colmap_leaves_no_file_and_prints_no_stack(tmp_path: Path, how: str) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path), "TEST_TMPDIR": str(tmp_path)}
    environment.pop("GLOG_logtostderr", None)
    command = [sys.executable, "-P", "-c", PROGRAM.format(how=how)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "stopped\n")
    assert list(tmp_path.iterdir()) == []
    assert "said to the log" in done.stderr and "an error" in done.stderr
    assert "***" not in done.stderr and "@ " not in done.stderr
