"""Records of tasks and jobs: atomic, read again by the next process, and one job for equal tasks."""

import io
import json
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from timeouts import wait_until

from splatpipe.pipeline.app.node.tasks import node as node_module
from splatpipe.pipeline.app.node.tasks import store as store_module
from splatpipe.pipeline.app.node.tasks.jobs import JobStore, job_key, seed_artifacts
from splatpipe.pipeline.app.node.tasks.node import NewTask, Node
from splatpipe.pipeline.app.node.tasks.options import GivenOptions
from splatpipe.pipeline.app.node.tasks.record import CANCELED, COMPLETED, QUEUED, Task
from splatpipe.pipeline.app.node.tasks.run import photos_argument, prepare
from splatpipe.pipeline.app.node.tasks.scheduler import RefusedTaskError
from splatpipe.pipeline.app.node.tasks.settings import Settings
from splatpipe.pipeline.app.node.tasks.store import TaskStore, UnknownTaskError, now_ms
from splatpipe.pipeline.app.node.tasks.uploads import FileFacts

PREVIEW = GivenOptions({"preset": "preview"})


def _node(folder: Path, **settings: float) -> Node:
    """A node that runs nothing: it is not started."""
    return Node(Settings(folder, least_free_bytes=0, **settings))  # type: ignore[arg-type]


def _uploaded(node: Node, options: GivenOptions = PREVIEW, **files: bytes) -> Task:
    task = node.create(NewTask(options=options))
    for name, content in (files or {"a": b"one", "b": b"two"}).items():
        part = node.begin_file(task.uuid, name if "." in name else f"{name}.jpg")
        assert part is not None
        part.write(content)
        part.finish()
    return task


def _committed(node: Node, options: GivenOptions = PREVIEW, **files: bytes) -> Task:
    return node.commit(_uploaded(node, options, **files).uuid)


@pytest.fixture
def node(tmp_path: Path) -> Node:
    return _node(tmp_path)


def test_the_next_process_knows_every_task(tmp_path: Path, node: Node) -> None:
    uploading, queued = _uploaded(node), _committed(node)
    later = _node(tmp_path)
    assert {task.uuid: task.state for task in later.tasks.all()} == {uploading.uuid: "uploading", queued.uuid: "wanted"}
    assert later.tasks.uploads(uploading.uuid).names() == ["a.jpg", "b.jpg"]
    assert later.commit(uploading.uuid).job == queued.job


def test_committing_twice_changes_nothing(node: Node) -> None:
    task = _committed(node)
    assert node.commit(task.uuid) == task


def test_a_task_without_photos_is_not_committed_and_can_get_some(node: Node) -> None:
    task = _uploaded(node, **{"gcp_list.txt": b"EPSG:4326"})
    with pytest.raises(RefusedTaskError):
        node.commit(task.uuid)
    part = node.begin_file(task.uuid, "a.jpg")
    assert part is not None
    part.finish()
    assert node.commit(task.uuid).images == 1


def test_equal_tasks_share_one_job_and_one_copy_on_the_disk(node: Node) -> None:
    first = _committed(node)
    job = node.jobs.get(first.job)
    assert job is not None
    prepare(job, node.jobs, node.tasks.uploads(first.uuid).path)
    second = _committed(node)
    assert second.job == first.job and second.uuid != first.uuid
    copies = [node.tasks.uploads(task.uuid).path / "a.jpg" for task in (first, second)]
    assert copies[0].samefile(copies[1])


@pytest.mark.parametrize(
    ("options", "files"),
    [
        (GivenOptions({"preset": "high"}), {"a": b"one", "b": b"two"}),
        (PREVIEW, {"a": b"one", "b": b"other"}),
        (PREVIEW, {"a": b"one", "c": b"two"}),
    ],
)
def test_other_photos_names_or_options_are_another_job(
    node: Node, options: GivenOptions, files: dict[str, bytes]
) -> None:
    assert _committed(node).job != _committed(node, options, **files).job


def test_cancelling_or_removing_one_of_equal_tasks_leaves_the_other(node: Node) -> None:
    first, second, third = _committed(node), _committed(node), _committed(node)
    node.scheduler.cancel(first.uuid)
    node.scheduler.remove(second.uuid)
    node.scheduler.remove_unused()
    assert node.scheduler.status(first.uuid).code == CANCELED
    assert node.scheduler.status(third.uuid).code == QUEUED
    assert node.jobs.get(third.job) is not None
    with pytest.raises(UnknownTaskError):
        node.tasks.get(second.uuid)


