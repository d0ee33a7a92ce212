"""The engine on a small real pipeline: reuse, reruns, and surviving a crash, a kill and a full disk."""

import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import arithmetic
import pytest
from engine_runs import request_of, run_in_background, walk

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError, StageError, UsageError
from splatpipe.pipeline.engine.events import Event, EventLog, EventReporter
from splatpipe.pipeline.engine.runs.line import Line, line_status
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.engine.runs.session import open_session, status_of
from splatpipe.pipeline.engine.runs.store import open_store

pytestmark = pytest.mark.usefixtures("lines")


@pytest.fixture
def numbers(tmp_path: Path) -> Path:
    folder = tmp_path / "numbers"
    folder.mkdir()
    for name, value in (("a", 1), ("b", 20), ("c", 300)):
        (folder / f"{name}.txt").write_text(str(value))
    return folder


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def test_a_run_writes_its_deliverable_and_a_second_one_runs_nothing(numbers: Path, out: Path) -> None:
    first, _ = walk(request_of(numbers, out))
    assert first.ran == ["read", "add", "count", "tell"]
    assert (out / "telling.txt").read_text() == "3 1 False 21"
    second, events = walk(request_of(numbers, out))
    assert second.ran == []
    assert [event.kind for event in events] == ["run_started", *["stage_reused"] * 4, "run_finished"]


