"""Memory and processors as the kernel reports them: file trees as seen in containers, and this machine's own."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from splatpipe.pipeline.engine.machine import (
    available_cores,
    available_memory_bytes,
    free_memory_bytes,
    memory_limit_bytes,
    parse_mounts,
    resident_bytes,
    threads_within,
)

GIB = 1 << 30
MEMINFO = f"MemTotal: {16 << 20} kB\nMemFree: 1 kB\nMemAvailable: {10 << 20} kB\n"
V2 = "31 23 0:28 / /sys/fs/cgroup rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n"
V1 = (
    "31 23 0:28 {root} /sys/fs/cgroup/cpu,cpuacct rw - cgroup cgroup rw,cpu,cpuacct\n"
    "32 23 0:29 {root} /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory\n"
    "33 23 0:30 / /sys/fs/cgroup/unified rw - cgroup2 cgroup2 rw\n"
)


@pytest.fixture(autouse=True)
def _machine_of_four(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: {0, 1, 2, 3})


def tree(root: Path, files: dict[str, str]) -> Path:
    for name, text in {"proc/meminfo": MEMINFO, **files}.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def seen(root: Path) -> tuple[int, float, float]:
    return available_cores(root), available_memory_bytes(root) / GIB, free_memory_bytes(root) / GIB


def test_without_control_groups_the_machine_is_the_limit(tmp_path: Path) -> None:
    assert seen(tree(tmp_path, {})) == (4, 16.0, 10.0)


def test_version_2_limits_of_a_container_count(tmp_path: Path) -> None:
    group = "sys/fs/cgroup"
    files = {
        "proc/self/cgroup": "0::/\n",
        "proc/self/mountinfo": V2,
        f"{group}/cpu.max": "150000 100000\n",
        f"{group}/memory.max": f"{4 * GIB}\n",
        f"{group}/memory.high": "max\n",
        f"{group}/memory.current": f"{3 * GIB}\n",
        f"{group}/memory.stat": f"anon 5\ninactive_file {2 * GIB}\nactive_file 7\n",
    }
    assert seen(tree(tmp_path, files)) == (2, 4.0, 3.0)


def test_limits_of_groups_above_count_too(tmp_path: Path) -> None:
    top = "sys/fs/cgroup/slurm"
    files = {
        "proc/self/cgroup": "0::/slurm/job_7/step_0\n",
        "proc/self/mountinfo": V2,
        f"{top}/memory.max": "max\n",
        f"{top}/cpu.max": "300000 100000\n",
        f"{top}/job_7/memory.max": f"{2 * GIB}\n",
        f"{top}/job_7/memory.current": f"{GIB}\n",
        f"{top}/job_7/step_0/memory.max": f"{8 * GIB}\n",
        f"{top}/job_7/step_0/cpu.max": "max 100000\n",
    }
    assert seen(tree(tmp_path, files)) == (3, 2.0, 1.0)


@pytest.mark.parametrize("root", ["/docker/0a1b", "/"])
def test_version_1_limits_count_with_and_without_a_name_space(tmp_path: Path, root: str) -> None:
    cpu, memory = "sys/fs/cgroup/cpu,cpuacct", "sys/fs/cgroup/memory"
    files = {
        "proc/self/cgroup": f"4:memory:{root}\n3:cpu,cpuacct:{root}\n1:name=systemd:/x\n0::/\n",
        "proc/self/mountinfo": V1.format(root=root),
        f"{cpu}/cpu.cfs_quota_us": "50000\n",
        f"{cpu}/cpu.cfs_period_us": "100000\n",
        f"{memory}/memory.limit_in_bytes": f"{GIB}\n",
        f"{memory}/memory.usage_in_bytes": f"{GIB // 2}\n",
        f"{memory}/memory.stat": f"inactive_file 1\ntotal_inactive_file {GIB // 4}\n",
    }
    assert seen(tree(tmp_path, files)) == (1, 1.0, 0.75)


def test_version_1_says_no_limit_with_huge_and_negative_numbers(tmp_path: Path) -> None:
    files = {
        "proc/self/cgroup": "4:memory:/\n3:cpu,cpuacct:/\n",
        "proc/self/mountinfo": V1.format(root="/"),
        "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us": "-1\n",
        "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_period_us": "100000\n",
        "sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712\n",
        "sys/fs/cgroup/memory/memory.usage_in_bytes": f"{GIB}\n",
    }
    assert seen(tree(tmp_path, files)) == (4, 16.0, 10.0)


@pytest.mark.parametrize(
    "own", ["0::/../../other\n", "0::relative\n", "0::\n", "nonsense\n", "", "0::/gone/for/ever\n"]
)
@pytest.mark.parametrize("limit", ["x", "-5", "²", "9" * 5000, "", "0"])
def test_damaged_files_of_the_kernel_are_no_limit(tmp_path: Path, own: str, limit: str) -> None:
    files = {
        "proc/self/cgroup": own,
        "proc/self/mountinfo": f"{V2}31\n - \n1 2 3 4 5 6 - cgroup2\nx - y z\n",
        "sys/fs/cgroup/cpu.max": f"{limit} {limit}",
        "sys/fs/cgroup/memory.max": limit,
        "sys/fs/cgroup/memory.current": limit,
    }
    assert seen(tree(tmp_path, files)) == (4, 16.0, 10.0)


def test_a_fraction_of_a_processor_counts_as_one(tmp_path: Path) -> None:
    files = {"proc/self/cgroup": "0::/\n", "proc/self/mountinfo": V2, "sys/fs/cgroup/cpu.max": "1000 100000\n"}
    assert available_cores(tree(tmp_path, files)) == 1


def test_names_of_mounts_are_read_as_the_kernel_writes_them() -> None:
    (mount,) = parse_mounts(
        "36 35 98:0 /a\\040b /mnt/c\\134d rw,noatime master:1 - ext3 /dev/root rw,errors=continue\n"
    )
    assert (mount.root, mount.point, mount.kind) == ("/a b", "/mnt/c\\d", "ext3")
    assert mount.options == ("rw", "noatime", "rw", "errors=continue")


def test_this_machine_is_read_correctly() -> None:
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert 0 < free_memory_bytes() <= available_memory_bytes() <= total
    assert 1 <= available_cores() <= 4


def test_as_many_threads_are_taken_as_fit_and_at_least_one(tmp_path: Path) -> None:
    root = tree(tmp_path, {"proc/self/status": f"VmHWM: 7 kB\nVmRSS: {1 << 20} kB\n"})
    assert resident_bytes(root) == GIB and memory_limit_bytes(0, root) == 16 * GIB
    assert memory_limit_bytes(5 * GIB, root) == 5 * GIB and memory_limit_bytes(20 * GIB, root) == 16 * GIB
    assert [threads_within(8, each * GIB, 0, root) for each in (1, 3, 11)] == [8, 3, 1]  # 10 GiB are free
    assert [threads_within(8, GIB, limit * GIB, root) for limit in (1, 3, 99)] == [1, 2, 8]  # one is taken already
    assert threads_within(3, GIB, 0, tmp_path / "unknown") == 3
