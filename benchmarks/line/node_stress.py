"""Stress a `splatpipe node`: cut uploads, cancellations, kill -9, a full disk, hostile requests; by default all of it.

    python benchmarks node_stress WORK

Uploads of 20 small photos come from many clients at once over connections that are cut at random. All are committed;
most are cancelled or removed at random moments, the others run to their ends. Meanwhile the node is killed with -9 and
started again. Then hostile requests are sent, and a node on a small tmpfs runs out of disk (this needs root, for
mount). The script exits with 1 at the first thing that is lost, half, or left running, and prints figures. About an
hour on two cores; `--uploads 12 --clients 4 --finish 2 --kills 2 --hostile 300` takes two minutes.
"""

from __future__ import annotations

import argparse
import http.client
import io
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hostile_requests import hostile_zips, requests
from node_clients import HOST, Client, call, form, patient, raw
from PIL import Image

from splatpipe.demo import capture_path

NUMBERS = (*range(1, 17), 20, 24, 28, 32)  # of the demo's photos: an orbit, and some from above
SIZE = (400, 300)
CHEAPEST = {"mark-first": True, "preset": "preview", "feature-quality": "lowest"}  # ends with the georeference
MOST_NODE_BYTES = 300_000_000
INFO_S = 1.0
LIFE_S, LIFE_STARTS = 25.0, 6.0  # most seconds between two kills, and most times that a start takes
TOKEN = "0123456789abcdef"
QUEUED, RUNNING, COMPLETED, CANCELED = 10, 20, 40, 50


class Node:
    """A node's process, which may be killed and started again.

    Args:
        folder: Its folder.
        log: File for what it prints.
        arguments: Further arguments.
    """

    def __init__(self, folder: Path, log: Path, *arguments: str) -> None:
        self.folder, self._log, self._arguments = folder, log, arguments
        with socket.socket() as free:
            free.bind((HOST, 0))
            self.port = int(free.getsockname()[1])
        self.peak_bytes = 0
        self.slowest_s, self.polls = 0.0, 0
        self._ended = threading.Event()
        self.start()
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._watch_memory, self._watch_info)]
        for thread in self._threads:
            thread.start()

    def start(self) -> None:
        """Start it, and wait until it answers."""
        command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "node", str(self.folder)]
        command += ["--port", str(self.port), *self._arguments]
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)
        until_s = time.monotonic() + 120.0
        while time.monotonic() < until_s:
            with suppress(OSError, http.client.HTTPException, ValueError):
                call(self.port, "GET", "/auth/info")
                return
            assert self.process.poll() is None, f"the node ended: see {self._log}"
            time.sleep(0.05)
        raise AssertionError("the node does not answer")

    def kill(self) -> list[int]:
        """Kill it with -9; returns the processes that it had, none of which may outlive it for long."""
        had = descendants(self.process.pid)
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        return had

    def stop(self) -> None:
        """End it as a service manager does."""
        self._ended.set()
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(60.0)
        for thread in self._threads:
            thread.join(30.0)

    def _watch_memory(self) -> None:
        while not self._ended.wait(0.2):
            self.peak_bytes = max(self.peak_bytes, resident_bytes(self.process.pid))

    def _watch_info(self) -> None:
        while not self._ended.wait(1.0):
            began_s = time.monotonic()
            with suppress(OSError, http.client.HTTPException, ValueError):  # it is being started again
                call(self.port, "GET", f"/info?token={TOKEN}")
                self.slowest_s, self.polls = max(self.slowest_s, time.monotonic() - began_s), self.polls + 1


def resident_bytes(process: int) -> int:
    """Resident memory of a process; 0 if it is not there."""
    with suppress(OSError, ValueError, IndexError):
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def parents() -> dict[int, int]:
    """The parent of every process that is no zombie."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            state, parent = path.read_text().rpartition(")")[2].split()[:2]
            if state != "Z":
                found[int(path.parent.name)] = int(parent)
    return found


def descendants(process: int) -> list[int]:
    """Processes that a process started, and those that they started."""
    parent_of, found = parents(), [process]
    for each in found:
        found += [child for child, parent in parent_of.items() if parent == each]
    return found[1:]


def check_gone(processes: Sequence[int], within_s: float = 30.0) -> None:
    """Check that processes end within a time."""
    until_s = time.monotonic() + within_s
    while left := [each for each in processes if each in parents()]:
        names = [Path(f"/proc/{each}/cmdline").read_bytes().replace(b"\0", b" ")[:200] for each in left]
        assert time.monotonic() < until_s, f"processes outlived the node: {names}"
        time.sleep(0.1)


def processes_of(folder: Path) -> list[str]:
    """Command lines that name a folder, except this one."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            words = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if str(folder) in words and int(path.parent.name) != os.getpid() and "node_stress" not in words:
                found.append(words)
    return found


