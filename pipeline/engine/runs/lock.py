"""Locks an OUT: one splatpipe at a time works in it, whatever file system it is on.

On one machine the kernel's lock decides (``flock``): it ends with the last process that holds it, even a killed one.
Other machines see it only where the file system propagates it (NFS does, as a lock on the file's bytes, unless mounted
with ``nolock``; 9p and most FUSE file systems do not). So the holder also signs the file with its machine's boot ID and
touches it every few seconds: a signature from another boot counts as long as it is touched. No two machines' clocks
are compared.

Shards of a stage may be run side by side: a process that runs one shares the OUT's lock and holds a lock file of the
shard's own, signed and touched in the same way. Each side first signs its own file and then checks the other's, so that
at least one of the two notices.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from splatpipe.pipeline.engine.errors import MachineError, UsageError
from splatpipe.pipeline.engine.files.output_file import open_own
from splatpipe.pipeline.engine.files.small_file import open_regular, read_small
from splatpipe.pipeline.engine.machine import LOCAL_KINDS, mount_of

LOCK_FILE = ".lock"  # below stages/; it is never removed, and only its holder works
PATIENCE_S = 6.0  # a killed run's worker may take a moment to die
HEARTBEAT_S = 4.0  # between touches of the lock's file; rare enough not to burden a server
SILENCE_S = 20.0  # without a touch, a lock is abandoned: five missed ones cannot be explained by a busy disk
SETTLE_S = 1.0  # time for two machines that sign at once to see which was last
POLL_S = 0.25
MAX_SIGNATURE_BYTES = 4096  # bytes read of a signature
SIGNATURE_BYTES = 1024  # bytes to which signatures are padded: of two written over each other, the last is intact
NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EBADF}
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # identifies a machine's boot, in all of its containers alike

Notify = Callable[[str], None]


def _no_message(_text: str) -> None:
    """Discard a message."""


@dataclass(frozen=True)
class Holder:
    """The signer of a lock file.

    Attributes:
        process: The process ID on its machine.
        host: The machine's name.
        boot: The boot ID of its machine's kernel: within the same boot, ``flock`` is reliable.
        turn: A random token that identifies this hold.
    """

    process: int
    host: str
    boot: str
    turn: str

    @staticmethod
    def here() -> Holder:
        """A new holder for this process."""
        return Holder(os.getpid(), socket.gethostname(), _boot_id(), secrets.token_hex(8))

    @property
    def is_elsewhere(self) -> bool:
        return self.boot != _boot_id()

    def __str__(self) -> str:
        return f"process {self.process}" + (f" on {self.host}" if self.is_elsewhere else "")


class Hold:
    """A held lock; a thread touches its file until it is closed.

    Args:
        path: The lock file.
        descriptor: Its file descriptor.
        holder: Its signature.

    Attributes:
        descriptors: Of this lock and of the one it shares, for a worker to inherit: the lock lasts as long as either
            process lives.
    """

    def __init__(self, path: Path, descriptor: int, holder: Holder) -> None:
        self.descriptors = [descriptor]
        self._path, self._holder = path, holder
        self._taker = ""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="lock", daemon=True)
        self._thread.start()

    def confirm(self) -> None:
        """Check that the lock is still ours.

        Raises:
            MachineError: if another machine took it, which may happen if this one slept or lost its disk for a while.
        """
        if self._taker:
            raise MachineError(
                f"Another splatpipe ({self._taker}) has taken over {_place(self._path)}: this one gave no sign of "
                f"life for {SILENCE_S:.0f} s.",
                hint="Let that one finish. Finished work is kept.",
            )

    def close(self) -> None:
        """Remove the signature and release the lock."""
        self._over.set()
        self._thread.join(POLL_S)  # it may hang if a server does
        with suppress(OSError):  # a missing disk must not block the exit
            if not self._taker and _read_signature(self._path) == self._holder:
                os.ftruncate(self.descriptors[0], 0)
        for descriptor in self.descriptors:
            os.close(descriptor)

    def _beat(self) -> None:
        while not self._over.wait(HEARTBEAT_S):
            with suppress(OSError):
                found = _read_signature(self._path)
                if found != self._holder and (found is not None or self._path.stat().st_size == 0):
                    self._taker = str(found or "unknown")  # replacing a silent shard removes its signature
                    return
                os.utime(self.descriptors[0])


@contextmanager
def locked(out: Path, *, folder: str = "stages", wait: bool = False, notify: Notify = _no_message) -> Iterator[Hold]:
    """Lock an OUT for writing.

    Args:
        out: Its folder.
        folder: Our folder in it that contains the lock file.
        wait: Wait for another splatpipe that works in it.
        notify: Called with a message that names the process being waited for.

    Yields:
        The hold.

    Raises:
        UsageError: if another process works in it.
        MachineError: if its file system has no locks, or cannot be written.
    """
    path = out / folder / LOCK_FILE
    hold = _acquire(path, notify, wait=wait)
    try:
        for shard in sorted(path.parent.glob(f"{LOCK_FILE}.*")):
            if _read_signature(shard) is not None:  # left by a killed process, or held where our lock is not seen
                _acquire(shard, notify, wait=wait).close()
        yield hold
    finally:
        hold.close()


@contextmanager
def locked_shard(out: Path, shard: str, *, wait: bool = False, notify: Notify = _no_message) -> Iterator[Hold]:
    """Lock one shard of an OUT for writing, and share the OUT with other shards only.

    Args:
        out: Its folder.
        shard: By name, e.g. ``train.2``.
        wait: Wait for another process that runs the shard or has the OUT to itself.
        notify: Called with a message that names the process being waited for.

    Yields:
        The hold.

    Raises:
        UsageError: if another process runs it, or has the OUT to itself.
        MachineError: if its file system has no locks, or cannot be written.
    """
    path = out / "stages" / LOCK_FILE
    waiting = _Queue(path, notify, wait)
    with _lock_errors(out):
        shared = open_own(path, os.O_RDWR)
    try:
        while True:
            with _lock_errors(out):
                _wait_for(shared, waiting, fcntl.LOCK_SH)
                silent = _wait_for_silence(path, waiting)
            hold = _acquire(_shard_file(out, shard), notify, wait=wait)
            other = _read_signature(path)
            if other is None or other == silent or not other.is_elsewhere:
                break
            hold.close()  # a machine that does not see our lock signed meanwhile and may not have noticed us
            waiting.begin(other)
    except BaseException:
        os.close(shared)
        raise
    hold.descriptors.append(shared)
    try:
        yield hold
    finally:
        hold.close()


def _acquire(path: Path, notify: Notify, *, wait: bool) -> Hold:
    """Lock a file exclusively and sign it; raises what ``locked`` raises."""
    with _lock_errors(path.parents[1]):
        descriptor = open_own(path, os.O_RDWR)
        try:
            return Hold(path, descriptor, _lock_and_sign(path, descriptor, notify, wait=wait))
        except BaseException:
            os.close(descriptor)
            raise


@contextmanager
def _lock_errors(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise MachineError(
            f"Cannot lock {out}: {error.strerror}.",
            hint="Check its permissions and the free space, or choose another OUT.",
        ) from error


def is_locked(out: Path, shard: str = "") -> bool:
    """Whether a splatpipe currently has an OUT to itself, or runs one of its shards; checked without waiting.

    Args:
        out: Its folder.
        shard: By name; empty for the OUT itself.
    """
    path = _shard_file(out, shard) if shard else out / "stages" / LOCK_FILE
    try:
        file = open_regular(path)
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # brief: a run that starts now waits longer
        holder = _read_signature(path)
        touched_s = time.time() - os.fstat(file.fileno()).st_mtime
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        file.close()
    return holder is not None and holder.is_elsewhere and touched_s < SILENCE_S


def running_shards(out: Path) -> list[str]:
    """Names of an OUT's shards that separate processes are currently running; checked without waiting."""
    names = sorted(path.name.removeprefix(f"{LOCK_FILE}.") for path in (out / "stages").glob(f"{LOCK_FILE}.*"))
    return [name for name in names if is_locked(out, name)]


