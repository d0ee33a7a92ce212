"""Who works in an OUT: one splatpipe at a time, whatever file system it is on.

On one machine the kernel's lock decides (``flock``): it ends with the last process that holds it, however that dies.
Other machines see it only where the file system carries it (NFS does, by a lock on the file's bytes; not with
``nolock``, nor 9p, nor most of FUSE). So who holds it also signs the file with the machine's boot and touches it every
few seconds: what another boot has signed is believed as long as it is touched. No two clocks are compared.
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
from splatpipe.pipeline.engine.machine import LOCAL_KINDS, mount_of

LOCK_FILE = ".lock"  # below stages/; it stays there, and only who holds it works
PATIENCE_S = 6.0  # a killed run's worker may take a moment to die
BEAT_S = 4.0  # between touches; a server is not troubled by one in that time
SILENCE_S = 20.0  # without a touch: five missed ones are no busy disk any more
SETTLE_S = 1.0  # in which two machines that sign at once see who was last
LOOK_S = 0.25
LONGEST = 4096  # bytes of a signature
WIDTH = 1024  # of all, so that of two written over each other the last one stands whole
NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EBADF}
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # the same in all containers of a machine

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Holder:
    """Who signed the file.

    Attributes:
        process: Its number, on its machine.
        host: The machine's name.
        boot: What its machine's kernel calls this boot: with the same one, ``flock`` tells the truth.
        turn: Of this hold alone.
    """

    process: int
    host: str
    boot: str
    turn: str

    @staticmethod
    def here() -> Holder:
        """This process, about to hold."""
        return Holder(os.getpid(), socket.gethostname(), _boot(), secrets.token_hex(8))

    @property
    def is_elsewhere(self) -> bool:
        return self.boot != _boot()

    def __str__(self) -> str:
        return f"process {self.process}" + (f" on {self.host}" if self.is_elsewhere else "")


class Hold:
    """The lock, held; touched from a thread of its own until it is closed.

    Args:
        path: The file.
        descriptor: Of it, for a worker to inherit: the lock lasts as long as either lives.
        holder: As it is signed.
    """

    def __init__(self, path: Path, descriptor: int, holder: Holder) -> None:
        self.descriptor = descriptor
        self._path, self._holder = path, holder
        self._taker: Holder | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="lock", daemon=True)
        self._thread.start()

    def confirm(self) -> None:
        """Make sure that it is still ours.

        Raises:
            MachineError: if another machine took it, as it may where this one slept or lost its disk for a while.
        """
        if self._taker is not None:
            raise MachineError(
                f"Another splatpipe ({self._taker}) has taken over {self._path.parents[1]}: this one gave no sign of "
                f"life for {SILENCE_S:.0f} s.",
                hint="Let that one end. What was finished is kept.",
            )

    def close(self) -> None:
        """Take the signature back and let the lock go."""
        self._over.set()
        self._thread.join(LOOK_S)  # it may hang with a server
        with suppress(OSError):  # a disk that is gone holds nobody up
            if self._taker is None and _signed(self._path) == self._holder:
                os.ftruncate(self.descriptor, 0)
        os.close(self.descriptor)

    def _beat(self) -> None:
        while not self._over.wait(BEAT_S):
            with suppress(OSError):
                found = _signed(self._path)
                if found is not None and found != self._holder:
                    self._taker = found
                    return
                os.utime(self.descriptor)


@contextmanager
def locked(out: Path, *, folder: str = "stages", wait: bool = False, tell: Tell = lambda _text: None) -> Iterator[Hold]:
    """Hold an OUT for writing.

    Args:
        out: Its folder.
        folder: Of ours in it, which keeps the file.
        wait: Wait for another that works in it.
        tell: Is told whom for.

    Raises:
        UsageError: if another process works in it.
        MachineError: if its file system has no locks, or cannot be written.
    """
    path = out / folder / LOCK_FILE
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            holder = _take(path, descriptor, tell, wait=wait)
        except BaseException:
            os.close(descriptor)
            raise
    except OSError as error:
        raise MachineError(
            f"Cannot lock {out}: {error.strerror}.",
            hint="Check its permissions and the free space, or choose another OUT.",
        ) from error
    hold = Hold(path, descriptor, holder)
    try:
        yield hold
    finally:
        hold.close()


def is_locked(out: Path) -> bool:
    """Whether a splatpipe works in an OUT now, as far as a look tells."""
    path = out / "stages" / LOCK_FILE
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # a run that begins now waits for longer
        holder = _signed(path)
        touched_s = time.time() - os.fstat(descriptor).st_mtime
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return holder is not None and holder.is_elsewhere and touched_s < SILENCE_S


def _take(path: Path, descriptor: int, tell: Tell, *, wait: bool) -> Holder:
    """Lock the file against this machine and others, and sign it."""
    out = path.parents[1]
    waiting = _Waiting(path, tell, wait)
    deadline_s = time.monotonic() + PATIENCE_S
    while not _flocked(descriptor, out):
        if time.monotonic() > deadline_s:
            waiting.begin(_signed(path))
        time.sleep(LOOK_S if wait else LOOK_S / 2)
    _outlast(path, waiting)
    holder = Holder.here()
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"{json.dumps(asdict(holder))}\n".encode().ljust(WIDTH), 0)
    os.fsync(descriptor)
    mount = mount_of(out)
    if mount is not None and mount.kind not in LOCAL_KINDS:
        time.sleep(SETTLE_S)
        if (other := _signed(path)) not in (None, holder):
            raise _refusal(path, other)
    return holder


@dataclass
class _Waiting:
    """What is said to the user of another who works there, once."""

    path: Path
    tell: Tell
    allowed: bool
    told: bool = False

    def begin(self, other: Holder | None) -> None:
        """Say whom for.

        Raises:
            UsageError: if nobody wants to wait.
        """
        if not self.allowed:
            raise _refusal(self.path, other)
        if not self.told:
            self.tell(
                f"Another splatpipe ({other or 'unknown'}) is working in {self.path.parents[1]}: waiting for it to end."
            )
            self.told = True


def _outlast(path: Path, waiting: _Waiting) -> None:
    """Wait until what another boot has signed is taken back, or has not been touched for too long.

    Raises:
        UsageError: if it is touched, and nobody wants to wait for it.
    """
    other = _signed(path)
    if other is None or not other.is_elsewhere:
        return  # this machine's own was killed: it would still hold the lock
    touched, silence_s = _touched(path), 0.0
    waiting.tell(f"Looking for up to {SILENCE_S:.0f} s whether {other} still works in {path.parents[1]}.")
    while silence_s < SILENCE_S:
        began_s = time.monotonic()
        time.sleep(LOOK_S)
        now = _touched(path)
        # While a server does not answer, nobody's touch arrives: a look that hangs counts as BEAT_S at most.
        silence_s += min(time.monotonic() - began_s, BEAT_S)
        if now != touched:
            if _signed(path) is None:
                return
            touched, silence_s = now, 0.0
            waiting.begin(other)


def _refusal(path: Path, other: Holder | None) -> UsageError:
    hint = "Wait for it to end (--wait does that), or choose another OUT."
    if other is not None and other.is_elsewhere:  # a server may keep a dead machine's lock: NFS 3 until that is back
        hint += f" If {other.host} has crashed for good, remove {path}."
    return UsageError(f"Another splatpipe ({other or 'unknown'}) is working in {path.parents[1]}.", hint=hint)


def _flocked(descriptor: int, out: Path) -> bool:
    """Try the kernel's lock.

    Raises:
        MachineError: if the file system has none.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        mount = mount_of(out)
        where = f"the file system there ({mount.kind} at {mount.point})" if mount else "the file system there"
        raise MachineError(
            f"Cannot lock {out}: {where} has no locks ({error.strerror}), so two runs at once would spoil it.",
            hint="Choose an OUT on a local disk, or mount it with locks (NFS: version 4, or 3 with its lock service).",
        ) from error
    return True


def _signed(path: Path) -> Holder | None:
    """Who signed the file; None if nobody did. Opened anew, so that NFS asks the server."""
    with suppress(OSError, ValueError, TypeError, KeyError, RecursionError):
        with path.open("rb") as file:
            told = json.loads(file.read(LONGEST))
        return Holder(int(told["process"]), str(told["host"])[:255], str(told["boot"]), str(told["turn"]))
    return None


def _touched(path: Path) -> int:
    """When the file was touched by its own file system's clock; opened anew, so that NFS asks the server."""
    with suppress(OSError), path.open("rb") as file:
        return os.fstat(file.fileno()).st_mtime_ns
    return 0


def _boot() -> str:
    with suppress(OSError):
        return BOOT_ID.read_text(encoding="ascii").strip()
    return socket.gethostname()
