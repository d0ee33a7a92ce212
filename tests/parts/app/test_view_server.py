"""Access control of ``splatpipe view``, against the real server process: requests meant for others are refused."""

import contextlib
import hashlib
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from finished_run import linked_copy
from served import Served, serving
from timeouts import TIMEOUT_S, wait_until
from view_home import SECRET, WEB, refused

from splatpipe.pipeline.app.serving.connection import REQUEST_S
from splatpipe.pipeline.app.serving.files import FileNotServedError, open_inside, parse_range
from splatpipe.pipeline.app.view.access import user_of
from splatpipe.pipeline.app.view.log import MAX_POINTS, Curve, RunLog


@pytest.fixture(scope="module")
def home(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run in it, and secrets around and inside that it does not deliver."""
    home = tmp_path_factory.mktemp("home")
    out = linked_copy(demo_run, home / "out")
    for place in (home / "secret.txt", out / "secret.txt", out / "stages" / "secret.txt"):
        place.write_bytes(SECRET)
    (home / "elsewhere").mkdir()
    (home / "elsewhere" / "secret.txt").write_bytes(SECRET)
    (out / "cameras.json").unlink()
    (out / "cameras.json").symlink_to(home / "secret.txt")
    (out / "sparse.glb").unlink()
    (out / "sparse.glb").symlink_to("splat.ply")  # even to a deliverable
    # What a stage delivers as a folder names files below it; here the folder of that name in OUT is a link.
    sky = next((out / "stages").glob("export-*")) / "sky" / "deep"
    sky.mkdir(parents=True)
    (sky / "secret.txt").write_bytes(b"its own")
    (out / "deep").symlink_to(home / "elsewhere")
    # The viewer for web hosts, as in OUT, which the stage's manifest lists.
    for folder in (sky.parent, out):
        for name, content in WEB.items():
            (folder / "web" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "web" / name).write_bytes(content)
    _list_in_manifest(sky.parents[1], [f"sky/web/{name}" for name in WEB])
    (out / "web/secret.txt").write_bytes(SECRET)
    return home


def _list_in_manifest(artifact: Path, names: list[str]) -> None:
    manifest = json.loads((artifact / "manifest.json").read_text(encoding="utf-8"))
    for name in names:
        content = (artifact / name).read_bytes()
        entry = {"path": name, "size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        manifest["parts"]["sky"]["files"].append(entry)
    (artifact / "manifest.json").unlink()  # a hard link to the demo run's
    (artifact / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")


@pytest.fixture(scope="module")
def served(home: Path) -> Iterator[Served]:
    with serving(home / "out") as server:
        yield server


def test_the_folder_for_web_hosts_is_served_under_its_own_policy_and_listed_once(served: Served) -> None:
    kinds = {"index.html": "text/html; charset=utf-8", "viewer.js": "text/javascript; charset=utf-8"}
    for name, content in WEB.items():
        answer = served.ask(f"{served.files}/web/{name}")
        assert (answer.status, answer.body) == (200, content)
        assert answer.headers["content-type"] == kinds.get(name, answer.headers["content-type"])
        assert "script-src 'self' 'wasm-unsafe-eval' blob:;" in answer.headers["content-security-policy"]
    assert "content-encoding" not in served.ask(f"{served.files}/web/viewer.js.gz").headers
    assert served.ask(f"{served.files}/web/nodes/a1.spz", "Range: bytes=1-2").body == b"GS"
    for path in ("/web/secret.txt", "/web/", "/web", "/web/nodes/../secret.txt"):
        assert refused(served.ask(served.files + path))
    page = served.ask(f"{served.pages}/run").body.decode()
    assert page.count(f"{served.files}/web/index.html") >= 1
    assert "nodes/a1.spz" not in page


PATHS = [
    "/secret.txt",
    "/../secret.txt",
    "/../../../../../../etc/passwd",
    "/..",
    "/.",
    "/./splat.ply",
    "/stages/../splat.ply",
    "/x/../../secret.txt",
    "/%2e%2e/secret.txt",
    "/%2E%2E/secret.txt",
    "/.%2e/secret.txt",
    "/..%2fsecret.txt",
    "/%2e%2e%2fsecret.txt",
    "/%252e%252e/secret.txt",
    "/%252e%252e%252fsecret.txt",
    "/%25252e%25252e%25252fsecret.txt",
    "/%c0%ae%c0%ae/secret.txt",
    "/%c0%ae%c0%ae%c0%afsecret.txt",
    "/%u002e%u002e/secret.txt",
    "/%EF%BC%8E%EF%BC%8E/secret.txt",
    "/..\\secret.txt",
    "/..%5csecret.txt",
    "/%5c..%5csecret.txt",
    "/..%255csecret.txt",
    "//etc/passwd",
    "///etc/passwd",
    "/%2fetc%2fpasswd",
    "/%2Fetc/passwd",
    "/etc/passwd",
    "/C:/secret.txt",
    "/file:///etc/passwd",
    "file:///etc/passwd",
    "http://127.0.0.1/../secret.txt",
    "http://elsewhere.example/splat.ply",
    "splat.ply",
    "*",
    "/splat.ply%00",
    "/splat.ply%00.html",
    "/secret.txt%00splat.ply",
    "/splat.ply%20",
    "/splat.ply/",
    "/splat.ply/.",
    "/splat.ply/..",
    "/splat.ply/../secret.txt",
    "/splat.ply;/../secret.txt",
    "/SPLAT.PLY",
    "/splat.ply~",
    "/%73plat.ply",
    "/stages",
    "/stages/",
    "/stages/secret.txt",
    "/stages/format.json",
    "/stages/.lock",
    "/.lock",
    "/config.toml",
    "/events.jsonl",
    "/splatpipe.log",
    "/assets/",
    "/assets/..",
    "/assets/../server.py",
    "/assets/%2e%2e/server.py",
    "/assets/build.py",
    "/assets/viewer.js.map",
    "/live/x/0/secret.jpg",
    "/live/../../secret.txt",
    "/live/x/99999999999999999999999/render.jpg",
    "/live/x/-1/render.jpg",
    "/photo/0",
    "/mark",
    "/api/mark",
    "/favicon.ico",
    "/cameras.json",
    "/sparse.glb",
    "/deep/secret.txt",
    "/deep",
    "/" + "a" * 5000,
    "/" + "a/" * 5000,
    "/" + "../" * 300 + "etc/passwd",
]


@pytest.mark.parametrize("path", PATHS, ids=[path[:40] for path in PATHS])
def test_a_path_outside_a_runs_deliverables_is_refused(served: Served, path: str) -> None:
    for folder in ("", served.pages, served.files):
        assert refused(served.ask(folder + path))
        assert refused(served.ask(folder + path, method="HEAD"))
        assert refused(served.ask(folder + path, "Range: bytes=0-99"))


@pytest.mark.parametrize(
    "raw", [b"/splat.ply\0", b"/\0", b"/splat.ply\xff", b"/..\xc0\xafsecret.txt", b"/a b", b"/a\tb"]
)
def test_invalid_paths_are_refused(served: Served, raw: bytes) -> None:
    for folder in ("", served.pages, served.files):
        assert refused(served.ask(folder.encode() + raw))


@pytest.mark.parametrize(
    "host",
    [
        "elsewhere.example",
        "127.0.0.1.elsewhere.example",
        "localhost.elsewhere.example",
        "elsewhere.example:80@127.0.0.1",
        "127.0.0.1@elsewhere.example",
        "127.0.0.1:80:80",
        "127.0.0.1:999999",
        "0.0.0.0",
        "127.0.0.2",
        "127.1",
        "2130706433",
        "0x7f000001",
        "[::ffff:127.0.0.1]",
        "localhost.",
        "localhost, elsewhere.example",
        "127.0.0.1 elsewhere.example",
        "x" * 5000,
        None,
    ],
)
def test_a_host_that_is_not_this_machine_is_refused(served: Served, host: str | None) -> None:
    """A foreign name that resolves to 127.0.0.1 is DNS rebinding."""
    for path in (f"/?key={served.key}", f"{served.pages}/run", f"{served.files}/splat.ply", f"{served.pages}/api/live"):
        assert refused(served.ask(path, host=host))


def test_hosts_of_this_machine_are_answered_on_a_tunnels_port_too(served: Served) -> None:
    for host in (f"127.0.0.1:{served.port}", f"localhost:{served.port}", "localhost:9000", "localhost", "[::1]:9000"):
        assert served.ask(f"{served.pages}/run", host=host).status == 200
    at = f"GET /?key={served.key} HTTP/1".encode()
    assert refused(served.send(at + b".1\r\nHost: localhost\r\nHost: elsewhere.example\r\n\r\n"))
    assert refused(served.send(at + b".0\r\n\r\n"))


@pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "PROPFIND", "get"])
def test_methods_other_than_reading_are_refused(served: Served, home: Path, method: str) -> None:
    before = (home / "out" / "splat.ply").read_bytes()
    assert refused(served.ask(f"{served.files}/splat.ply", "Content-Length: 3", method=method, body=b"bad"))
    assert (home / "out" / "splat.ply").read_bytes() == before


def test_nothing_is_shown_without_key_or_cookie(served: Served) -> None:
    """Whatever the Host: each user of this machine, and each of its pages, can connect."""
    posted = ("Content-Type: application/json", "Content-Length: 2")
    for path in ("/", "/run", "/live", "/api/live", "/assets/live.js", "/splat.ply", "/report.html", "/nothing"):
        for at in (
            path,
            f"{path}?key=",
            f"{path}?key={'0' * 32}",
            f"{path}?Key={served.key}",
            served.pages + path.rstrip("/"),
        ):
            answer = served.ask(at, cookie=False)
            assert (answer.status, answer.headers["connection"]) == (403, "close")
            assert b"splatpipe view printed" in answer.body
            assert "set-cookie" not in answer.headers
        assert served.ask(path, *posted, method="POST", body=b"{}").status == 403
    assert served.ask(f"/?key={served.key}", *posted, method="POST", body=b"{}", cookie=False).status == 403
    for cookie in ("splatpipe=", f"splatpipe={served.key}", f"x={served.cookie.partition('=')[2]}"):
        assert served.ask(f"{served.pages}/run", f"Cookie: {cookie}", cookie=False).status == 403
    for header in ("X-Forwarded-For: 127.0.0.1", "X-Forwarded-Host: localhost", f"Referer: {served.page()}"):
        assert served.ask(f"{served.pages}/run", header, cookie=False).status == 403


def test_a_key_is_exchanged_for_a_cookie_of_our_pages_only(served: Served) -> None:
    """Browsers send a cookie of 127.0.0.1 to other servers on its other ports, but for the path."""
    answer = served.ask(f"/live?key={served.key}", cookie=False)
    assert answer.status == 200 and f"url={served.pages}/live" in answer.body.decode()
    name, *attributes = answer.headers["set-cookie"].split("; ")
    assert set(attributes) == {f"Path={served.pages}", "HttpOnly", "SameSite=Strict"}
    assert served.key not in answer.body.decode() and served.key not in name
    assert answer.headers["referrer-policy"] == "no-referrer" and answer.headers["cache-control"] == "no-store"
    for cookie in (name, f"a=b; {name}", f"{name}; splatpipe=planted", f"splatpipe=planted;{name}"):
        assert served.ask(f"{served.pages}/run", f"Cookie: {cookie}", cookie=False).status == 200
    # The run's pages know their own folder, which does not lead to ours.
    page = served.ask(f"{served.files}/report.html", cookie=False)
    assert page.status == 200 and "set-cookie" not in page.headers
    assert served.pages[1:] not in page.body.decode()
    assert len({served.pages, served.files, served.key, name}) == 4


STRANGER = """
import os, socket, sys
os.setuid(65534)
connection = socket.socket()
connection.connect(("127.0.0.1", int(sys.argv[1])))
connection.sendall(sys.argv[2].encode())
print(connection.recv(99))
"""


def test_the_key_of_the_opened_browser_counts_for_this_user_only(home: Path, tmp_path: Path) -> None:
    """The browser's command line, where it is, can be read by all users."""
    address_file = tmp_path / "address"
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$1" > {address_file}.new && mv {address_file}.new {address_file}\n')
    browser.chmod(0o755)
    with serving(home / "out", "--browser", environment={"BROWSER": str(browser)}) as server:
        address = wait_until(lambda: address_file.is_file() and address_file.read_text().strip(), "the browser")
        target = address.removeprefix(server.address)
        assert server.key not in address and "?key=" in target
        assert "set-cookie" in server.ask(target, cookie=False).headers
        request = f"GET {target} HTTP/1.1\r\nHost: localhost\r\nX-Forwarded-For: 127.0.0.1\r\n\r\n"
        done = subprocess.run(
            [sys.executable, "-c", STRANGER, str(server.port), request], capture_output=True, text=True, check=False
        )
        if os.geteuid() == 0:
            assert "403 Forbidden" in done.stdout
        else:
            assert "PermissionError" in done.stderr  # only root can be somebody else
        command = Path(f"/proc/{server.process.pid}/cmdline").read_text()
        assert server.key not in command and target not in command
    for file in (home / "out").rglob("*"):
        assert not file.is_file() or server.key.encode() not in file.read_bytes()


def test_who_is_at_the_other_end_of_a_connection_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        here = listening.getsockname()
        for family, host in ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::ffff:127.0.0.1")):
            with socket.socket(family) as client:
                client.connect((host, here[1]))
                there = client.getsockname()
                with listening.accept()[0] as ours:
                    assert user_of(ours.getpeername(), ours.getsockname()) == os.geteuid()
                assert user_of(("127.0.0.1", 1), here) is user_of(("127.0.0.3", there[1]), here) is None
    assert user_of(("127.0.0.1", there[1]), here) is None  # closed
    assert user_of(None, here) is user_of(("nowhere", 5), here) is None


def test_reading_has_no_body(served: Served) -> None:
    assert refused(served.ask(f"{served.pages}/run", "Content-Length: 9999999999"))
    assert refused(served.ask(f"{served.pages}/run", "Transfer-Encoding: chunked", body=b"0\r\n\r\n"))


def test_headers_without_end_are_refused(served: Served) -> None:
    assert refused(served.ask(f"{served.pages}/run", "X: " + "a" * 200_000))
    assert refused(served.ask(f"{served.pages}/run", *[f"X-{k}: {k}" for k in range(20_000)]))


def test_files_are_served_unchanged_completely_or_in_ranges(served: Served, home: Path) -> None:
    data = (home / "out" / "splat.ply").read_bytes()
    whole = served.ask(f"{served.files}/splat.ply")
    assert (whole.status, whole.body, whole.headers["accept-ranges"]) == (200, data, "bytes")
    size = len(data)
    for asked, first, last in (
        ("bytes=0-0", 0, 0),
        ("bytes=5-104", 5, 104),
        (f"bytes={size - 7}-", size - 7, size - 1),
        ("bytes=-9", size - 9, size - 1),
        (f"bytes=-{size * 10}", 0, size - 1),
        (f"bytes=10-{10**17}", 10, size - 1),
    ):
        part = served.ask(f"{served.files}/splat.ply", f"Range: {asked}")
        assert (part.status, part.body) == (206, data[first : last + 1])
        assert part.headers["content-range"] == f"bytes {first}-{last}/{size}"
        head = served.ask(f"{served.files}/splat.ply", f"Range: {asked}", method="HEAD")
        assert (head.status, head.body, head.headers["content-length"]) == (206, b"", part.headers["content-length"])
    for asked in (f"bytes={size}-", "bytes=-0", f"bytes={10**17}-{10**17 + 5}"):
        nothing = served.ask(f"{served.files}/splat.ply", f"Range: {asked}")
        assert (nothing.status, nothing.body, nothing.headers["content-range"]) == (416, b"", f"bytes */{size}")
    # Anything but a single byte range must not cause more than one copy of the file to be sent (RFC 9110, 14.2).
    for asked in ("bytes=9-5", "bytes=a-b", "bytes=", "bytes=-", "lines=0-5", "bytes=0-1,3-4", "bytes=" + "0-," * 2000):
        assert (answer := served.ask(f"{served.files}/splat.ply", f"Range: {asked}")).status == 200 and len(
            answer.body
        ) == size


def test_a_cached_file_is_not_sent_again(served: Served, home: Path) -> None:
    tag = served.ask(f"{served.files}/metrics.json").headers["etag"]
    assert (
        again := served.ask(f"{served.files}/metrics.json", f"If-None-Match: {tag}")
    ).status == 304 and again.body == b""
    assert served.ask(f"{served.files}/metrics.json", "Range: bytes=0-3", f"If-Range: {tag}").status == 206
    assert served.ask(f"{served.files}/metrics.json", "Range: bytes=0-3", 'If-Range: "another"').status == 200


def test_every_response_has_restrictive_headers(served: Served) -> None:
    ours = [served.pages + path for path in ("/run", "/live", "/assets/live.js", "/api/live", "/none")]
    of_run = [served.files + path for path in ("/report.html", "/metrics.json", "/splat.ply", "/web/index.html")]
    for path in ("/", f"/?key={served.key}", "/../none", f"{served.files}/none", *ours, *of_run):
        headers = served.ask(path).headers
        assert headers["x-content-type-options"] == "nosniff" and headers["referrer-policy"] == "no-referrer"
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy and "http" not in policy and "*" not in policy
        assert "server" not in headers and served.key not in str(headers)
        if path in of_run:  # a page with an opaque origin of its own, which may load what lies beside it
            assert policy.endswith("; sandbox allow-scripts allow-downloads")
            assert headers["access-control-allow-origin"] == "null"
        else:
            assert headers["cross-origin-resource-policy"] == "same-origin"
            assert "access-control-allow-origin" not in headers


def test_it_listens_on_the_loopback_address_only(served: Served) -> None:
    with pytest.raises(OSError), socket.create_connection(("127.0.0.2", served.port), timeout=5):
        pass
    listening = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines() if " 0A " in line]
    assert [place for place in listening if place.endswith(f":{served.port:04X}")] == [f"0100007F:{served.port:04X}"]
    six = Path("/proc/net/tcp6").read_text() if Path("/proc/net/tcp6").is_file() else ""
    assert f":{served.port:04X} " not in "".join(line for line in six.splitlines() if " 0A " in line)


