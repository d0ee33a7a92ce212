"""One splatpipe at a time in an OUT: by the kernel's lock on one machine, by heartbeats across machines."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from splatpipe.pipeline.engine.errors import MachineError, UsageError
from splatpipe.pipeline.engine.machine import Mount
from splatpipe.pipeline.engine.runs import lock as engine_lock
from splatpipe.pipeline.engine.runs.lock import LOCK_FILE, is_locked, locked, locked_shard, running_shards

ELSEWHERE = {"process": 4711, "host": "node7", "boot": "another", "turn": "first"}


TIMEOUT_S = 60.0


@pytest.fixture
def out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An OUT's folder; silence expires a signature soon."""
    monkeypatch.setattr(engine_lock, "PATIENCE_S", 0.2)
    monkeypatch.setattr(engine_lock, "SILENCE_S", 1.5)
    monkeypatch.setattr(engine_lock, "HEARTBEAT_S", 0.1)
    monkeypatch.setattr(engine_lock, "POLL_S", 0.02)
    (tmp_path / "stages").mkdir()
    return tmp_path


@contextmanager
def at_work_elsewhere(out: Path, name: str = LOCK_FILE) -> Iterator[threading.Event]:
    """Another machine, whose lock this one does not see: it has signed the file and touches it."""
    path, over = out / "stages" / name, threading.Event()
    path.write_text(json.dumps(ELSEWHERE))

    def touch() -> None:
        while not over.wait(0.05):
            os.utime(path)

    thread = threading.Thread(target=touch)
    thread.start()
    yield over
    over.set()
    thread.join()


def test_the_holder_signs_the_lock_and_removes_the_signature(out: Path) -> None:
    path = out / "stages" / LOCK_FILE
    with locked(out):
        assert json.loads(path.read_text())["process"] == os.getpid()
        assert is_locked(out)
    assert path.read_text() == "" and not is_locked(out)


def test_another_machine_at_work_is_refused(out: Path) -> None:
    with at_work_elsewhere(out):
        assert is_locked(out)
        with pytest.raises(UsageError, match="process 4711 on node7"), locked(out):
            pass
    assert json.loads((out / "stages" / LOCK_FILE).read_text()) == ELSEWHERE


def test_of_two_overlapping_signatures_the_last_one_is_read(out: Path) -> None:
    """Two machines that lock nothing from each other cut the file before either writes; names are of any length."""
    path = out / "stages" / LOCK_FILE
    with locked(out):
        own = path.read_bytes()
    assert len(own) == engine_lock.SIGNATURE_BYTES
    longer = json.dumps({**ELSEWHERE, "host": "node7" * 20}).encode().ljust(engine_lock.SIGNATURE_BYTES)
    path.write_bytes(longer)
    with path.open("r+b") as file:
        file.write(own)
    assert is_locked(out) is False and engine_lock._read_signature(path) is not None


def test_the_lock_of_a_dead_machine_expires(out: Path) -> None:
    (out / "stages" / LOCK_FILE).write_text(json.dumps(ELSEWHERE))
    messages: list[str] = []
    began_s = time.monotonic()
    with locked(out, notify=messages.append):
        assert time.monotonic() - began_s >= engine_lock.SILENCE_S
    assert len(messages) == 1 and "process 4711 on node7" in messages[0]


def test_waiting_for_another_running_machine(out: Path) -> None:
    messages: list[str] = []
    with at_work_elsewhere(out) as over:

        def notify(text: str) -> None:
            messages.append(text)
            if "waiting" in text:
                over.set()

        with locked(out, wait=True, notify=notify):
            assert "waiting" in messages[-1]


def test_a_lock_released_elsewhere_is_taken_at_once(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_lock, "SILENCE_S", 10 * TIMEOUT_S)
    path = out / "stages" / LOCK_FILE
    path.write_text(json.dumps(ELSEWHERE))
    began_s = time.monotonic()
    with locked(out, notify=lambda _: path.write_text("")):
        assert time.monotonic() - began_s < TIMEOUT_S


def test_a_holder_that_was_suspended_too_long_loses_the_lock_and_leaves_the_new_signature(out: Path) -> None:
    path = out / "stages" / LOCK_FILE
    with locked(out) as hold:
        hold.confirm()
        path.write_text(json.dumps(ELSEWHERE))
        deadline_s = time.monotonic() + TIMEOUT_S
        with pytest.raises(MachineError, match=r"4711 on node7.* has taken over"):
            while time.monotonic() < deadline_s:
                hold.confirm()
                time.sleep(0.01)
    assert json.loads(path.read_text()) == ELSEWHERE


