"""Unit tests start no process and train nothing: whoever needs that belongs into tests/parts."""

import sys
from collections.abc import Iterator

import pytest

STARTS = ("subprocess.Popen", "os.posix_spawn", "os.fork", "os.exec")
_guarded = [False]


def _refuse(event: str, arguments: tuple[object, ...]) -> None:
    if _guarded[0] and event in STARTS:
        raise AssertionError(f"a unit test starts a process ({event} {arguments[:2]}): move it to tests/parts")


sys.addaudithook(_refuse)  # for good: Python cannot remove one


@pytest.fixture(autouse=True)
def no_processes_and_no_training(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Refuse processes and the training loop."""
    loop = sys.modules.get("splatpipe.pipeline.train.loop")
    if loop is not None:
        monkeypatch.setattr(loop, "optimise", _refuse_training)
    _guarded[0] = True
    yield
    _guarded[0] = False


def _refuse_training(*_: object) -> None:
    raise AssertionError("a unit test trains: move it to tests/parts")