def test_invalid_calls_are_reported(demo_run: Path, tmp_path: Path) -> None:
    def view(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [
            sys.executable,
            "-m",
            "splatpipe.pipeline.app.cli.main",
            "view",
            *map(str, arguments),
            "--no-browser",
        ]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)

    done = view(tmp_path)
    assert done.returncode == 2 and "does not contain a run" in " ".join(done.stderr.replace("│", " ").split())
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        done = view(demo_run, "--port", taken.getsockname()[1])
    assert done.returncode == 4 and "--port" in done.stderr
    done = view(demo_run, "--bind", "everywhere")
    assert done.returncode == 2 and "--bind 0.0.0.0" in done.stderr
    done = view(demo_run, "--points", "points.csv")
    assert done.returncode == 2 and "--mark" in done.stderr


def test_a_containers_published_port_needs_the_key_under_any_name(demo_run: Path) -> None:
    """127.0.0.2 is this machine, too, and not the address that is listened on without --bind."""

    def status(port: int, host: str, path: str) -> int:
        connection = http.client.HTTPConnection("127.0.0.2", port, timeout=30)
        with contextlib.closing(connection):
            connection.request("GET", path, headers={"Host": host})
            return connection.getresponse().status

    with serving(demo_run, "--bind", "0.0.0.0") as server:
        for host in (f"localhost:{server.port}", "127.0.0.1:8080", f"127.0.0.2:{server.port}", "splat.example"):
            assert status(server.port, host, "/") == status(server.port, host, "/live") == 403
            assert status(server.port, host, f"/live?key={server.key}") == 200
    with serving(demo_run) as server, pytest.raises(ConnectionRefusedError):
        status(server.port, f"localhost:{server.port}", "/")


