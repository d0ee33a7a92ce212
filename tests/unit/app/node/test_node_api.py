"""NodeODM's calls without a server: what clients send, and what they are told."""

import asyncio
import json
import time
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from asgi import Reply, ask
from starlette.requests import Request
from starlette.types import ASGIApp, Message

from splatpipe.pipeline.app.node.api import bodies
from splatpipe.pipeline.app.node.api.guard import Guard
from splatpipe.pipeline.app.node.api.routes import Api, make_app
from splatpipe.pipeline.app.node.serve import NodeOptions, check_options
from splatpipe.pipeline.app.node.tasks import node as node_module
from splatpipe.pipeline.app.node.tasks.node import Node
from splatpipe.pipeline.app.node.tasks.settings import Settings
from splatpipe.pipeline.app.node.tasks.uploads import UploadFolder
from splatpipe.pipeline.engine.errors import UsageError

TOKEN = "a token of sixteen letters"
FORM = ("content-type", "multipart/form-data; boundary=xyz")


def _form(files: dict[str, bytes] | None = None, **fields: str) -> bytes:
    head = "--xyz\r\nContent-Disposition: form-data"
    body = "".join(f'{head}; name="{name}"\r\n\r\n{text}\r\n' for name, text in fields.items()).encode()
    for name, content in (files or {}).items():
        body += f'{head}; name="images"; filename="{name}"\r\n\r\n'.encode() + content + b"\r\n"
    return body + b"--xyz--\r\n"


class Client:
    """Calls a node that runs nothing."""

    def __init__(self, folder: Path, token: str = "", hosts: tuple[str, ...] = (), least_free: int = 0) -> None:
        self.node = Node(Settings(folder, least_free_bytes=least_free), hosts)
        self.app: ASGIApp = Guard(make_app(Api(self.node), []), token)

    def get(self, target: str, *headers: tuple[str, str]) -> Any:
        return ask(self.app, target, headers=headers).json

    def post(self, target: str, body: bytes = b"", *headers: tuple[str, str]) -> Any:
        return ask(self.app, target, method="POST", body=body, headers=headers).json

    def form(self, target: str, files: dict[str, bytes] | None = None, *headers: tuple[str, str], **fields: str) -> Any:
        return self.post(target, _form(files, **fields), FORM, *headers)

    def command(self, name: str, **values: str) -> Any:
        return self.post(f"/task/{name}", json.dumps(values).encode(), ("content-type", "application/json"))

    def queued(self, **fields: str) -> str:
        """A committed task."""
        uuid = str(self.form("/task/new/init", **fields)["uuid"])
        assert self.form(f"/task/new/upload/{uuid}", {"a.jpg": b"one", "b.jpg": b"two"}) == {"success": True}
        assert self.post(f"/task/new/commit/{uuid}") == {"uuid": uuid}
        return uuid


@pytest.fixture
def client(tmp_path: Path) -> Client:
    return Client(tmp_path)


def test_info_has_what_clients_read(client: Client) -> None:
    found = client.get("/info")
    assert found["version"] == "2.2.4" and found["taskQueueCount"] == 0 and found["maxParallelTasks"] == 1
    assert len(found["engineVersion"]) <= 32 and found["totalMemory"] > found["availableMemory"] > 0
    client.queued()
    assert client.get("/info")["taskQueueCount"] == 1


def test_nobody_logs_in(client: Client) -> None:
    assert client.get("/auth/info")["loginUrl"] is None
    assert "error" in client.form("/auth/login", username="a", password="b")


def test_a_task_is_uploaded_committed_and_queued(client: Client) -> None:
    uuid = client.queued(
        name="Ä house", options='[{"name": "mesh-size", "value": "12345"}]', dateCreated="1700000000000"
    )
    assert client.get("/task/list") == [{"uuid": uuid}]
    assert client.get(f"/task/{uuid}/info") == {
        "uuid": uuid,
        "name": "Ä house",
        "dateCreated": 1700000000000,
        "processingTime": -1,
        "status": {"code": 10},
        "options": [{"name": "mesh-size", "value": 12345}],
        "imagesCount": 2,
        "progress": 0.0,
    }


def test_an_upload_that_was_cut_and_sent_again_is_whole(client: Client) -> None:
    uuid = client.form("/task/new/init")["uuid"]
    whole = _form({"a.jpg": b"one" * 1000, "b.jpg": b"two"})
    assert "error" in client.post(f"/task/new/upload/{uuid}", whole[:2000], FORM)
    for _ in range(2):
        assert client.post(f"/task/new/upload/{uuid}", whole, FORM) == {"success": True}
    assert client.node.tasks.uploads(uuid).sizes() == {"a.jpg": 3000, "b.jpg": 3}


