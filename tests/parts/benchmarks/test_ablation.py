"""benchmarks/ablation, ended early."""

from pathlib import Path

import pytest
import tiny_scene
from commands import run_all, splatpipe
from timeouts import wait_until

TINY = "ingest.min_size=50"  # the line leaves out thumbnails


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_scene.write_dataset(tmp_path_factory.mktemp("scene") / "tiny")


def test_ending_early_leaves_no_process(dataset: Path, tmp_path: Path) -> None:
    long = ("--threads", "1", "--set", "train.iterations=1000000", "--set", TINY)
    commands = [
        splatpipe("long", ("run", str(dataset), str(tmp_path / "out"), *long), tmp_path / "long.log"),
        splatpipe("fails", ("run", str(tmp_path / "nowhere"), str(tmp_path / "no")), tmp_path / "fails.log"),
        splatpipe("never", ("run", str(dataset), str(tmp_path / "never"), *long), tmp_path / "never.log"),
    ]
    ends = run_all(commands, 2)
    ended = next(ends)
    assert ended.command.name == "fails" and "There is no folder" in ended.failure
    running = processes_with(str(tmp_path / "out"))
    wait_until(lambda: any(processes_with(pid) for pid in running), "a worker")  # which names its parent
    ends.close()
    assert not processes_with(str(tmp_path / "out")) and not (tmp_path / "never").exists()
    assert not any(processes_with(pid) for pid in running)


def processes_with(word: str) -> list[str]:
    """Ids of the processes that have a word in their command line."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if word.encode() in words:
            found.append(path.parent.name)
    return found