def test_a_job_goes_with_its_last_task(node: Node) -> None:
    task = _committed(node)
    node.scheduler.remove(task.uuid)
    node.scheduler.remove_unused()
    node.tasks.empty_trash()
    assert node.jobs.get(task.job) is None
    assert not list((node.settings.folder / "jobs").iterdir()) and not list((node.settings.folder / "trash").iterdir())


def test_cancelling_twice_and_after_the_end_gives_a_cancelled_task(node: Node) -> None:
    task = _committed(node)
    node.tasks.change(task.uuid, state="completed", processing_ms=5)
    assert node.scheduler.status(task.uuid).code == COMPLETED
    for _ in range(2):
        node.scheduler.cancel(task.uuid)
        assert node.info(node.tasks.get(task.uuid))["processingTime"] == -1


def test_a_restart_with_other_options_may_reuse_what_the_first_run_made(tmp_path: Path, node: Node) -> None:
    task = _committed(node)
    with pytest.raises(RefusedTaskError):
        node.restart(task.uuid, None)
    node.scheduler.cancel(task.uuid)
    again = node.restart(task.uuid, GivenOptions({"preset": "high"}, ("nonsense",)))
    job = node.jobs.get(again.job)
    assert job is not None and job.seed == task.job and again.options == {"preset": "high"}
    assert any("nonsense" in line for line in again.notes)
    artifact = node.jobs.out(task.job) / "stages" / "ingest-1"
    artifact.mkdir(parents=True)
    (artifact / "photos.json").write_text("{}")
    (artifact / "database.db").write_text("a database is written by those who read it")
    (artifact.parent / ".partial" / "sparse").mkdir(parents=True)
    prepare(job, node.jobs, node.tasks.uploads(task.uuid).path)
    taken = node.jobs.out(again.job) / "stages"
    assert sorted(path.name for path in taken.iterdir()) == ["ingest-1"]
    assert (taken / "ingest-1" / "photos.json").samefile(artifact / "photos.json")
    assert not (taken / "ingest-1" / "database.db").samefile(artifact / "database.db")


def test_links_in_a_received_out_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    artifact = tmp_path / "a" / "stages" / "ingest-1"
    artifact.mkdir(parents=True)
    (artifact / "link").symlink_to(tmp_path / "secret")
    assert seed_artifacts(tmp_path / "a", tmp_path / "b") == 1
    assert list((tmp_path / "b" / "stages" / "ingest-1").iterdir()) == []


def test_a_failed_job_is_tried_again_for_the_next_equal_task(node: Node) -> None:
    first = _committed(node)
    node.jobs.change(first.job, state="failed", error="no", tries=3)
    node.tasks.change(first.uuid, state="failed", error="no")
    _committed(node)
    job = node.jobs.get(first.job)
    assert job is not None and (job.state, job.tries, job.error) == ("new", 0, "")
    assert node.tasks.get(first.uuid).state == "failed"


def test_a_record_that_was_lost_or_damaged_stops_nothing(tmp_path: Path, node: Node) -> None:
    task, other = _committed(node), _committed(node, c=b"x")
    (node.jobs.path(task.job) / "job.json").write_text("[]")
    (node.tasks.path(other.uuid) / "task.json").write_text('{"uuid": 3')
    said: list[str] = []
    later = Node(Settings(tmp_path, least_free_bytes=0), tell=said.append)
    assert [each.uuid for each in later.tasks.all()] == [task.uuid] and len(said) == 2
    later.scheduler.restore()
    assert later.jobs.get(task.job) is not None


def test_a_task_whose_creation_was_not_answered_is_forgotten(tmp_path: Path) -> None:
    (tmp_path / "tasks" / "half").mkdir(parents=True)
    assert TaskStore(tmp_path).all() == []
    assert not (tmp_path / "tasks" / "half").exists()


