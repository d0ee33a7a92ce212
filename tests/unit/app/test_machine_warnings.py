"""Warnings of `doctor`, by the kernel's texts on the systems concerned."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatpipe.pipeline.app.machine_warnings import machine_warnings

ROOT = "24 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw\n"
WSL2 = "5.15.167.4-microsoft-standard-WSL2\n"
WINDOWS_DRIVE = (
    "80 24 0:45 / /mnt/c rw,noatime - 9p C:\\134 rw,dirsync,aname=drvfs;path=C:\\;uid=1000;gid=1000;symlinkroot=/mnt/,"
    "cache=5,access=client,msize=65536,trans=fd,rfd=8,wfd=8\n"
)


def warnings(
    root: Path, place: str, *, mounted: str = "", kernel: str = "6.8.0-45-generic\n", gb: int = 64
) -> list[str]:
    """The warnings on a system with these kernel texts."""
    texts = {
        "proc/self/mountinfo": ROOT + mounted,
        "proc/sys/kernel/osrelease": kernel,
        "proc/meminfo": f"MemTotal: {gb * 1_000_000} kB\n",
    }
    for name, text in texts.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return [f"{warning.message} {warning.hint}" for warning in machine_warnings(Path(place), root)]


def test_a_local_disk_needs_no_warning(tmp_path: Path) -> None:
    assert warnings(tmp_path, "/home/jane/out") == []
    assert warnings(tmp_path, "/home/jane/out", kernel=WSL2) == []
    assert warnings(tmp_path, "/", mounted=WINDOWS_DRIVE, kernel=WSL2) == []


@pytest.mark.parametrize("place", ["/mnt/c", "/mnt/c/Users/jane/out"])
def test_a_windows_drive_is_reported(tmp_path: Path, place: str) -> None:
    (said,) = warnings(tmp_path, place, mounted=WINDOWS_DRIVE, kernel=WSL2)
    assert f"{place} is on 9p (mounted at /mnt/c)" in said and "~/out" in said


def test_half_of_windows_memory_is_reported(tmp_path: Path) -> None:
    (said,) = warnings(tmp_path, "/home/jane/out", kernel=WSL2, gb=8)
    assert "8.2 GB" in said and ".wslconfig" in said
    assert "WSL 1" in warnings(tmp_path, "/home/jane/out", kernel="4.4.0-19041-Microsoft\n")[0]
    assert warnings(tmp_path, "/home/jane/out", gb=8) == []  # not WSL


@pytest.mark.parametrize(
    ("kind", "options", "locks_hold"),
    [
        ("nfs4", "rw,vers=4.2,local_lock=none", True),
        ("nfs", "rw,vers=3,nolock,local_lock=all", False),
        ("nfs", "rw,vers=3,local_lock=flock", False),
        ("cifs", "rw,vers=3.1.1,nobrl", False),
        ("cifs", "rw,vers=3.1.1", True),
        ("lustre", "rw,flock", True),
        ("lustre", "rw,localflock", False),
        ("fuse.sshfs", "rw,user_id=0", False),
        ("fuse.glusterfs", "rw,user_id=0", True),
        ("virtiofs", "rw", False),
        ("fakeowner", "rw,fakeowner", False),
        ("xfs", "rw", True),
    ],
)
def test_locks_that_hold_on_one_machine_only_are_reported(
    tmp_path: Path, kind: str, options: str, locks_hold: bool
) -> None:
    mounted = f"81 24 0:46 / /data rw,relatime shared:7 - {kind} server:/share {options}\n"
    said = warnings(tmp_path, "/data/out", mounted=mounted)
    assert len(said) == (0 if locks_hold else 1)
    assert locks_hold or (f"on {kind} (mounted at /data)" in said[0] and "this machine only" in said[0])


def test_read_only_and_in_memory_file_systems_are_reported(tmp_path: Path) -> None:
    mounted = "82 24 0:47 / /media/stick ro - vfat /dev/sdb rw\n83 24 0:48 / /run/x rw - tmpfs tmpfs rw\n"
    assert "read-only" in warnings(tmp_path, "/media/stick/out", mounted=mounted)[0]
    assert "up memory" in warnings(tmp_path, "/run/x/out", mounted=mounted)[0]


def test_the_mount_that_hides_another_counts(tmp_path: Path) -> None:
    hidden = "84 24 0:49 / /data rw - fuse.sshfs a rw\n85 24 8:2 / /data rw - ext4 /dev/sdb rw\n"
    assert warnings(tmp_path, "/data/out", mounted=hidden) == []


def test_a_system_without_these_files_is_no_fault(tmp_path: Path) -> None:
    assert machine_warnings(Path("/anything"), tmp_path) == []
