"""The memory and processors this process may use, within the limits of its control groups.

A container, a Slurm job or a systemd unit sees the whole machine in ``/proc/meminfo`` and ``os.cpu_count``, but is
killed or slowed down at its own limits. These are set in the files of its control groups, version 1 or 2, and of all
their ancestors (https://docs.kernel.org/admin-guide/cgroup-v2.html, cgroup-v1/memory.html, scheduler/sched-bwc.html).
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

MAX_CHARACTERS = 1 << 20  # read of a kernel file: a machine with thousands of mounts needs less
UNLIMITED_BYTES = 1 << 60  # more than any machine has: cgroup version 1 expresses "no limit" by a number this large
# File systems that belong to one machine, so that its own locks suffice.
LOCAL_DISKS = ("ext2", "ext3", "ext4", "xfs", "btrfs", "zfs", "f2fs", "bcachefs", "jfs", "ntfs3", "vfat", "exfat")
LOCAL_KINDS = frozenset((*LOCAL_DISKS, "overlay", "tmpfs", "ramfs"))
PSEUDO_KINDS = frozenset(
    {"autofs", "binfmt_misc", "bpf", "cgroup", "cgroup2", "configfs", "debugfs", "devpts", "devtmpfs", "efivarfs"}
    | {"fusectl", "mqueue", "nsfs", "proc", "pstore", "rpc_pipefs", "securityfs", "selinuxfs", "sysfs", "tracefs"}
)
_OCTAL = re.compile(r"\\([0-7]{3})")  # how the kernel escapes spaces in mount points


@dataclass(frozen=True)
class Mount:
    """A line of ``/proc/self/mountinfo``.

    Attributes:
        root: The folder within the mounted file system that appears at ``point``.
        point: The mount point.
        kind: The file system type, e.g. ``ext4``.
        options: Options of the mount, then of the file system.
        device: ``st_dev`` of its files; 0 if unknown.
    """

    root: str
    point: str
    kind: str
    options: tuple[str, ...]
    device: int = 0


def mounts(root: Path = Path("/")) -> list[Mount]:
    """The mounts in the order they were mounted; empty if the system does not list them."""
    return parse_mounts(_text(root / "proc/self/mountinfo"))


def parse_mounts(text: str) -> list[Mount]:
    """Parse text in the format of ``/proc/self/mountinfo``; malformed lines are skipped."""
    found = []
    for line in text.splitlines():
        before, _, after = line.partition(" - ")
        left, right = before.split(" "), after.split(" ")
        if len(left) >= 6 and len(right) >= 2:
            options = (*left[5].split(","), *(right[2].split(",") if len(right) > 2 else ()))
            found.append(Mount(_plain(left[3]), _plain(left[4]), right[0], options, _device(left[2])))
    return found


def _device(text: str) -> int:
    """The number of a device such as ``0:22``; 0 if it is none."""
    major, _, minor = text.partition(":")
    return os.makedev(int(major), int(minor)) if major.isdecimal() and minor.isdecimal() else 0


def pseudo_devices() -> frozenset[int]:
    """``st_dev`` of files that the kernel makes up while they are read: some never end, and some wait for ever.

    They claim to be regular files, e.g. ``/proc/kmsg``.
    """
    return frozenset(mount.device for mount in mounts() if mount.kind in PSEUDO_KINDS)


def mount_of(path: Path, among: Sequence[Mount] | None = None) -> Mount | None:
    """The mount that contains a path, which need not exist yet; None if unknown.

    Args:
        path: Any path.
        among: The mounts in order; by default those of this system now.
    """
    place = PurePosixPath(path.resolve())
    found = None
    for mount in mounts() if among is None else among:
        if place.is_relative_to(mount.point) and (found is None or len(mount.point) >= len(found.point)):
            found = mount  # the later of two mounts at one point hides the other
    return found


def available_cores(root: Path = Path("/")) -> int:
    """Number of processors this process may use, limited by its CPU affinity and the CPU quotas of its groups.

    Args:
        root: The folder that contains ``proc`` and ``sys``.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    shares = [share for folder in _groups(root, "cpu") if (share := _processors(folder)) is not None]
    return max(1, min([cores, *(math.ceil(share) for share in shares)]))


def available_memory_bytes(root: Path = Path("/")) -> int:
    """Most memory, bytes, that this process and the others in its groups may use together; 0 if unknown.

    Args:
        root: The folder that contains ``proc`` and ``sys``.
    """
    limits = [limit for folder in _groups(root, "memory") if (limit := _memory_limit(folder)) is not None]
    return min([amount for amount in (_machine_memory(root, "MemTotal"), *limits) if amount], default=0)


def free_memory_bytes(root: Path = Path("/")) -> int:
    """How much more memory, bytes, this process may use now without swapping or being killed; 0 if unknown.

    Args:
        root: The folder that contains ``proc`` and ``sys``.
    """
    machine = _machine_memory(root, "MemAvailable")
    free = [machine] if machine else []
    for folder in _groups(root, "memory"):
        limit, used = _memory_limit(folder), _memory_used(folder)
        if limit is not None and used is not None:
            free.append(max(0, limit - used))
    return min(free, default=0)