def small_photos() -> list[tuple[str, bytes]]:
    """Twenty small photos of the demo capture, with their positions."""
    found = []
    for number in NUMBERS:
        name, file = f"DJI_{number:04d}.JPG", io.BytesIO()
        with Image.open(capture_path() / name) as photo:
            photo.resize(SIZE).save(file, "JPEG", quality=80, exif=photo.info["exif"])
        found.append((name, file.getvalue()))
    return found


class Uploads:
    """Many clients with many tasks.

    Args:
        node: The node.
        arguments: Numbers of the command line.
        photos: The photos; every task has one byte of its own, unless it is to equal the one before.
    """

    def __init__(self, node: Node, arguments: argparse.Namespace, photos: Sequence[tuple[str, bytes]]) -> None:
        self._node, self._photos, self._wanted = node, photos, arguments
        ends = ["finish"] * arguments.finish + ["cancel", "remove"] * arguments.uploads
        self._ends = ends[: arguments.uploads]
        random.Random(arguments.seed).shuffle(self._ends)
        self._lock, self._next = threading.Lock(), 0
        self.done: dict[str, str] = {}
        self.errors: list[str] = []

    def run(self) -> None:
        """Let all clients upload everything."""
        threads = [threading.Thread(target=self._client, args=(number,)) for number in range(self._wanted.clients)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _client(self, number: int) -> None:
        chance = random.Random(f"{self._wanted.seed} {number}")
        client = Client(self._node.port, chance.randrange(10**9))
        while True:
            with self._lock:
                at, self._next = self._next, self._next + 1
            if at >= len(self._ends) or self.errors:
                return
            try:
                self._one(client, at, chance)
            except Exception as error:
                self.errors.append(f"upload {at}: {error!r}")

    def _one(self, client: Client, at: int, chance: random.Random) -> None:
        same_as = at - 1 if at % 7 == 3 else at
        own = [(name, data + str(same_as).encode()) for name, data in self._photos]
        uuid, end = client.upload(own, CHEAPEST, f"upload {at}"), self._ends[at]
        with self._lock:
            self.done[uuid] = end
        if end == "finish":
            return
        time.sleep(chance.choice((0.0, chance.uniform(0.0, 3.0), chance.uniform(0.0, self._wanted.linger))))
        answer = client.command(end, uuid)
        lost = end == "remove" and str(answer.get("error", "")).endswith("not found")  # done, and the answer was lost
        assert answer.get("success") is True or lost, answer


def keep_killing(node: Node, kills: int, chance: random.Random, over: Callable[[], bool]) -> int:
    """Kill the node at random moments; returns how often, once that is enough or all is over."""
    done, start_s = 0, 1.0
    while done < kills and not over():
        # On a busy machine a node lives longer: an upload has to have a chance of being whole before the next kill.
        time.sleep(chance.uniform(0.0, max(LIFE_S, LIFE_STARTS * start_s)))
        had = node.kill()
        time.sleep(chance.uniform(0.0, 2.0))
        began_s = time.monotonic()
        node.start()
        start_s = time.monotonic() - began_s
        check_gone(had)
        done += 1
        print(f"killed {done} times", flush=True)
    return done


def check_tasks(node: Node, done: Mapping[str, str], patience_s: float) -> None:
    """Check that each task is what was asked for, and wait for those that run to their ends."""
    listed = {each["uuid"] for each in patient(node.port, "GET", "/task/list")}
    expected = {uuid for uuid, end in done.items() if end != "remove"}
    assert listed == expected, f"lost {expected - listed}, too many {listed - expected}"
    until_s, open_tasks = time.monotonic() + patience_s, set(expected)
    while open_tasks:
        for uuid in tuple(open_tasks):
            found = patient(node.port, "GET", f"/task/{uuid}/info")
            assert "error" not in found, found
            code = found["status"]["code"]
            if done[uuid] == "cancel":
                assert code == CANCELED, found
            elif code in (QUEUED, RUNNING):
                continue
            else:
                assert code == COMPLETED, found
                check_archive(node, uuid)
            open_tasks.remove(uuid)
        assert time.monotonic() < until_s, f"{len(open_tasks)} runs did not end"
        time.sleep(1.0)


def check_archive(node: Node, uuid: str) -> None:
    """Check that all.zip of a task is whole."""
    connection = http.client.HTTPConnection(HOST, node.port, timeout=60.0)
    connection.request("GET", f"/task/{uuid}/download/all.zip")
    response = connection.getresponse()
    data = response.read()
    assert len(data) == int(response.headers["Content-Length"])
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None and "report.html" in archive.namelist()
    connection.close()


def check_folder(node: Node, done: Mapping[str, str], photos: Sequence[tuple[str, bytes]]) -> None:
    """Check a stopped node's folder: whole uploads, nothing of removed tasks, no unfinished file."""
    names = {name for name, _ in photos}
    for uuid in (uuid for uuid, end in done.items() if end != "remove"):
        upload = node.folder / "tasks" / uuid / "upload"
        assert {path.name for path in upload.iterdir() if not path.name.startswith(".")} == names
        assert not list(upload.glob("*.part"))
    there = {path.name for path in (node.folder / "tasks").iterdir()}
    assert there == {uuid for uuid, end in done.items() if end != "remove"}, "removed tasks are left"


def attack(node: Node, count: int, seed: int) -> int:
    """Send hostile requests; returns how many were refused, which has to be all."""
    client = Client(node.port, seed)
    uuid = client.upload([("a.jpg", b"x")], {}, "attacked")
    client.command("cancel", uuid)
    before = patient(node.port, "GET", f"/task/{uuid}/info")
    listed = patient(node.port, "GET", "/task/list")
    refused = 0
    slow = [threading.Thread(target=_slow_body, args=(node, uuid), daemon=True) for _ in range(10)]
    for thread in slow:
        thread.start()
    for data in requests(count, uuid, seed):
        answer = raw(node.port, data)
        assert is_refusal(answer), (data[:300], answer[:500])
        assert b"/tasks/" not in answer and str(node.folder).encode() not in answer, answer
        refused += 1
    assert patient(node.port, "GET", f"/task/{uuid}/info") == before
    assert patient(node.port, "GET", "/task/list") == listed
    assert client.command("remove", uuid) == {"success": True}
    return refused


def _slow_body(node: Node, uuid: str) -> None:
    """Send a byte of a body now and then, as long as the node lets it."""
    head = f"POST /task/new/upload/{uuid} HTTP/1.1\r\nHost: {HOST}\r\nContent-Length: 1000000\r\n"
    with suppress(OSError), socket.create_connection((HOST, node.port)) as connection:
        connection.sendall(f"{head}Content-Type: multipart/form-data; boundary=x\r\n\r\n".encode())
        while True:
            connection.sendall(b"-")
            time.sleep(1.0)


def is_refusal(answer: bytes) -> bool:
    """Whether an answer is none, an error of HTTP, or NodeODM's ``error``."""
    if not answer:
        return True
    status = answer.split(b" ", 2)[1:2]
    return bool(status) and ((status[0][:1] in (b"4", b"5") and status[0] != b"500") or b'"error"' in answer)


def guess_tokens(work: Path, count: int) -> int:
    """Call a node with wrong tokens; returns how many were refused, which has to be all."""
    node = Node(work / "with_token", work / "with_token.log", "--token", TOKEN)
    chance = random.Random(count)
    try:
        for number in range(count):
            wrong = TOKEN[: number % 16] + "".join(chance.choices("0123456789abcdef", k=number % 9))
            target = ("/info", "/task/list", "/options", "/task/x/info")[number % 4]
            answer = raw(node.port, f"GET {target}?token={wrong} HTTP/1.1\r\nHost: n\r\n\r\n".encode())
            assert wrong == TOKEN or b"Invalid authentication token" in answer, answer
    finally:
        node.stop()
    return count


def fetch_bad_zips(work: Path) -> int:
    """Let a node fetch zips that must not be unpacked, from a server of this script's; returns how many."""
    bad = dict(hostile_zips())
    with served([*bad.values()]) as port:
        node = Node(work / "zips", work / "zips.log", "--allow-host", f"{HOST}:{port}")
        try:
            for number, what in enumerate(bad):
                url = f"http://{HOST}:{port}/{number}"
                uuid = patient(node.port, "POST", "/task/new/init", *form(zipurl=url))["uuid"]
                patient(node.port, "POST", f"/task/new/commit/{uuid}")
                while (found := patient(node.port, "GET", f"/task/{uuid}/info"))["status"]["code"] == QUEUED:
                    time.sleep(0.1)
                assert found["status"]["code"] == 30, (what, found)
                upload = work / "zips" / "tasks" / uuid
                assert not list(upload.glob("fetched.zip")) and not list(upload.glob("upload/*.part")), what
        finally:
            node.stop()
    return len(bad)


@contextmanager
def served(files: Sequence[bytes]) -> Iterator[int]:
    """Serve files by their numbers; yields the port."""
    from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            data = files[int(self.path[1:])]
            self.send_response(200)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002
            pass

    server = ThreadingHTTPServer((HOST, 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()


def fill_disk(work: Path, photos: Sequence[tuple[str, bytes]]) -> None:
    """Run a node out of disk during uploads and a run: nothing fails, and all goes on once there is room."""
    disk = work / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2500m", "tmpfs", str(disk)], check=True)
    try:
        node = Node(disk / "node", work / "disk.log", "--parallel", "2")
        try:
            client = Client(node.port, 1)
            running = client.upload(photos, CHEAPEST, "running")
            queued = client.upload(photos, {**CHEAPEST, "vertical": "unknown"}, "cancelled while the disk is full")
            waiting = [str(patient(node.port, "POST", "/task/new/init", *form(name="late"))["uuid"]) for _ in range(2)]
            while patient(node.port, "GET", f"/task/{running}/info")["status"]["code"] != RUNNING:
                time.sleep(0.1)
            filler = disk / "filler"
            with filler.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(disk).free - (1 << 20))
            assert "full" in patient(node.port, "POST", "/task/new/init", *form())["error"]
            body, headers = form([(name, bytes(3 << 20)) for name, _ in photos])
            for uuid in waiting:
                assert "error" in patient(node.port, "POST", f"/task/new/upload/{uuid}", body, headers)
            for _ in range(30):  # the run ends for lack of disk, and waits
                found = patient(node.port, "GET", f"/task/{running}/info")
                assert "error" not in found and found["status"]["code"] in (QUEUED, RUNNING, COMPLETED), found
                time.sleep(1.0)
            assert client.command("cancel", queued) == {"success": True}
            filler.unlink()
            for uuid in waiting:
                assert patient(node.port, "POST", f"/task/new/upload/{uuid}", *form(photos)) == {"success": True}
                assert patient(node.port, "POST", f"/task/new/commit/{uuid}") == {"uuid": uuid}
                assert client.command("cancel", uuid) == {"success": True}
            check_tasks(node, {running: "finish", **dict.fromkeys([queued, *waiting], "cancel")}, 1200.0)
            assert node.peak_bytes < MOST_NODE_BYTES
        finally:
            node.stop()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def main() -> None:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--uploads", type=int, default=300)
    parser.add_argument("--clients", type=int, default=30)
    parser.add_argument("--finish", type=int, default=20)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--hostile", type=int, default=2000)
    parser.add_argument("--parallel", type=int, default=2)
    parser.add_argument("--linger", type=float, default=15.0, help="most seconds until a task is cancelled or removed")
    parser.add_argument("--patience", type=float, default=5400.0, help="seconds that runs may take in all")
    parser.add_argument("--full-disk", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True)
    photos = small_photos()
    began_s = time.monotonic()
    node = Node(arguments.work / "node", arguments.work / "node.log", "--parallel", str(arguments.parallel))
    try:
        uploads = Uploads(node, arguments, photos)
        sending = threading.Thread(target=uploads.run)
        sending.start()
        chance, kills = random.Random(arguments.seed), 0
        kills = keep_killing(node, arguments.kills, chance, lambda: bool(uploads.errors))
        sending.join()
        assert not uploads.errors, uploads.errors
        print(f"{len(uploads.done)} uploads after {time.monotonic() - began_s:.0f} s, killed {kills} times", flush=True)
        check_tasks(node, uploads.done, arguments.patience)
        print(f"all tasks have ended after {time.monotonic() - began_s:.0f} s", flush=True)
        refused = attack(node, arguments.hostile * 9 // 10, arguments.seed)
        time.sleep(35.0 if arguments.kills > 5 else 0.0)  # the node tidies up every half minute
        running = descendants(node.process.pid)
        assert not running, running
    finally:
        node.stop()
    check_folder(node, uploads.done, photos)
    assert not processes_of(node.folder), processes_of(node.folder)
    refused += guess_tokens(arguments.work, arguments.hostile // 10)
    zips = fetch_bad_zips(arguments.work)
    assert node.peak_bytes < MOST_NODE_BYTES, node.peak_bytes
    assert node.slowest_s < INFO_S, node.slowest_s
    print(f"peak memory of the node {node.peak_bytes / 1e6:.0f} MB; {node.polls} polls of /info, the slowest took")
    print(f"{node.slowest_s:.2f} s; {refused} hostile requests and {zips} zips refused")
    if arguments.full_disk:
        fill_disk(arguments.work, photos)
        print("a full disk was waited for")
    print(f"{time.monotonic() - began_s:.0f} s in all")


if __name__ == "__main__":
    main()