def half_open(port: int, count: int, sent: bytes = b"GET / HTTP/1.1\r\nX: ") -> list[socket.socket]:
    """Connections that send a part of a request."""
    held = [socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT_S) for _ in range(count)]
    for connection in held:
        with contextlib.suppress(OSError):  # closed already
            connection.sendall(sent)
    return held


def test_half_open_connections_keep_nobody_out(served: Served) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(5):
            for connection in half_open(served.port, 63):
                stack.enter_context(connection)
            assert served.ask(f"{served.pages}/run").status == 200
            assert served.ask("/", cookie=False).status == 403


@pytest.mark.parametrize("sent", [b"", b"G", b"GET / HTTP/1.1\r\nX: ", b"POST"])
def test_half_a_request_is_not_waited_for(served: Served, sent: bytes) -> None:
    """However slowly it goes on: the seconds are for all of it."""
    (connection,) = half_open(served.port, 1, sent)
    with connection:
        began_s, closed = time.monotonic(), False
        connection.settimeout(REQUEST_S / 10.0)
        while not closed and time.monotonic() - began_s < TIMEOUT_S:
            try:
                closed = connection.recv(1) == b""
            except TimeoutError:
                if sent:
                    with contextlib.suppress(OSError):
                        connection.sendall(b"a")
            except ConnectionResetError:
                closed = True
        assert closed and time.monotonic() - began_s > REQUEST_S / 2.0