def threads_within(threads: int, each_bytes: int, limit_bytes: int = 0, root: Path = Path("/")) -> int:
    """Number of threads, at least 1, whose memory together fits the free memory and the user's limit.

    Args:
        threads: The most.
        each_bytes: Memory that each of them takes.
        limit_bytes: The user's limit on the resident memory of this process; 0 for none.
        root: The folder that contains ``proc`` and ``sys``.
    """
    rooms = [free_memory_bytes(root)] if free_memory_bytes(root) else []
    rooms += [limit_bytes - resident_bytes(root)] if limit_bytes else []
    return max(1, min([threads, *(room // each_bytes for room in rooms)]))


def memory_limit_bytes(limit_bytes: int = 0, root: Path = Path("/")) -> int:
    """The user's limit, or that of the machine or its control groups if it is smaller; 0 if none is known.

    Args:
        limit_bytes: The user's limit; 0 for none.
        root: The folder that contains ``proc`` and ``sys``.
    """
    return min((limit for limit in (limit_bytes, available_memory_bytes(root)) if limit), default=0)


def resident_bytes(root: Path = Path("/")) -> int:
    """Resident memory of this process, bytes; 0 if the system does not report it.

    Args:
        root: The folder that contains ``proc``.
    """
    return (_field(_text(root / "proc/self/status"), "VmRSS:") or 0) << 10


def _groups(root: Path, controller: str) -> Iterator[Path]:
    """Yield the folders of this process's control groups for a controller and their ancestors, innermost first."""
    own = _own_groups(_text(root / "proc/self/cgroup"))
    for mount in mounts(root):
        if mount.kind == "cgroup2":
            path = own.get("", "")
        elif mount.kind == "cgroup" and controller in mount.options:
            path = own.get(controller, "")
        else:
            continue
        top = root / mount.point.lstrip("/")
        folder = top / _below(path, mount.root)
        yield folder
        while folder != top:
            folder = folder.parent
            yield folder


def _own_groups(text: str) -> dict[str, str]:
    """Paths of the process's groups by controller, from ``/proc/self/cgroup``; version 2 has the empty name."""
    found: dict[str, str] = {}
    for line in text.splitlines():
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        found |= dict.fromkeys(controllers.split(","), path)
    return found


def _below(path: str, root: str) -> str:
    """A group's path relative to the mounted root; empty (the top) if it lies outside, as in a container."""
    inner = PurePosixPath(path)
    if ".." in inner.parts or not inner.is_relative_to(root):
        return ""
    return inner.relative_to(root).as_posix()


def _processors(folder: Path) -> float | None:
    """The CPU quota of a group in processors; None without a limit."""
    quota, _, period = _text(folder / "cpu.max").strip().partition(" ")
    if not quota:
        quota, period = _text(folder / "cpu.cfs_quota_us"), _text(folder / "cpu.cfs_period_us")
    share, per = _number(quota), _number(period)
    return share / per if share and per else None


def _memory_limit(folder: Path) -> int | None:
    """Bytes at which a group's processes are slowed down or killed; None without a limit."""
    names = ("memory.max", "memory.high", "memory.limit_in_bytes")
    limits = [limit for name in names if (limit := _number(_text(folder / name)))]
    return min((limit for limit in limits if limit < UNLIMITED_BYTES), default=None)


def _memory_used(folder: Path) -> int | None:
    """Bytes a group uses, excluding the inactive file cache, which is reclaimed first; None if unknown."""
    for usage, cache in (("memory.current", "inactive_file"), ("memory.usage_in_bytes", "total_inactive_file")):
        used = _number(_text(folder / usage))
        if used is not None:
            return max(0, used - (_field(_text(folder / "memory.stat"), cache) or 0))
    return None


def _machine_memory(root: Path, name: str) -> int:
    """A value of ``/proc/meminfo`` in bytes; 0 if unknown."""
    size_kib = _field(_text(root / "proc/meminfo"), f"{name}:")
    if size_kib is not None:
        return size_kib << 10
    if name == "MemTotal" and "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        return int(os.sysconf("SC_PHYS_PAGES")) * int(os.sysconf("SC_PAGE_SIZE"))
    return 0


def _field(text: str, name: str) -> int | None:
    """The number after the name that begins a line; None if there is none."""
    words = next((words for line in text.splitlines() if (words := line.split())[:1] == [name]), [])
    return _number(words[1]) if len(words) > 1 else None


def _number(text: str) -> int | None:
    """A count as the kernel writes it; None for ``max``, ``-1`` and anything else that is not a count."""
    digits = text.strip()
    return int(digits) if digits.isascii() and digits.isdigit() and len(digits) <= 20 else None


def _plain(name: str) -> str:
    return _OCTAL.sub(lambda code: chr(int(code[1], 8)), name)


def _text(path: Path) -> str:
    """The beginning of a file; empty if it cannot be read."""
    with suppress(OSError), path.open(encoding="utf-8", errors="surrogateescape") as file:
        return file.read(MAX_CHARACTERS)
    return ""
