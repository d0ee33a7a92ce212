"""The node's page without a server and a browser: who is let in, uploads, checks' results, and what is served."""

import json
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from asgi import Reply, ask
from starlette.types import ASGIApp

from splatpipe.pipeline.app.node.page.checks import RESULT, Checks
from splatpipe.pipeline.app.node.page.gate import COOKIE, PageAccess, own_token, page_access
from splatpipe.pipeline.app.node.page.routes import Page
from splatpipe.pipeline.app.node.serve import make_guarded
from splatpipe.pipeline.app.node.tasks.node import NewTask, Node
from splatpipe.pipeline.app.node.tasks.run_options import MARK_FIRST, run_options
from splatpipe.pipeline.app.node.tasks.settings import Settings

TOKEN = "a token of sixteen letters"
SAME_ORIGIN = ("sec-fetch-site", "same-origin")
JPEG = b"\xff\xd8 not a whole photo, but the node does not look"


class Home:
    """A node that runs nothing, with its page."""

    def __init__(self, folder: Path, token: str = TOKEN) -> None:
        self.folder = folder
        self.node = Node(Settings(folder, least_free_bytes=0))
        self.access = page_access(folder, token)
        self.page = Page(self.node, self.access)
        self.app: ASGIApp = make_guarded(self.node, self.page, token)

    def ours(self, path: str, *headers: tuple[str, str], **how: object) -> Reply:
        """Send a request as the page does."""
        given = [("cookie", f"{COOKIE}={self.access.cookie}"), SAME_ORIGIN, *headers]
        return ask(self.app, f"{self.access.address}{path}", headers=given, **how)  # type: ignore[arg-type]

    def upload(self, uuid: str, name: str, body: bytes = JPEG) -> Reply:
        return self.ours(f"api/upload/{uuid}?name={name}", ("content-type", "application/octet-stream"), body=body)

    def begun(self, *names: str) -> str:
        """A task with these files."""
        uuid = str(self.ours("api/new", value={"name": "a house"}).json["uuid"])
        for name in names:
            assert self.upload(uuid, name, name.encode()).status == 200
        return uuid


@pytest.fixture
def home(tmp_path: Path) -> Home:
    (tmp_path / "node").mkdir()
    return Home(tmp_path / "node")


@pytest.fixture
def finished(home: Home) -> Iterator[tuple[Home, str]]:
    """A task whose run has left a report, and a file that is not among its deliverables."""
    uuid = home.begun("a.jpg", "b.jpg")
    task = home.node.commit(uuid)
    out = home.node.jobs.out(task.job)
    (out / "stages").mkdir(parents=True)
    (out / "config.toml").write_text('photos = "/somewhere"\n')
    (out / "report.html").write_text("<!doctype html><p>report")
    (out / "secret.txt").write_text("secret")
    home.node.tasks.change(uuid, state="completed", ended_ms=1000)
    yield home, uuid


def test_the_token_is_exchanged_for_a_cookie_that_only_our_pages_get(home: Home) -> None:
    assert b'id="token"' in ask(home.app, "/").body
    assert ask(home.app, "/page/enter", value={"token": TOKEN + "x"}).status == 403
    answer = ask(home.app, "/page/enter", value={"token": TOKEN})
    assert answer.json == {"to": home.access.address}
    assert answer.headers["set-cookie"].startswith(f"{COOKIE}={home.access.cookie}; Path={home.access.address[:-1]};")
    assert "HttpOnly; SameSite=Strict" in answer.headers["set-cookie"] and "Secure" not in answer.headers["set-cookie"]
    over_tls = ask(home.app, "/page/enter", value={"token": TOKEN}, headers=[("origin", "https://node.example")])
    assert over_tls.headers["set-cookie"].endswith("; Secure")


def test_strangers_send_no_more_than_a_token(home: Home) -> None:
    answer = ask(home.app, "/page/enter", value={"token": "x" * 20_000})
    assert answer.status != 200 and "set-cookie" not in answer.headers


def test_an_unknown_crs_is_said_on_the_page_and_the_job_can_be_started_with_another(home: Home) -> None:
    uuid = home.begun("a.jpg")
    wrong = {"name": "a house", "options": [{"name": "crs", "value": "EPSG:99999"}]}
    answer = home.ours(f"api/start/{uuid}", value=wrong)
    assert answer.status == 422 and answer.json["error"].startswith("crs: There is no EPSG:99999.")
    right = {"name": "a house", "options": [{"name": "crs", "value": "EPSG:25832"}]}
    assert home.ours(f"api/start/{uuid}", value=right).status == 200


def test_folders_of_a_name_are_cut_off(home: Home) -> None:
    uuid = home.begun("a.jpg")
    assert home.upload(uuid, "a.jpg/b.jpg").status == home.upload(uuid, "../c.jpg").status == 200
    assert home.ours(f"api/files/{uuid}").json["files"] == {name: len(JPEG) for name in ("b.jpg", "c.jpg")} | {
        "a.jpg": 5
    }