def test_half_a_body_is_not_waited_for(served: Served) -> None:
    head = f"POST {served.pages}/api/mark/undo HTTP/1.1\r\nHost: localhost\r\nCookie: {served.cookie}\r\n"
    head += "Content-Type: application/json\r\nContent-Length: 9\r\n\r\n{"
    (connection,) = half_open(served.port, 1, head.encode())
    with connection:
        assert connection.recv(1) == b""
    assert served.ask(f"{served.pages}/run").status == 200


def test_a_connection_serves_several_requests(served: Served) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=TIMEOUT_S)
    with contextlib.closing(connection):
        for _ in range(3):
            connection.request("GET", f"{served.pages}/run", headers={"Cookie": served.cookie})
            answer = connection.getresponse()
            assert answer.status == 200 and answer.read()
        assert connection.sock is not None


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_it_ends_on_request(demo_run: Path, number: signal.Signals, code: int) -> None:
    with serving(demo_run) as server:
        server.process.send_signal(number)
        assert server.process.wait(timeout=TIMEOUT_S) == code


def test_a_file_behind_a_link_or_a_pipe_is_not_found(tmp_path: Path) -> None:
    (tmp_path / "out" / "real").mkdir(parents=True)
    (tmp_path / "out" / "real" / "file").write_bytes(b"x")
    (tmp_path / "out" / "linked").symlink_to("real")
    (tmp_path / "out" / "file").symlink_to("real/file")
    os.mkfifo(tmp_path / "out" / "pipe")
    (tmp_path / "link").symlink_to("out")
    out = tmp_path / "out"
    for folder in (out, tmp_path / "link"):  # the folder itself is the user's choice
        file = open_inside(folder, "real/file")
        os.close(file.descriptor)
        assert file.size == 1
    for path in (
        "linked/file",
        "file",
        "pipe",
        "real",
        "",
        ".",
        "..",
        "../out/real/file",
        "/etc/passwd",
        "real/file/x",
    ):
        with pytest.raises(FileNotServedError):
            open_inside(out, path)
    with pytest.raises(FileNotServedError):
        open_inside(out, "real/file\0")