def test_a_file_system_without_locks_is_refused_with_the_reason(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(_descriptor: int, _how: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", none)
    monkeypatch.setattr(engine_lock, "mount_of", lambda path: Mount("/", "/mnt/nas", "nfs", ("rw", "nolock")))
    with (
        pytest.raises(
            MachineError,
            match=r"\(nfs at /mnt/nas\) does not support locks \(No locks available\)",
        ),
        locked(out),
    ):
        pass


def test_two_simultaneous_signers_do_not_both_get_the_lock(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = out / "stages" / LOCK_FILE
    monkeypatch.setattr(engine_lock, "mount_of", lambda path: Mount("/", "/mnt/c", "9p", ("rw",)))
    monkeypatch.setattr(time, "sleep", lambda seconds: path.write_text(json.dumps(ELSEWHERE)))
    with pytest.raises(UsageError, match="4711 on node7"), locked(out):
        pass


@pytest.mark.parametrize(
    "left", ["1234\n", "null", "[]", "{", '{"process": 1}', "[" * 4000, '{"process": [], "host": 1}', "\xff" * 9000]
)
def test_an_invalid_signature_blocks_nobody(out: Path, left: str) -> None:
    (out / "stages" / LOCK_FILE).write_text(left, encoding="latin-1")
    assert not is_locked(out)
    with locked(out, notify=pytest.fail):
        assert is_locked(out)


def test_a_link_in_place_of_the_lock_file_is_not_followed(out: Path, tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("mine")
    (out / "stages" / LOCK_FILE).symlink_to(tmp_path / "victim")
    with pytest.raises(UsageError, match=r"\.lock is a link"), locked(out):
        pass
    assert (tmp_path / "victim").read_text() == "mine"


def test_shards_are_held_concurrently_and_exclude_a_whole_run(out: Path) -> None:
    with locked_shard(out, "train.1"), locked_shard(out, "train.2"):
        assert is_locked(out, "train.1") and not is_locked(out, "train.3") and not is_locked(out)
        assert running_shards(out) == ["train.1", "train.2"]
        with (
            pytest.raises(UsageError, match=f"process {os.getpid()}\\) is running train.1 in"),
            locked_shard(out, "train.1"),
        ):
            pass
        with pytest.raises(UsageError, match=f"process {os.getpid()}\\) is working in"), locked(out):
            pass
    with locked(out), pytest.raises(UsageError, match="is working in"), locked_shard(out, "train.1"):
        pass
    assert all(path.read_bytes() == b"" for path in (out / "stages").glob(f"{LOCK_FILE}*"))
    assert running_shards(out) == []


def test_a_shard_on_another_machine_excludes_the_same_shard_and_a_whole_run(out: Path) -> None:
    """On a file system where that machine's locks are invisible."""
    name = f"{LOCK_FILE}.train.1"
    with at_work_elsewhere(out, name) as over:
        with pytest.raises(UsageError, match=r"node7.* is running train.1"), locked_shard(out, "train.1"):
            pass
        with locked_shard(out, "train.2"):
            pass
        with pytest.raises(UsageError, match=r"node7.* is running train.1"), locked(out):
            pass
        assert not is_locked(out)

        def notify(text: str) -> None:
            if "waiting" in text:
                over.set()

        with locked(out, wait=True, notify=notify):
            assert over.is_set() and (out / "stages" / name).read_bytes() == b""  # a dead process blocks nobody else


def test_no_shard_is_made_while_another_machine_holds_the_whole_out(out: Path) -> None:
    with at_work_elsewhere(out) as over:
        with pytest.raises(UsageError, match=r"node7.* is working in"), locked_shard(out, "train.1"):
            pass
        with locked_shard(out, "train.1", wait=True, notify=lambda text: over.set() if "waiting" in text else None):
            assert over.is_set()


def test_a_shard_yields_to_a_run_elsewhere_that_signs_simultaneously(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run signs after its file was checked and before the shard's own signature is visible there."""
    take = engine_lock._lock_and_sign

    def overtaken(path: Path, *how: object, **more: bool) -> object:
        signed = take(path, *how, **more)  # type: ignore[arg-type]
        (out / "stages" / LOCK_FILE).write_text(json.dumps(ELSEWHERE))
        return signed

    monkeypatch.setattr(engine_lock, "_lock_and_sign", overtaken)
    with pytest.raises(UsageError, match=r"node7.* is working in"), locked_shard(out, "train.1"):
        pass
    assert (out / "stages" / f"{LOCK_FILE}.train.1").read_bytes() == b""
    with locked_shard(out, "train.1"):  # its owner has been silent for long: it died
        pass


def test_a_suspended_shard_process_finds_its_signature_removed(out: Path) -> None:
    with locked_shard(out, "train.1") as hold:
        (out / "stages" / f"{LOCK_FILE}.train.1").write_bytes(b"")
        deadline_s = time.monotonic() + TIMEOUT_S
        with pytest.raises(MachineError, match=r"has taken over train.1 in"):
            while time.monotonic() < deadline_s:
                hold.confirm()
                time.sleep(0.01)