def test_a_file_of_the_same_name_and_other_content_is_refused_with_a_sentence(client: Client) -> None:
    uuid = client.form("/task/new/init")["uuid"]
    client.form(f"/task/new/upload/{uuid}", {"100/a.jpg": b"one"})
    assert "other content" in client.form(f"/task/new/upload/{uuid}", {"101/a.jpg": b"two"})["error"]


def test_after_the_commit_only_what_is_there_is_taken_again(client: Client) -> None:
    uuid = client.queued()
    assert client.form(f"/task/new/upload/{uuid}", {"a.jpg": b"one"}) == {"success": True}
    assert client.form(f"/task/new/upload/{uuid}", {"c.jpg": b"x"}) == {
        "error": "Invalid uuid (not found)",
        "noRetry": True,
    }
    assert client.post(f"/task/new/commit/{uuid}", b"anything", ("content-type", "x")) == {"uuid": uuid}


def test_an_upload_without_files_or_to_nobody_is_not_to_be_sent_again(client: Client) -> None:
    uuid = client.form("/task/new/init")["uuid"]
    assert client.form(f"/task/new/upload/{uuid}")["noRetry"] is True
    assert client.form(f"/task/new/upload/{uuid4()}", {"a.jpg": b"x"})["noRetry"] is True
    assert client.post(f"/task/new/commit/{uuid4()}")["error"] == "Invalid uuid (not found)"


def test_a_uuid_can_be_set_and_asked_for_again_until_it_is_committed(client: Client) -> None:
    wanted = str(uuid4())
    header = ("set-uuid", wanted)
    assert (
        client.form("/task/new/init", None, header) == client.form("/task/new/init", None, header) == {"uuid": wanted}
    )
    client.form(f"/task/new/upload/{wanted}", {"a.jpg": b"x"})
    client.post(f"/task/new/commit/{wanted}")
    assert client.form("/task/new/init", None, header)["error"] == f"Invalid set-uuid: {wanted}"
    assert "Invalid set-uuid" in client.form("/task/new/init", None, ("set-uuid", "../../etc"))["error"]


def test_wrong_options_are_named_as_json_in_the_error(client: Client) -> None:
    found = client.form("/task/new/init", options='[{"name": "mesh-size", "value": "many"}]')
    assert json.loads(found["error"]) == [{"name": "mesh-size", "error": "is not a number"}]


