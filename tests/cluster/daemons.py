"""A Slurm cluster of two hosts on this machine: its own folder, ports and accounting, and only its own processes.

The second host is a slurmd in a UTS namespace of its own, so that both have their own names, jobs and limits. Memory
limits are enforced by control groups of version 1. The process has to be in a mount namespace of its own, in which the
cluster's configuration is that of the machine: jobs find it only there.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

PROGRAMS = {
    "munged": "munge",
    "mariadbd": "mariadb-server",
    "mysql_install_db": "mariadb-server",
    "slurmdbd": "slurmdbd",
    "slurmctld": "slurm-wlm",
    "slurmd": "slurm-wlm",
    "unshare": "util-linux",
}
HOSTS = ("splatpipe-one", "splatpipe-two")  # the nodes' names
CONFIGURATION = Path("/etc/slurm")
GROUPS = Path("/sys/fs/cgroup")
CLUSTER = "splatpipe"
TIMEOUT_S = 60.0
CONTROLLERS = ("memory", "cpuset", "freezer")  # control groups of version 1 that Slurm uses
PORTS = {"mariadb": 0, "slurmdbd": 1, "slurmctld": 2, "one": 3, "two": 4}


class Problem(Exception):
    """The cluster does not behave as it should, or cannot be set up here."""


def free_ports(count: int) -> int:
    """The first of some free ports in a row."""
    for first in range(26800, 30000, count):
        with suppress(OSError):
            for port in range(first, first + count):
                with socket.socket() as tried:
                    tried.bind(("127.0.0.1", port))
            return first
    raise Problem("No ports are free.")


class Cluster:
    """Daemons of a Slurm cluster.

    Args:
        folder: Folder of their files; emptied.
        cpus: Processors that each host offers.
        memory_mb: Memory that each host offers, megabytes.

    Raises:
        Problem: if this machine lacks something.
    """

    def __init__(self, folder: Path, cpus: int = 2, memory_mb: int = 6000) -> None:
        missing = sorted({package for name, package in PROGRAMS.items() if shutil.which(name) is None})
        if missing:
            raise Problem(f"Needs {', '.join(missing)}: apt install {' '.join(missing)}.")
        if os.geteuid() != 0:
            raise Problem("Needs root, for control groups and a host's name: sudo make test-cluster.")
        if lacking := [name for name in CONTROLLERS if not (GROUPS / name / "tasks").exists()]:
            raise Problem(f"Needs control groups of version 1 below {GROUPS}: {', '.join(lacking)}.")
        shutil.rmtree(folder, ignore_errors=True)
        self.folder = folder
        for name in ("etc", "spool", "state", "data", "log"):
            (folder / name).mkdir(parents=True)
        self.cpus, self.memory_mb = cpus, memory_mb
        self._first_port = free_ports(len(PORTS))
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self) -> None:
        """Start all daemons and wait until both hosts are idle."""
        self._write_configuration()
        subprocess.run(["mount", "--bind", str(self.folder / "etc"), str(CONFIGURATION)], check=True)
        self._start_munge()
        self._start_database()
        self.start_daemon("slurmdbd", ["slurmdbd", "-D"])
        self._await("the accounting's daemon", lambda: self._answers("slurmdbd"))
        self.run("sacctmgr", "-i", "add", "cluster", CLUSTER, check=False)
        self.start_daemon("slurmctld", ["slurmctld", "-D"])
        self._await("the controller", lambda: self._answers("slurmctld"))
        self.run("sacctmgr", "-i", "add", "account", "survey")
        self.run("sacctmgr", "-i", "add", "user", "root", "account=survey", check=False)
        for host in HOSTS:
            self.start_host(host)
        self._await("both hosts", lambda: set(self.node_states().values()) == {"idle"})

    def start_host(self, host: str) -> None:
        """Start a host's slurmd; the second one in a UTS namespace of its own."""
        command = ["slurmd", "-D"]
        if host != HOSTS[0]:
            command = ["unshare", "--uts", "sh", "-c", f"hostname {host} && exec slurmd -D"]
        self.start_daemon(host, command)

    def start_daemon(self, name: str, command: Sequence[str]) -> None:
        """Start a daemon, whose output goes to the folder ``log``."""
        with (self.folder / "log" / f"{name}.out").open("ab") as output:
            self._processes[name] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)

    def end_daemon(self, name: str, *, at_once: bool = False) -> None:
        """End a daemon and wait for its end."""
        process = self._processes.pop(name)
        process.kill() if at_once else process.terminate()
        try:
            process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(TIMEOUT_S)

    def stop(self) -> None:
        """Cancel all jobs and end what was started, the last daemon first; the control groups are removed."""
        with suppress(Problem, subprocess.TimeoutExpired):
            if "slurmctld" in self._processes:
                self.run("scancel", "--user", "root", check=False)
                self._await("the end of all jobs", lambda: not self.run("squeue", "-h"))
        for name in reversed(list(self._processes)):
            self.end_daemon(name)
        for controller in CONTROLLERS:
            for host in HOSTS:
                top = GROUPS / controller / f"slurm_{host}"
                for folder in sorted(top.rglob("*"), reverse=True) if top.is_dir() else ():
                    if folder.is_dir():
                        with suppress(OSError):
                            folder.rmdir()
                with suppress(OSError):
                    top.rmdir()

    def run(self, *command: str, check: bool = True) -> str:
        """Run one of Slurm's commands on this cluster and return its output.

        Raises:
            Problem: if it fails.
        """
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        if check and done.returncode:
            raise Problem(f"{' '.join(command)} failed: {done.stderr.strip()}")
        return done.stdout.strip()

    def node_states(self) -> Mapping[str, str]:
        """State by host, such as ``idle``."""
        lines = self.run("sinfo", "-h", "-N", "-o", "%N %T", check=False).splitlines()
        return dict(line.split() for line in lines)

    def _answers(self, daemon: str) -> bool:
        if self._processes[daemon].poll() is not None:
            raise Problem(f"{daemon} has ended; its output is in {self.folder / 'log'}.")
        words = ("sacctmgr", "-n", "list", "cluster") if daemon == "slurmdbd" else ("scontrol", "ping")
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        return done.returncode == 0 and (daemon == "slurmdbd" or "is UP" in done.stdout)

    @staticmethod
    def _await(what: str, holds: Callable[[], bool]) -> None:
        until_s = time.monotonic() + TIMEOUT_S
        while not holds():
            if time.monotonic() > until_s:
                raise Problem(f"Waited for {what} in vain.")
            time.sleep(0.3)

    def _port(self, name: str) -> int:
        return self._first_port + PORTS[name]

    def _start_munge(self) -> None:
        folder = self.folder / "munge"
        folder.mkdir(mode=0o755)
        key = folder / "key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        words = ["munged", "--foreground", "--force", f"--socket={folder / 'socket'}", f"--key-file={key}"]
        words += [f"--log-file={folder / 'log'}", f"--pid-file={folder / 'pid'}", f"--seed-file={folder / 'seed'}"]
        self.start_daemon("munged", words)
        self._await("munge", (folder / "socket").exists)

    def _start_database(self) -> None:
        data, sock = self.folder / "data" / "mariadb", self.folder / "data" / "socket"
        install = ["mysql_install_db", "--no-defaults", "--user=root", f"--datadir={data}"]
        install += ["--auth-root-authentication-method=normal", "--skip-test-db"]
        subprocess.run(install, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
        command = ["mariadbd", "--no-defaults", "--user=root", f"--datadir={data}", f"--socket={sock}"]
        command += ["--bind-address=127.0.0.1", f"--port={self._port('mariadb')}", f"--pid-file={sock}.pid"]
        command += ["--innodb-buffer-pool-size=64M", "--innodb-log-file-size=32M"]
        self.start_daemon("mariadb", command)
        self._await("MariaDB", sock.exists)
        grant = (
            "CREATE DATABASE slurm; CREATE USER 'slurm'@'%' IDENTIFIED BY 'slurm'; GRANT ALL ON slurm.* TO 'slurm'@'%';"
        )
        grant += grant.partition(";")[2].replace("'%'", "'localhost'")
        subprocess.run(["mariadb", "--no-defaults", f"--socket={sock}", "-e", grant], check=True)

    def _write_configuration(self) -> None:
        munge = f"AuthType=auth/munge\nAuthInfo=socket={self.folder / 'munge' / 'socket'}\n"
        host = "127.0.0.1"
        dbd = self.folder / "etc" / "slurmdbd.conf"
        dbd.write_text(
            f"{munge}DbdHost=localhost\nDbdAddr={host}\nDbdPort={self._port('slurmdbd')}\nSlurmUser=root\n"
            f"StorageType=accounting_storage/mysql\nStorageHost={host}\nStoragePort={self._port('mariadb')}\n"
            f"StorageUser=slurm\nStoragePass=slurm\nStorageLoc=slurm\nPidFile={self.folder / 'slurmdbd.pid'}\n"
            f"LogFile={self.folder / 'log' / 'slurmdbd.log'}\n",
            encoding="utf-8",
        )
        dbd.chmod(0o600)
        one, two = HOSTS
        here = socket.gethostname()
        node = f"CPUs={self.cpus} RealMemory={self.memory_mb} State=UNKNOWN"
        self._write_slurm_conf(
            munge,
            f"NodeName={one} NodeHostname={here} NodeAddr={host} Port={self._port('one')} {node}\n"
            f"NodeName={two} NodeHostname={two} NodeAddr={host} Port={self._port('two')} {node}\n"
            f"PartitionName=normal Nodes={one},{two} Default=YES MaxTime=INFINITE State=UP\n",
        )

    def _write_slurm_conf(self, munge: str, nodes: str) -> None:
        log = self.folder / "log"
        (self.folder / "etc" / "slurm.conf").write_text(
            f"ClusterName={CLUSTER}\nSlurmctldHost={socket.gethostname()}(127.0.0.1)\n{munge}"
            f"SlurmctldPort={self._port('slurmctld')}\nSlurmUser=root\nSlurmdUser=root\n"
            f"StateSaveLocation={self.folder / 'state'}\nSlurmdSpoolDir={self.folder / 'spool'}/%n\n"
            f"SlurmctldPidFile={self.folder / 'slurmctld.pid'}\nSlurmdPidFile={self.folder}/slurmd-%n.pid\n"
            f"SlurmctldLogFile={log}/slurmctld.log\nSlurmdLogFile={log}/slurmd-%n.log\n"
            "ProctrackType=proctrack/linuxproc\nTaskPlugin=task/cgroup\nMpiDefault=none\nReturnToService=2\n"
            "SelectType=select/cons_tres\nSelectTypeParameters=CR_CPU_Memory\nSchedulerType=sched/backfill\n"
            "SchedulerParameters=sched_interval=5,bf_interval=5\nKillWait=10\nSlurmdTimeout=30\nInactiveLimit=0\n"
            "JobRequeue=1\nMinJobAge=300\nJobAcctGatherType=jobacct_gather/linux\nJobAcctGatherFrequency=5\n"
            f"AccountingStoragePass={self.folder}/munge/socket\n"
            f"AccountingStorageType=accounting_storage/slurmdbd\nAccountingStorageHost=127.0.0.1\n"
            f"AccountingStoragePort={self._port('slurmdbd')}\nSlurmctldParameters=idle_on_node_suspend\n"
            f"PropagateResourceLimits=NONE\nLaunchParameters=use_interactive_step\n{nodes}",
            encoding="utf-8",
        )
        (self.folder / "etc" / "cgroup.conf").write_text(
            f"CgroupAutomount=no\nCgroupMountpoint={GROUPS}\nCgroupPlugin=cgroup/v1\n"
            "ConstrainCores=no\nConstrainRAMSpace=yes\nConstrainSwapSpace=no\nAllowedRAMSpace=100\n",
            encoding="utf-8",
        )