def _lock_and_sign(path: Path, descriptor: int, notify: Notify, *, wait: bool) -> Holder:
    """Lock the file against processes on this machine and others, sign it, and return the signature."""
    waiting = _Queue(path, notify, wait)
    _wait_for(descriptor, waiting, fcntl.LOCK_EX)
    _wait_for_silence(path, waiting)
    holder = Holder.here()
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"{json.dumps(asdict(holder))}\n".encode().ljust(SIGNATURE_BYTES), 0)
    os.fsync(descriptor)
    mount = mount_of(path)
    if mount is not None and mount.kind not in LOCAL_KINDS:
        time.sleep(SETTLE_S)
        if (other := _read_signature(path)) not in (None, holder):
            raise _refusal(path, other)
    return holder


@dataclass
class _Queue:
    """Notifies the user, once, of the process being waited for."""

    path: Path
    notify: Notify
    allowed: bool
    announced: bool = False

    def begin(self, other: Holder | None) -> None:
        """Announce the process being waited for.

        Raises:
            UsageError: if waiting is not allowed.
        """
        if not self.allowed:
            raise _refusal(self.path, other)
        if not self.announced:
            name = f"Another splatpipe ({other or 'unknown'})"
            self.notify(f"{name} is {_activity(self.path)}: waiting for it to finish.")
            self.announced = True