def test_with_a_full_disk_nothing_is_promised_and_a_task_can_be_cancelled(
    node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    uploaded, queued = _uploaded(node), _committed(node, c=b"x")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(store_module, "write_durably", full)
        for promise in (lambda: node.create(NewTask()), lambda: node.commit(uploaded.uuid)):
            with pytest.raises(OSError, match="No space"):
                promise()
        node.scheduler.cancel(queued.uuid)
        assert node.scheduler.status(queued.uuid).code == CANCELED
    assert len(node.tasks.all()) == 2
    node.tasks.write_late()
    assert json.loads((node.tasks.path(queued.uuid) / "task.json").read_text())["state"] == "canceled"
    assert node.commit(uploaded.uuid).state == "wanted"


def test_ended_tasks_are_removed_after_their_time_and_uploads_that_were_given_up(tmp_path: Path) -> None:
    node = _node(tmp_path, keep_days=2.0)
    old, young, running, given_up = _committed(node), _committed(node), _committed(node), _uploaded(node)
    day = 86_400_000
    node.tasks.change(old.uuid, state="completed", ended_ms=now_ms() - 3 * day)
    node.tasks.change(young.uuid, state="completed", ended_ms=now_ms() - day)
    node.tasks.change(given_up.uuid, touched_ms=now_ms() - 2 * day)
    node.remove_old()
    assert {task.uuid for task in node.tasks.all()} == {young.uuid, running.uuid}


def test_a_film_alone_is_what_a_run_is_given(node: Node) -> None:
    task = _committed(node, **{"flight.mp4": b"x", "flight.srt": b"y"})
    job = node.jobs.get(task.job)
    assert job is not None and photos_argument(job, node.jobs).name == "flight.mp4"


def test_a_key_depends_on_neither_the_order_of_files_nor_of_options() -> None:
    one, two = FileFacts(3, "aa"), FileFacts(3, "bb")
    assert job_key({"a": one, "b": two}, {"x": 1, "y": 2}) == job_key({"b": two, "a": one}, {"y": 2, "x": 1})
    assert job_key({"a": one, "b": two}, {}) != job_key({"a": two, "b": one}, {})


def test_a_job_is_read_as_it_was_written(tmp_path: Path, node: Node) -> None:
    task = _committed(node)
    node.jobs.change(task.job, state="queued", tries=1, waiting="disk")
    assert JobStore(tmp_path).get(task.job) == node.jobs.get(task.job)


def test_why_a_run_waits_names_no_folder_of_the_host(node: Node, tmp_path: Path) -> None:
    task = _committed(node)
    job = node.jobs.get(task.job)
    assert job is not None
    node.scheduler._supervisor._put_off(job, f"Its forecast failed: {tmp_path}/jobs/{job.key}/forecast.json is a link.")
    waiting = node.jobs.get(task.job)
    assert waiting is not None and str(tmp_path) not in waiting.waiting and "forecast.json" in waiting.waiting


def test_names_of_the_host_are_not_in_a_log(node: Node) -> None:
    task = _committed(node)
    node.jobs.output(task.job).write_text(f"wrote {node.jobs.out(task.job)}/dsm.tif\nsee /home/mia/acme/log.txt\n")
    lines = node.lines(node.tasks.get(task.uuid))
    assert lines == ["wrote OUT/dsm.tif", "see log.txt"]


def test_a_zip_is_fetched_unpacked_and_queued_or_the_task_fails_with_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = Node(Settings(tmp_path, least_free_bytes=0), ["files.example"])
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("photos/a.jpg", b"one")
        archive.writestr("readme.md", b"x")
    content = {"good": file.getvalue(), "bad": b"no zip"}
    monkeypatch.setattr(node_module, "fetch", lambda parts, write, _most: write(content[parts.path.removeprefix("/")]))
    ended = {}
    for name in content:
        task = node.commit(node.create(NewTask(zip_url=f"http://files.example/{name}")).uuid)
        assert node.info(task)["status"] == {"code": QUEUED}
        ended[name] = wait_until(lambda uuid=task.uuid: (t := node.tasks.get(uuid)).state != "fetching" and t)
    assert (ended["good"].state, ended["good"].images) == ("wanted", 1) and "readme.md" in ended["good"].notes[0]
    assert ended["bad"].state == "failed" and "zip" in ended["bad"].error
    assert not list(tmp_path.rglob("fetched.zip"))


@pytest.mark.parametrize("command", ["cancel", "remove"])
def test_a_zip_is_not_fetched_to_its_end_for_a_task_that_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    node = Node(Settings(tmp_path, least_free_bytes=0), ["files.example"])
    written, ended = threading.Event(), threading.Event()

    def endless(_parts: object, write: Callable[[bytes], None], _most: int) -> None:
        try:
            while True:
                write(b"x")
                written.set()
        finally:
            ended.set()

    monkeypatch.setattr(node_module, "fetch", endless)
    task = node.commit(node.create(NewTask(zip_url="http://files.example/a")).uuid)
    assert written.wait(30.0)
    getattr(node.scheduler, command)(task.uuid)
    assert ended.wait(30.0)
    wait_until(lambda: not list((tmp_path / "tasks").rglob("fetched.zip")))