def test_without_a_token_the_printed_key_opens_and_nothing_else(tmp_path: Path) -> None:
    home = Home(tmp_path, "")
    assert "set-cookie" not in ask(home.app, "/").headers
    assert "set-cookie" not in ask(home.app, "/?key=" + "0" * 32).headers
    assert ask(home.app, "/page/enter", value={"token": ""}).status == 403
    opened = ask(home.app, f"/?key={home.access.keys.key}")
    assert home.access.cookie in opened.headers["set-cookie"] and home.access.address.encode() in opened.body
    assert ask(home.app, "/", host="evil.example").status == 421


REFUSED_READERS = {
    "no cookie": [SAME_ORIGIN],
    "another cookie": [("cookie", f"{COOKIE}={'0' * 32}"), SAME_ORIGIN],
    "another site": [("sec-fetch-site", "cross-site")],
    "another port": [("sec-fetch-site", "same-site")],
    "another origin of an old browser": [("origin", "http://evil.example")],
    "a sandboxed page": [("origin", "null")],
}


@pytest.mark.parametrize("who", REFUSED_READERS)
def test_only_our_own_page_may_ask(home: Home, who: str) -> None:
    given = REFUSED_READERS[who]
    if not any(name == "cookie" for name, _ in given) and who != "no cookie":
        given = [("cookie", f"{COOKIE}={home.access.cookie}"), *given]
    for target, how in (("api/state", {}), ("task/list", {}), ("api/new", {"value": {"name": "x"}})):
        answer = ask(home.app, f"{home.access.address}{target}", headers=given, **how)  # type: ignore[arg-type]
        assert answer.status == 403, (target, answer.body)
    assert home.node.tasks.all() == []


def test_behind_a_proxy_with_tls_our_page_is_still_ours(home: Home) -> None:
    cookie = ("cookie", f"{COOKIE}={home.access.cookie}")
    origin = ("origin", "https://node.example")
    answer = ask(home.app, f"{home.access.address}api/state", headers=[cookie, origin], host="node.example")
    assert answer.status == 200


def test_the_secrets_outlive_the_node_and_end_with_another_token(tmp_path: Path) -> None:
    first, again, other = (page_access(tmp_path, token) for token in (TOKEN, TOKEN, TOKEN[::-1]))
    assert (first.cookie, first.address) == (again.cookie, again.address)
    assert first.keys.key != again.keys.key
    assert len({first.cookie, other.cookie, first.pages, other.pages}) == 4
    assert own_token(tmp_path) == own_token(tmp_path) and len(own_token(tmp_path)) == 32
    assert stat.S_IMODE((tmp_path / "page.secret").stat().st_mode) == 0o600
    (tmp_path / "page.secret").write_text("half")
    assert page_access(tmp_path, TOKEN).cookie != first.cookie


def test_files_are_uploaded_one_by_one_and_what_is_there_is_told(home: Home) -> None:
    uuid = home.begun("a.jpg")
    assert home.upload(uuid, "b%20c.jpg").status == 200
    assert home.upload(uuid, "b%20c.jpg").status == 200  # the same bytes again
    changed = home.upload(uuid, "a.jpg", b"other bytes")
    assert changed.status == 409 and "other content" in changed.json["error"]
    assert home.upload(uuid, ".hidden").status == 422
    assert home.upload(uuid, "line%0Abreak.jpg").status == 422
    assert home.ours(f"api/files/{uuid}").json["files"] == {"a.jpg": 5, "b c.jpg": len(JPEG)}
    assert home.upload("1" * 8, "a.jpg").status == 404
    state = home.ours("api/state").json["tasks"][0]
    assert (state["name"], state["state"], state["photos"], state["check"]) == (
        "a house",
        "uploading",
        2,
        {"state": "none"},
    )


def test_an_upload_without_a_length_is_refused(home: Home) -> None:
    answer = home.ours(
        f"api/upload/{home.begun()}?name=a.jpg", ("transfer-encoding", "chunked"), ("content-length", ""), body=JPEG
    )
    assert answer.status == 411


def test_starting_sets_name_and_options_and_closes_the_upload(home: Home) -> None:
    uuid = home.begun("a.jpg", "gcp_list.txt")
    wrong = home.ours(f"api/start/{uuid}", value={"name": "roof", "options": [{"name": "preset", "value": "best"}]})
    assert wrong.status == 422 and "preset" in wrong.json["error"]
    options = [{"name": "preset", "value": "preview"}, {"name": "dsm", "value": True}]
    started = home.ours(f"api/start/{uuid}", value={"name": " roof\n", "options": options, "pause": True})
    assert started.status == 200
    task = home.node.tasks.get(uuid)
    assert (task.name, task.state) == ("roof", "wanted")
    assert task.options == {"preset": "preview", "dsm": True, MARK_FIRST: True}
    assert run_options(task.options).until == "georef" and MARK_FIRST not in str(
        ask(home.app, f"/options?token={TOKEN}").body
    )
    assert home.upload(uuid, "b.jpg").status == 409
    assert home.ours("api/state").json["tasks"][0]["place"] == 1