def _wait_for(descriptor: int, waiting: _Queue, kind: int) -> None:
    """Acquire the kernel's lock, ``LOCK_SH`` or ``LOCK_EX``; the holder reported may be that of a shard."""
    path = waiting.path
    deadline_s = time.monotonic() + PATIENCE_S
    while not _try_flock(descriptor, path.parents[1], kind):
        if time.monotonic() > deadline_s:
            shards = map(_read_signature, sorted(path.parent.glob(f"{path.name}.*")))
            waiting.begin(_read_signature(path) or next(filter(None, shards), None))
        time.sleep(POLL_S if waiting.allowed else POLL_S / 2)


def _wait_for_silence(path: Path, waiting: _Queue) -> Holder | None:
    """Wait until a signature from another boot is removed, or has not been touched for ``SILENCE_S``.

    Returns:
        The signer that has fallen silent; None if there is no signature.

    Raises:
        UsageError: if it is still being touched and waiting is not allowed.
    """
    other = _read_signature(path)
    if other is None or not other.is_elsewhere:
        return None  # a signer on this machine must have been killed: it would still hold the lock
    touched, silence_s = _mtime_ns(path), 0.0
    waiting.notify(f"Checking for up to {SILENCE_S:.0f} s whether {other} is still {_activity(path)}.")
    while silence_s < SILENCE_S:
        began_s = time.monotonic()
        time.sleep(POLL_S)
        now = _mtime_ns(path)
        # While a server does not answer, no touch arrives: a check that hangs counts as BEAT_S at most.
        silence_s += min(time.monotonic() - began_s, HEARTBEAT_S)
        if now != touched:
            if (signed := _read_signature(path)) is None:
                return None
            touched, silence_s, other = now, 0.0, signed
            waiting.begin(other)
    return other


def _refusal(path: Path, other: Holder | None) -> UsageError:
    hint = "Wait for it to finish (or use --wait), or choose another OUT."
    if other is not None and other.is_elsewhere:  # a server may keep a dead machine's lock: NFS 3 does until it is back
        hint += f" If {other.host} has crashed for good, remove {path}."
    return UsageError(f"Another splatpipe ({other or 'unknown'}) is {_activity(path)}.", hint=hint)


def _shard_file(out: Path, shard: str) -> Path:
    return out / "stages" / f"{LOCK_FILE}.{shard}"


def _place(path: Path) -> str:
    """What a lock file protects, for messages: an OUT, or one of its shards."""
    shard = path.name.removeprefix(LOCK_FILE).removeprefix(".")
    return f"{shard} in {path.parents[1]}" if shard else str(path.parents[1])


def _activity(path: Path) -> str:
    return f"{'working in' if path.name == LOCK_FILE else 'running'} {_place(path)}"


def _try_flock(descriptor: int, out: Path, kind: int) -> bool:
    """Try to acquire the kernel's lock, ``LOCK_SH`` or ``LOCK_EX``; False if another process holds it.

    Raises:
        MachineError: if the file system does not support locks.
    """
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        mount = mount_of(out)
        where = f"the file system there ({mount.kind} at {mount.point})" if mount else "the file system there"
        raise MachineError(
            f"Cannot lock {out}: {where} does not support locks ({error.strerror}), so two simultaneous runs would "
            "corrupt it.",
            hint="Choose an OUT on a local disk, or mount it with locks (NFS: version 4, or 3 with its lock service).",
        ) from error
    return True


def _read_signature(path: Path) -> Holder | None:
    """The signer of the file, or None. The file is reopened so that NFS queries the server."""
    with suppress(OSError, ValueError, TypeError, KeyError, RecursionError):
        read = json.loads(read_small(path, MAX_SIGNATURE_BYTES))
        return Holder(int(read["process"]), str(read["host"])[:255], str(read["boot"]), str(read["turn"]))
    return None


def _mtime_ns(path: Path) -> int:
    """The file's mtime, ns, by its file system's clock; 0 if unreadable. Reopened so that NFS queries the server."""
    with suppress(OSError), open_regular(path) as file:
        return os.fstat(file.fileno()).st_mtime_ns
    return 0


def _boot_id() -> str:
    with suppress(OSError):
        return BOOT_ID.read_text(encoding="ascii").strip()
    return socket.gethostname()
