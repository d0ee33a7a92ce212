"""Warnings before a run about properties of a folder and its machine that make runs slow, unsafe or impossible.

They come from the kernel's files alone: which file systems propagate locks to other machines is documented and cannot
be tested here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from splatpipe.pipeline.engine.machine import Mount, available_memory_bytes, mount_of, mounts
from splatpipe.pipeline.engine.stage import JSON

WINDOWS_KINDS = ("9p", "drvfs", "v9fs")  # Windows drives in WSL; 9p also for folders shared with other virtual machines
LOCAL_ONLY = ("nolock", "local_lock=all", "local_lock=flock", "nobrl", "localflock")  # options of NFS, SMB, Lustre
# Folders shared by a virtual machine or container engine on Windows or macOS, and servers mounted through FUSE.
PASSED_ON = ("virtiofs", "vboxsf", "vmhgfs", "prl_fs", "fakeowner", "osxfs", "grpcfuse", "fuse", "fuseblk")
FUSE_WITH_LOCKS = ("fuse.glusterfs", "fuse.ceph", "fuse.juicefs")  # pass locks on to their servers
IN_MEMORY = ("tmpfs", "ramfs")
SMALL_WSL_BYTES = 12e9  # less than larger captures need: worth a line in .wslconfig
WSL = "microsoft"  # in the kernel's release string, case-insensitive


@dataclass(frozen=True)
class MachineWarning:
    """A warning in one sentence, and what to do about it."""

    message: str
    hint: str

    def as_json(self) -> dict[str, JSON]:
        return asdict(self)


def machine_warnings(place: Path, root: Path = Path("/")) -> list[MachineWarning]:
    """All warnings for a run that writes to a folder.

    Args:
        place: An OUT, which need not exist yet.
        root: The folder that contains ``proc`` and ``sys``.
    """
    release = root / "proc/sys/kernel/osrelease"
    kernel = release.read_text(encoding="utf-8", errors="replace") if release.is_file() else ""
    mount = mount_of(place, mounts(root))
    in_wsl = WSL in kernel.casefold()
    found = [] if mount is None else _mount_warnings(place, mount, in_wsl=in_wsl)
    return [*found, *_wsl_warnings(kernel, available_memory_bytes(root))]


def _mount_warnings(place: Path, mount: Mount, *, in_wsl: bool) -> Sequence[MachineWarning]:
    found = []
    where = f"{place} is on {mount.kind} (mounted at {mount.point})"
    if "ro" in mount.options:
        found.append(MachineWarning(f"{where}, which is read-only.", "Choose another OUT."))
    if mount.kind in WINDOWS_KINDS or (in_wsl and "drvfs" in mount.options):
        found.append(
            MachineWarning(
                f"{where}: file access goes through another system and is many times slower, and locks apply to "
                "this one only.",
                "Choose an OUT in the Linux file system, such as ~/out, and copy the results from there; photos may "
                "stay where they are.",
            )
        )
    elif option := _unshared_locks(mount):
        found.append(
            MachineWarning(
                f"{where}{option}: its locks apply to this machine only; another machine working in the same OUT "
                "is detected by its heartbeat, within half a minute.",
                "Use an OUT from one machine at a time, or mount it with locks (NFS 4, or 3 with its lock service).",
            )
        )
    elif mount.kind in IN_MEMORY:
        found.append(
            MachineWarning(f"{where}: its files take up memory and are lost at shutdown.", "Choose an OUT on a disk.")
        )
    return found


def _unshared_locks(mount: Mount) -> str:
    """Why other machines do not see the mount's locks, to follow its name; empty if they do or have no access."""
    options = [option for option in mount.options if option in LOCAL_ONLY]
    if options:
        return f" with {', '.join(dict.fromkeys(options))}"
    passed_on = mount.kind in PASSED_ON or mount.kind.startswith("fuse.")
    return ", passed through from another system" if passed_on and mount.kind not in FUSE_WITH_LOCKS else ""


def _wsl_warnings(kernel: str, memory_bytes: int) -> Sequence[MachineWarning]:
    if WSL not in kernel.casefold():
        return []
    if "wsl2" not in kernel.casefold():
        return [MachineWarning("This is WSL 1, which is untested.", "Convert it: wsl --set-version DISTRIBUTION 2")]
    if 0 < memory_bytes < SMALL_WSL_BYTES:
        return [
            MachineWarning(
                f"WSL gives Linux {memory_bytes / 1e9:.1f} GB of memory: by default half of what Windows has.",
                "For more, write [wsl2] and memory=24GB into .wslconfig in your Windows profile, then: wsl --shutdown",
            )
        ]
    return []