def test_an_unknown_crs_is_refused_before_anything_is_uploaded(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []
    monkeypatch.setattr(UploadFolder, "begin", lambda _folder, name: begun.append(name))
    options = '[{"name": "crs", "value": "EPSG:99999"}]'
    for found in (
        client.form("/task/new/init", options=options),
        client.form("/task/new", {"a.jpg": b"one"}, options=options),
        client.form("/task/new", {"a.jpg": b"one"}, outputs='["../x"]'),
    ):
        assert "There is no EPSG:99999." in found["error"] or "outputs" in found["error"]
    assert begun == [] and client.node.tasks.all() == []


def test_a_restart_with_an_unknown_crs_is_refused_and_the_log_names_what_is_idle(client: Client) -> None:
    uuid = client.queued(options='[{"name": "auto-boundary", "value": true}]')
    client.command("cancel", uuid=uuid)
    assert (
        "EPSG:99999"
        in client.command("restart", uuid=uuid, options='[{"name": "crs", "value": "EPSG:99999"}]')["error"]
    )
    options = json.dumps([{"name": name, "value": True} for name in ("fast-orthophoto", "mesh", "gps-accuracy")])
    assert client.command("restart", uuid=uuid, options=options) == {"success": True}
    log = client.get(f"/task/{uuid}/output")
    assert [word in "\n".join(log) for word in ("auto-boundary", "gps-accuracy", "no: mesh")] == [False, True, True]


@pytest.mark.parametrize("name", ["\ud800", "a\0b", "\x1b[2J"])
def test_a_name_that_cannot_be_stored_or_shown_is_mended(client: Client, name: str) -> None:
    body = json.dumps({"name": name}).encode()
    uuid = client.post("/task/new/init", body, ("content-type", "application/json"))["uuid"]
    assert client.node.tasks.get(uuid).name.isprintable()


def test_options_that_are_not_offered_and_files_without_use_are_named_in_the_log(client: Client) -> None:
    uuid = client.form("/task/new/init", options='[{"name": "pc-ept", "value": true}]')["uuid"]
    client.form(f"/task/new/upload/{uuid}", {"a.jpg": b"x", "seed.zip": b"y"})
    client.post(f"/task/new/commit/{uuid}")
    log = "\n".join(client.get(f"/task/{uuid}/output"))
    assert "pc-ept" in log and "seed.zip" in log
    assert client.get(f"/task/{uuid}/output?line=-1") == client.get(f"/task/{uuid}/output")[-1:]
    assert client.get(f"/task/{uuid}/info?with_output=1")["output"] == client.get(f"/task/{uuid}/output?line=1")


def test_a_whole_task_comes_in_one_request(client: Client) -> None:
    uuid = client.form("/task/new", {"a.jpg": b"one", "gcp_list.txt": b"EPSG:4326"}, name="at once")["uuid"]
    assert client.get(f"/task/{uuid}/info")["name"] == "at once"
    assert "error" in client.form("/task/new", {}, name="without photos")
    assert "error" in client.form("/task/new", {"a.jpg": b"one"}, options="[3]")
    assert len(client.node.tasks.all()) == 1


def test_commands_need_a_task_and_are_the_same_in_both_encodings(client: Client) -> None:
    uuid = client.queued()
    assert client.command("cancel")["error"] == "uuid param missing."
    assert client.command("cancel", uuid="x" * 500)["success"] is False
    assert client.command("cancel", uuid="\ud800")["success"] is False
    kind = ("content-type", "application/x-www-form-urlencoded")
    assert client.post("/task/cancel", f"uuid={uuid}".encode(), kind) == {"success": True}
    assert client.command("cancel", uuid=uuid.upper()) == {"success": True}
    assert client.get(f"/task/{uuid}/info")["status"] == {"code": 50}


def test_a_restart_echoes_the_options_that_the_node_knows(client: Client) -> None:
    uuid = client.queued()
    options = json.dumps([{"name": "mesh-size", "value": 12345}, {"name": "some-option", "value": 5}])
    assert client.command("restart", uuid=uuid, options=options)["error"] == "Task cannot be restarted"
    client.command("cancel", uuid=uuid)
    assert client.command("restart", uuid=uuid, options=options) == {"success": True}
    found = client.get(f"/task/{uuid}/info")
    assert found["options"][0] == {"name": "mesh-size", "value": 12345} and found["status"] == {"code": 10}
    client.command("cancel", uuid=uuid)
    assert client.command("restart", uuid=uuid) == {"success": True}
    assert client.get(f"/task/{uuid}/info")["options"] == found["options"]


def test_a_second_removal_fails(client: Client) -> None:
    uuid = client.queued()
    assert client.command("remove", uuid=uuid) == {"success": True}
    assert client.command("remove", uuid=uuid) == {"success": False, "error": f"{uuid} not found"}
    assert client.get(f"/task/{uuid}/info") == {"error": f"{uuid} not found"}


def test_downloads_have_fixed_names_and_are_ready_at_the_end(client: Client) -> None:
    uuid = client.queued()
    assert client.get(f"/task/{uuid}/download/all.zip")["error"] == "Asset not ready"
    assert client.get(f"/task/{uuid}/download/job.json")["error"] == "Invalid asset"
    assert client.get(f"/task/{uuid4()}/download/all.zip")["error"].endswith("not found")


def test_hosts_are_contacted_only_if_they_are_allowed(tmp_path: Path) -> None:
    client = Client(tmp_path, hosts=("files.example:8080", "hooks.example"))
    for field, url in (
        ("zipurl", "http://169.254.169.254/latest"),
        ("zipurl", "http://files.example/a.zip"),
        ("zipurl", "file:///etc/passwd"),
        ("zipurl", "http://files.example:8080@evil.example/a.zip"),
        ("webhook", "http://localhost:3000/task/remove"),
        ("webhook", "http://hooks.example:99999/"),
        ("webhook", "http://hooks.example/a b"),
    ):
        assert "error" in client.form("/task/new/init", **{field: url}), url
    assert "uuid" in client.form("/task/new/init", webhook="https://hooks.example/end?x=1")
    assert client.node.tasks.all()[0].webhook == "https://hooks.example/end?x=1"


def test_outputs_stay_within_the_results(client: Client) -> None:
    assert "uuid" in client.form("/task/new/init", outputs='["odm_orthophoto/odm_orthophoto.tif"]')
    for outputs in ('["../../etc/passwd"]', '["/etc/passwd"]', "[3]", "{}", "["):
        assert "error" in client.form("/task/new/init", outputs=outputs), outputs


def test_a_full_disk_is_said_before_anything_is_uploaded(tmp_path: Path) -> None:
    client = Client(tmp_path, least_free=1 << 60)
    assert "nearly full" in client.form("/task/new/init")["error"]
    assert client.node.tasks.all() == []


def test_a_body_for_which_there_is_no_disk_is_refused_by_its_length(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    uuid = client.form("/task/new/init")["uuid"]
    length = ("content-length", str(1 << 50))
    assert "full" in client.post(f"/task/new/upload/{uuid}", _form({"a.jpg": b"x"}), FORM, length)["error"]
    assert client.node.tasks.uploads(uuid).names() == []


def test_a_task_has_a_most_of_bytes_however_many_requests_send_them(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node_module, "MAX_TASK_BYTES", 5)
    uuid = client.form("/task/new/init")["uuid"]
    assert client.form(f"/task/new/upload/{uuid}", {"a.jpg": b"123456"}) == {"success": True}
    assert "at most" in client.form(f"/task/new/upload/{uuid}", {"b.jpg": b"x"})["error"]
    assert client.node.tasks.uploads(uuid).names() == ["a.jpg"]


def test_a_body_that_is_not_used_is_waited_for_only_so_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bodies, "IGNORED_S", 0.05)

    async def receive() -> Message:
        await asyncio.sleep(0.01)
        return {"type": "http.request", "body": b"x", "more_body": True}

    began_s = time.monotonic()
    asyncio.run(bodies.drain(Request({"type": "http", "method": "POST", "headers": []}, receive), 1 << 20))
    assert time.monotonic() - began_s < 20.0


def test_a_poll_never_reads_the_disk(client: Client) -> None:
    uuid = client.queued()
    for path in (client.node.tasks.path(uuid) / "task.json", client.node.settings.folder / "jobs"):
        path.rename(path.with_name("gone"))
    assert client.get(f"/task/{uuid}/info?with_output=0")["status"] == {"code": 10}


class TestGuard:
    """Who may send what."""

    def reply(self, client: Client, target: str = "/info", **how: Any) -> Reply:
        return ask(client.app, target, **how)

    def test_without_a_token_only_this_machine_and_no_other_page(self, client: Client) -> None:
        assert self.reply(client, host="localhost:1234").status == 200
        assert self.reply(client, host="[::1]:3000").status == 200
        assert self.reply(client, host="[::2]:3000").status == self.reply(client, host="rebound.example").status == 421
        assert self.reply(client, headers=[("origin", "http://127.0.0.1:3000")]).status == 200
        assert self.reply(client, headers=[("origin", "http://evil.example")]).status == 403
        assert self.reply(client, headers=[("origin", "null")]).status == 403
        assert self.reply(client, headers=[("sec-fetch-site", "cross-site")]).status == 403
        assert "access-control-allow-origin" not in self.reply(client).headers
        assert self.reply(client, method="OPTIONS").status == 405
        assert self.reply(client, "/info?token=ignored").json["version"]

    def test_with_a_token_it_is_asked_for_everywhere(self, tmp_path: Path) -> None:
        client = Client(tmp_path, token=TOKEN)
        wrong = {"error": "Invalid authentication token: token does not match."}
        for query in ("", "?token=", "?token=b", f"?token={TOKEN[:-1]}", "?" + "a&" * 100, "?token=%ff%fe"):
            assert self.reply(client, f"/info{query}").json == wrong
            assert self.reply(client, f"/task/cancel{query}", body=b"uuid=x").json == wrong
        right = self.reply(client, f"/info?token={TOKEN.replace(' ', '%20')}", host="node.example")
        assert right.json["version"] and right.headers["access-control-allow-origin"] == "*"
        assert self.reply(client, "/auth/info").status == 200
        assert self.reply(client, method="OPTIONS").status == 204

    @pytest.mark.parametrize(
        "target",
        [
            "/../etc/passwd",
            "/task/%2e%2e/info",
            "//info",
            "/task/a%2Fb/info",
            "/.git",
            "/task/a b/info",
            "/" + "a" * 500,
        ],
    )
    def test_paths_that_no_call_has_are_refused_before_they_are_decoded(self, client: Client, target: str) -> None:
        assert self.reply(client, target).status == 404

    def test_requests_that_no_client_sends_are_refused(self, client: Client) -> None:
        assert self.reply(client, method="PUT").status == 405
        assert self.reply(client, headers=[("host", "a"), ("host", "b")]).status == 400
        assert self.reply(client, headers=[("content-length", "5")]).status == 400
        assert self.reply(client, f"/info?{'a' * 5000}").status == 414
        assert self.reply(client, "/unknown").status == 404


@pytest.mark.parametrize(
    ("host", "token", "ok"),
    [
        ("127.0.0.1", "", True),
        ("::1", "", True),
        ("0.0.0.0", "", False),
        ("0.0.0.0", TOKEN, True),
        ("192.168.1.5", "short", False),
        ("127.0.0.1", "tøken of sixteen letters", False),
        ("localhost", "", False),
    ],
)
def test_beyond_this_machine_a_good_token_is_needed(tmp_path: Path, host: str, token: str, ok: bool) -> None:
    options = NodeOptions(tmp_path, host=host, token=token)
    if ok:
        check_options(options)
    else:
        with pytest.raises(UsageError):
            check_options(options)