def test_ranges_are_parsed_as_in_http() -> None:
    assert parse_range(None, 10) is None and parse_range("bytes=3-1", 10) is None
    assert parse_range("bytes=3-", 10) == (3, 10) and parse_range("bytes=-3", 10) == (7, 10)
    assert parse_range("bytes=0-99", 10) == (0, 10)
    for asked, size in (("bytes=10-", 10), ("bytes=-0", 10), ("bytes=0-", 0), ("bytes=-5", 0)):
        with pytest.raises(IndexError):
            parse_range(asked, size)


def test_a_garbage_log_is_ignored(tmp_path: Path) -> None:
    good = {"kind": "run_started", "stage": "", "data": {"stages": ["train"]}, "time_s": 1.0}
    lines = [json.dumps(good), "", "{", "[]", "null", '{"kind": 1}', "[" * 100_000, "x" * 400_000]
    lines += [json.dumps({**good, "data": {"stages": 3}}), json.dumps({**good, "kind": "metric", "data": {}})]
    lines += [json.dumps({**good, "kind": "metric", "data": {"name": "loss", "value": 1.0, "step": 1e999}})]
    (tmp_path / "events.jsonl").write_bytes("\n".join(lines).encode() + b"\n\xff\xfe\n")
    log = RunLog(tmp_path, "events.jsonl")
    log.read()
    point = {"kind": "metric", "stage": "train", "data": {"name": "loss", "value": 0.5, "step": 10}, "time_s": 2.0}
    with (tmp_path / "events.jsonl").open("a") as file:
        file.write(json.dumps(point)[:20])
        file.flush()
        log.read()
        file.write(json.dumps(point)[20:] + "\n")
    log.read()
    assert log.curves["loss"].points == [(10, 0.5)]
    (tmp_path / "events.jsonl").unlink()
    (tmp_path / "events.jsonl").symlink_to("/etc/passwd")
    log.read()
    assert log.curves["loss"].points == [(10, 0.5)]


def test_a_curve_stays_short_however_long_it_is_watched() -> None:
    curve = Curve()
    for step in range(50_000):
        curve.add(step, float(step))
    assert len(curve.points) <= MAX_POINTS
    steps = [step for step, _ in curve.points]
    assert steps == sorted(steps) and steps[0] < 100 and steps[-1] > 49_900
    curve.add(100, 0.0)  # a run that went on from an earlier checkpoint
    assert all(step <= 100 for step, _ in curve.points)