def test_partial_deliverables_of_a_killed_run_are_removed(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    (out / "telling.txt").unlink()
    (out / ".telling.txt.99.new").write_text("3 1")
    (out / ".report.html.99.new").write_text("another process writes it")
    walk(request_of(numbers, out))
    assert (out / "telling.txt").read_text() == "3 1 False 21"
    assert [path.name for path in out.glob(".*.new")] == [".report.html.99.new"]


def test_starts_are_reported_however_soon_they_follow() -> None:
    messages: list[str] = []
    reporter = EventReporter("count", lambda event: messages.append(f"{event.data['what']} {event.data['done']}"))
    for what in ("placing", "joining"):
        for done in range(3):
            reporter.progress(done, 1000, what)
    assert messages[0] == "placing 0"
    assert "joining 0" in messages


def test_a_changed_option_reruns_exactly_as_far_as_it_changes_bytes(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    outcome, _ = walk(request_of(numbers, out, add={"offset": 2}))
    assert outcome.ran == ["add", "tell"]  # the parity stayed, so the count did
    assert (out / "telling.txt").read_text() == "3 1 False 23"


def test_going_back_to_an_earlier_option_reuses_its_artifacts(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    walk(request_of(numbers, out, add={"offset": 1}))
    outcome, _ = walk(request_of(numbers, out))
    assert outcome.ran == []
    assert (out / "telling.txt").read_text() == "3 1 False 21"


def test_a_borrowed_setting_reruns_the_stage_that_borrows_it(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    outcome, _ = walk(request_of(numbers, out, tell={"loud": True}))
    assert outcome.ran == ["count", "tell"]


def test_files_delivered_only_with_an_option_are_removed_without_it(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out, tell={"loud": True}))
    assert (out / "echo.txt").read_text() == "3 1 TRUE 21"
    walk(request_of(numbers, out))
    assert not (out / "echo.txt").exists() and (out / "telling.txt").is_file()
    walk(request_of(numbers, out, tell={"loud": True}))
    (out / "echo.txt").write_text("somebody's own")
    walk(request_of(numbers, out))
    assert (out / "echo.txt").read_text() == "somebody's own"


def test_content_added_to_a_delivered_file_is_kept_and_removed_with_it(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out, tell={"loud": True}))
    echo = out / "echo.txt"
    before = echo.stat()
    echo.write_text(echo.read_text() + ", and more")
    os.utime(echo, ns=(before.st_atime_ns, before.st_mtime_ns))
    walk(request_of(numbers, out, tell={"loud": True}))
    assert echo.read_text() == "3 1 TRUE 21, and more"
    walk(request_of(numbers, out))
    assert not echo.exists()


def test_a_changed_photo_reruns_but_a_touched_or_copied_one_does_not(numbers: Path, out: Path, tmp_path: Path) -> None:
    walk(request_of(numbers, out))
    os.utime(numbers / "a.txt")
    assert walk(request_of(numbers, out))[0].ran == []
    elsewhere = shutil.copytree(numbers, tmp_path / "elsewhere")
    assert walk(request_of(elsewhere, out))[0].ran == []
    (numbers / "a.txt").write_text("2")
    assert walk(request_of(numbers, out))[0].ran == ["read", "add", "count", "tell"]


def test_undeclared_files_are_dropped_and_the_manifest_describes_every_file(numbers: Path, out: Path) -> None:
    outcome, _ = walk(request_of(numbers, out))
    folder = outcome.artifacts["read"].folder
    assert sorted(path.name for path in folder.iterdir()) == ["left_out.json", "manifest.json", "numbers.json"]
    manifest = json.loads((folder / "manifest.json").read_text())
    assert {"versions", "machine", "seconds", "cpu_seconds", "peak_memory_bytes", "inputs"} <= set(manifest)


def test_a_damaged_artifact_is_made_again(numbers: Path, out: Path) -> None:
    outcome, _ = walk(request_of(numbers, out))
    (outcome.artifacts["add"].folder / "total.txt").unlink()
    again, _ = walk(request_of(numbers, out))
    assert again.ran == ["add"]


def test_rerun_runs_again_and_later_stages_are_reused_if_the_bytes_are_the_same(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    outcome, _ = walk(request_of(numbers, out), rerun=frozenset({"add"}))
    assert outcome.ran == ["add"]


def test_until_stops_there(numbers: Path, out: Path) -> None:
    outcome, _ = walk(request_of(numbers, out), until="add")
    assert outcome.ran == ["read", "add"]


def test_one_stage_alone(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    with open_session(request_of(numbers, out), lambda event: None) as runner:
        assert runner.run_alone("count").ran == ["count"]


def test_one_stage_alone_needs_what_it_reads(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out), until="read")
    with (
        pytest.raises(UsageError, match="needs the output of add"),
        open_session(request_of(numbers, out), lambda event: None) as runner,
    ):
        runner.run_alone("count")


@pytest.mark.parametrize(
    ("fail", "error", "message"),
    [
        ("abort", StageError, "SIGABRT"),
        ("kill", StageError, "SIGKILL"),
        ("raise", StageError, "out of order"),
        ("disk", MachineError, "No space left"),
        ("forget", StageError, "did not write count.txt"),
    ],
)
def test_a_failed_stage_has_a_reason_and_earlier_stages_are_kept(
    numbers: Path, out: Path, fail: str, error: type[SplatpipeError], message: str
) -> None:
    with pytest.raises(error, match=message):
        walk(request_of(numbers, out, count={"fail": fail}))
    outcome, _ = walk(request_of(numbers, out))
    assert outcome.ran == ["count", "tell"]


def test_an_error_of_the_input_keeps_its_hint(tmp_path: Path, out: Path) -> None:
    (tmp_path / "none").mkdir()
    with pytest.raises(SplatpipeError, match="no numbers") as caught:
        walk(request_of(tmp_path / "none", out))
    assert caught.value.hint == "Put some in."
    assert caught.value.exit_code == 1


@pytest.mark.parametrize("whole_group", [False, True])
def test_a_killed_run_resumes_from_its_checkpoint(numbers: Path, out: Path, whole_group: bool) -> None:
    slow = {"steps": 200, "step_s": 0.15}
    with run_in_background(numbers, out, **slow) as process:
        assert process.stdout is not None
        process.stdout.readline()
        if whole_group:
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    partial = next((out / "stages" / ".partial").glob("count-*"))
    reached = int((partial / "checkpoint").read_text())
    assert reached < 200
    (partial / "checkpoint").write_text("198")
    outcome, _ = walk(request_of(numbers, out, count=slow))  # the lock is free, so no orphan writes
    assert outcome.ran == ["count", "tell"]
    assert outcome.artifacts["count"].summary == {"began_at": 198}


def test_a_commit_interrupted_between_its_renames_is_finished(numbers: Path, out: Path) -> None:
    outcome, _ = walk(request_of(numbers, out))
    folder = outcome.artifacts["add"].folder
    partial = out / "stages" / ".partial" / folder.name
    folder.rename(partial)
    assert walk(request_of(numbers, out))[0].ran == []
    assert folder.exists()
    assert not partial.exists()


def test_inputs_changed_while_a_stage_reads_them_give_no_artifact(numbers: Path, out: Path) -> None:
    """Its key would claim that it was made from the earlier contents."""
    changed = (numbers / "b.txt").read_text()

    def meddle(event: Event) -> None:
        if (event.kind, event.stage) == ("stage_started", "read"):
            (numbers / "b.txt").write_text("30")

    with (
        pytest.raises(SplatpipeError, match="photos changed while the stage read was reading them"),
        open_session(request_of(numbers, out), meddle) as runner,
    ):
        runner.walk()
    (numbers / "b.txt").write_text(changed)
    assert walk(request_of(numbers, out))[0].artifacts["add"].summary == {"total": 21}


def test_status_states_the_reasons(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    statuses = list(line_status(*status_of(request_of(numbers, out, add={"offset": 5}))))
    assert [(status.stage.name, status.state) for status in statuses] == [
        ("read", "valid"), ("add", "stale"), ("count", "waiting"), ("tell", "waiting"),
    ]  # fmt: skip
    assert statuses[1].reason == "add.offset changed from 0 to 5"


def test_clean_removes_only_unused_artifacts(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    walk(request_of(numbers, out, add={"offset": 1}))
    request = request_of(numbers, out, add={"offset": 1})
    line, store = status_of(request)
    removed, freed = store.remove_stale((status.stage.name, status.key) for status in line_status(line, store))
    assert removed == 3  # the first add, count and tell
    assert freed > 0
    assert walk(request)[0].ran == []


def test_the_run_can_be_continued_from_its_out_alone(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out, add={"offset": 3}))
    photos, config = open_run_folder(out, arithmetic.LINE).config(arithmetic.LineConfig)
    assert photos == numbers and config.add.offset == 3


def test_unusable_out_is_refused(numbers: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="is a file"):
        walk(request_of(numbers, tmp_path / "file"))
    with pytest.raises(UsageError, match="inside the photo folder"):
        walk(request_of(numbers, numbers / "out"))
    with pytest.raises(MachineError, match="Cannot write"):
        walk(request_of(numbers, Path("/proc/splatpipe-out")))
    with pytest.raises(UsageError, match="does not contain a run"):
        open_store(tmp_path / "nowhere", create=False)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "splat.ply").write_text("mine")
    with pytest.raises(UsageError, match="files that are not a run's"):
        walk(request_of(numbers, tmp_path / "taken"))


def test_out_of_another_version_is_left_untouched(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    (out / "stages" / "format.json").write_text('{"format": 99}')
    before = sorted(out.rglob("*"))
    with pytest.raises(UsageError, match="a different layout"):
        walk(request_of(numbers, out))
    assert sorted(out.rglob("*")) == before


def test_events_are_logged_as_json_lines(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    kinds = [json.loads(line)["kind"] for line in (out / "events.jsonl").read_text().splitlines()]
    assert kinds.count("stage_started") == kinds.count("stage_finished") == 4


def test_how_a_run_and_its_stages_ended_is_in_the_events(numbers: Path, out: Path) -> None:
    """Success, failure and death: with exit code, memory, time and the artifact's key."""

    def last(kind: str) -> dict[str, object]:
        events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
        return next(event["data"] for event in reversed(events) if event["kind"] == kind)  # type: ignore[no-any-return]

    first, _ = walk(request_of(numbers, out))
    assert last("run_finished")["exit_code"] == 0 and last("run_started")["versions"]
    finished = last("stage_finished")
    assert finished["key"] == first.artifacts["tell"].key
    assert finished["peak_memory_bytes"] == first.artifacts["tell"].manifest["peak_memory_bytes"]
    for fail, memory_is_known in (("raise", True), ("kill", False)):
        with pytest.raises(StageError) as caught:
            walk(request_of(numbers, out, count={"fail": fail}))
        ended, failed = last("run_finished"), last("stage_failed")
        assert (ended["exit_code"], ended["message"]) == (3, caught.value.message)
        assert failed["message"] == caught.value.message and failed["seconds"] >= 0.0  # type: ignore[operator]
        assert (failed["peak_memory_bytes"] is not None) is memory_is_known
        assert failed["lasting"] is False


@pytest.mark.parametrize(("meddled", "remembered"), [("", True), ("gone", False), ("another", False)])
def test_a_failure_due_to_the_photos_is_remembered_until_they_change(
    numbers: Path, out: Path, meddled: str, remembered: bool
) -> None:
    """If a folder was temporarily missing or still being written, the next run may succeed."""
    for path in numbers.glob("*.txt"):
        path.unlink()
    (numbers / "none.csv").write_text("")

    def meddle(event: Event) -> None:
        if meddled and (event.kind, event.stage) == ("stage_started", "read"):
            (numbers / "none.csv").unlink()
            (numbers / "another.csv").write_text("1") if meddled == "another" else numbers.rmdir()

    with pytest.raises(SplatpipeError), open_session(request_of(numbers, out), meddle) as runner:
        runner.walk()
    events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    (failed,) = (event["data"] for event in events if event["kind"] == "stage_failed")
    assert (failed["exit_code"], failed["lasting"]) == (1, remembered)


def test_hostile_names_do_no_harm(numbers: Path, out: Path) -> None:
    for name in ("näme mit leer", "写真", "new\nline", "quote'\"`$(x)"):
        (numbers / f"{name}.txt").write_text("1")
    Path(os.fsdecode(os.fsencode(numbers) + b"/\xff\xfe.txt")).write_text("1")
    outcome, _ = walk(request_of(numbers, out))
    assert outcome.artifacts["read"].summary == {"numbers": 7}
    assert walk(request_of(numbers, out))[0].ran == []


def test_a_refused_stage_does_not_change_the_configuration(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    changed = request_of(numbers, out, add={"offset": 1})
    with pytest.raises(UsageError), open_session(changed, lambda event: None) as runner:
        runner.run_alone("tell")
    assert open_run_folder(out, arithmetic.LINE).config(arithmetic.LineConfig)[1].add.offset == 0


def test_status_writes_nothing(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    (numbers / "d.txt").write_text("4")
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    list(line_status(*status_of(request_of(numbers, out))))
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before


def test_an_unreadable_photo_is_left_to_ingest_to_report(numbers: Path, out: Path) -> None:
    (numbers / "dangling.md").symlink_to(numbers / "nothing")
    (numbers / "pipe.md").symlink_to("/proc/self/mem")
    assert walk(request_of(numbers, out))[0].ran == ["read", "add", "count", "tell"]


def test_a_run_makes_every_deliverable_and_nothing_beyond_the_request(numbers: Path, out: Path) -> None:
    """Two stages whose outputs no stage reads: both run, since their outputs are for users."""
    side = replace(arithmetic.ADD, deliverables=("total",))
    stages = (arithmetic.READ, arithmetic.COUNT, arithmetic.TELL, side)
    request = replace(request_of(numbers, out), stages=(arithmetic.READ, side, *arithmetic.LINE[2:]))
    assert walk(request)[0].ran == ["read", "add", "count", "tell"]
    line = Line(stages, request.config, {}, numbers)
    assert [stage.name for stage in line.needed("read")] == ["read"]
    assert [stage.name for stage in line.needed()] == ["read", "count", "tell", "add"]


def test_a_disabled_stage_reads_nothing_and_waits_for_nothing(numbers: Path, out: Path) -> None:
    off = request_of(numbers, out, count={"enabled": False})
    assert walk(off, until="count")[0].ran == ["count"]
    assert [status.state for status in line_status(*status_of(off))] == ["missing", "waiting", "valid", "waiting"]
    assert walk(off)[0].ran == ["read", "add", "tell"]
    assert (out / "telling.txt").read_text() == "nothing of 0 parts 21"
    changed = request_of(numbers, out, count={"enabled": False}, add={"offset": 1})
    assert walk(changed)[0].ran == ["add", "tell"]  # another parity, which no stage counts


def test_matching_artifacts_are_found_without_configuration_and_source(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    walk(request_of(numbers, out, add={"offset": 2}))
    walk(request_of(numbers, out))  # reused: what OUT shows is not the newest
    shutil.rmtree(numbers)
    folder = open_run_folder(out, arithmetic.LINE)
    parts = folder.lineage(arithmetic.TELL)
    assert parts["tell.telling"].path.read_text() == (out / "telling.txt").read_text()
    assert parts["add.total"].path.read_text() == "21" and {"read.numbers", "count.count"} <= parts.keys()
    (out / "telling.txt").write_text("something else")
    none = replace(arithmetic.TELL, name="none")
    assert folder.lineage(none, arithmetic.TELL)["add.total"].path.read_text() == "23" and folder.lineage(none) == {}


def test_contents_are_those_of_the_last_run_and_consistent_with_it(numbers: Path, out: Path) -> None:
    first = walk(request_of(numbers, out))[0].artifacts
    second = walk(request_of(numbers, out, add={"offset": 2}))[0].artifacts
    folder, keys = open_run_folder(out, arithmetic.LINE), {name: artifact.key for name, artifact in first.items()}
    for config, known, made in (
        (request_of(numbers, out).config, {}, first),
        (request_of(numbers, out, add={"offset": 2}).config, {}, second),
        (None, keys, first),
        (None, {}, second),
    ):
        assert folder.contents(config, known).artifacts == made
    begun = folder.contents(None, keys | {"add": "f" * 64})  # and has not come to its end
    assert set(begun.parts) == {"read.numbers", "read.left_out"}
    assert begun == folder.contents(None, keys, {"add"})
    shutil.rmtree(first["read"].folder)
    assert folder.contents(None, keys).artifacts == {}


def test_parts_that_no_stage_made_come_from_the_users_folder(numbers: Path, out: Path) -> None:
    """An external part, like a reconstruction, replaces the stage that would have produced it."""
    made = dict(walk(request_of(numbers, out))[0].artifacts)
    shutil.rmtree(made.pop("read").folder)
    assert open_run_folder(out, arithmetic.LINE).contents(None, {}).artifacts == made


def test_unfinished_work_is_found(numbers: Path, out: Path) -> None:
    events: list[Event] = []
    request = request_of(numbers, out, count={"fail": "raise"})
    with pytest.raises(StageError), open_session(request, events.append) as runner:
        runner.walk()
    keys = {event.stage: event.data["key"] for event in events if "key" in event.data}
    contents = open_run_folder(out, arithmetic.LINE).contents(None, keys, {"count"})
    assert (contents.working["count"] / "checkpoint").read_text() == "3"


def test_deliverables_are_existing_files_made_by_a_stage(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    folder = open_run_folder(out, arithmetic.LINE)
    (out / "notes.txt").write_text("mine")
    assert folder.deliverables() == ["telling.txt"]
    (out / "telling.txt").unlink()
    assert folder.deliverables() == []


def test_folder_is_in_use_while_a_session_is_open(numbers: Path, out: Path) -> None:
    with open_session(request_of(numbers, out), lambda event: None):
        assert open_run_folder(out, arithmetic.LINE).is_running
    assert not open_run_folder(out, arithmetic.LINE).is_running


def test_the_log_thins_progress_and_keeps_starts(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "events.jsonl")
    for time_s, what, done in (
        (9.0, "decoding", 1),
        (9.1, "decoding", 2),
        (9.2, "training", 10),
        (11.1, "decoding", 3),
    ):
        log(Event("progress", "train", {"done": done, "total": 99, "what": what, "unit": ""}, time_s))
    log.close()
    logged = [json.loads(line)["data"] for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [(data["what"], data["done"]) for data in logged] == [("decoding", 1), ("training", 10), ("decoding", 3)]