def test_going_on_after_marking_runs_another_job_with_the_changed_control_file(home: Home) -> None:
    uuid = home.begun("a.jpg", "gcp_list.txt")
    home.ours(f"api/start/{uuid}", value={"name": "roof", "options": [], "pause": True})
    before = home.node.tasks.change(uuid, state="completed", ended_ms=1000)
    assert home.ours("api/state").json["tasks"][0]["state"] == "marks"
    control = home.node.tasks.uploads(uuid).path / "gcp_list.txt"
    control.write_bytes(b"GCP_list.txt")  # of the same length
    assert home.ours("api/state").json["tasks"][0]["can"]["marked"]
    assert home.ours(f"api/again/{uuid}", value={"options": None, "pause": False}).status == 200
    after = home.node.tasks.get(uuid)
    assert after.options == {} and after.job != before.job
    old, new = (home.node.jobs.get(task.job) for task in (before, after))
    assert old is not None and new is not None and new.seed == old.key
    assert old.photos["a.jpg"] == new.photos["a.jpg"] and old.photos["gcp_list.txt"] != new.photos["gcp_list.txt"]


def test_removing_ends_even_an_upload(home: Home) -> None:
    uuid = home.begun("a.jpg")
    assert home.ours(f"api/remove/{uuid}", value={}).status == 200
    assert home.ours("api/state").json["tasks"] == []
    assert home.ours(f"api/remove/{uuid}", value={}).status == 404


def test_a_finished_task_lists_its_results_and_serves_only_those_in_a_sandbox(finished: tuple[Home, str]) -> None:
    home, _ = finished
    results = home.ours("api/state").json["tasks"][0]["results"]
    assert [each["title"] for each in results] == ["Report", "report.html"]
    served = ask(home.app, results[0]["href"])  # a sandboxed page has no cookie
    assert served.status == 200 and b"report" in served.body
    assert "sandbox" in served.headers["content-security-policy"]
    assert "allow-same-origin" not in served.headers["content-security-policy"]
    folder = results[0]["href"].rpartition("/")[0]
    for path in ("secret.txt", "config.toml", "stages", "../job.json", "", "report.html/x"):
        assert ask(home.app, f"{folder}/{path}").status == 404, path


def test_the_address_of_a_result_tells_nothing_about_that_of_another(finished: tuple[Home, str]) -> None:
    home, uuid = finished
    other = home.node.create(NewTask("another"))
    foreign = home.access.results(other.uuid).rpartition("/")[2]
    assert ask(home.app, f"/results/{uuid}/{foreign}/report.html").status == 404
    assert ask(home.app, f"/{home.access.results(uuid)}/report.html").status == 200


def test_no_answer_names_a_folder_of_this_machine(finished: tuple[Home, str]) -> None:
    home, uuid = finished
    job = home.node.tasks.get(uuid).job
    error = f"{home.node.jobs.photos(job)}/a.jpg and {home.node.jobs.out(job)} and {home.folder} are bad."
    home.node.tasks.change(uuid, state="failed", error=error)
    state = home.ours("api/state")
    assert str(home.folder).encode() not in state.body
    assert state.json["tasks"][0]["message"].startswith("a.jpg and the run and")


@pytest.fixture
def check(home: Home) -> Callable[..., dict[str, object]]:
    """Keep a result as a check's process would, and return what the page is told."""

    def kept(uuid: str, **changes: object) -> dict[str, object]:
        facts = home.page.facts
        task = home.node.tasks.get(uuid)
        folder = facts.check_folder(uuid)
        folder.mkdir(exist_ok=True)
        result = {"key": facts.upload(task).key, "state": "done", "verdict": "fine", "findings": [], **changes}
        (folder / RESULT).write_text(json.dumps(result))
        return dict(home.ours("api/state").json["tasks"][0]["check"])

    return kept


def test_a_check_counts_only_for_the_files_that_it_saw(home: Home, check: Callable[..., dict[str, object]]) -> None:
    uuid = home.begun("a.jpg")
    assert check(uuid)["state"] == "done"
    assert home.upload(uuid, "b.jpg").status == 200
    assert home.ours("api/state").json["tasks"][0]["check"] == {"state": "none"}
    assert check(uuid, key="broken") == {"state": "none"}


def test_checks_wait_for_each_other_and_are_asked_for_once(home: Home) -> None:
    checks, uuid = Checks(1), home.begun("a.jpg")
    facts = home.page.facts
    upload, folder = facts.upload(home.node.tasks.get(uuid)), facts.check_folder(uuid)
    for _ in range(2):
        checks.ask(uuid, upload, folder)
    assert checks.state(uuid, upload, folder) == {"state": "waiting"}
    checks.stop(uuid)
    assert checks.state(uuid, upload, folder) == {"state": "none"}


def test_the_access_prints_no_secret(tmp_path: Path) -> None:
    access = PageAccess(TOKEN, "s" * 64)
    assert TOKEN not in repr(access) and "sss" not in repr(access) and access.keys.key not in repr(access)
