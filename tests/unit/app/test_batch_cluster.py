"""A batch whose jobs run elsewhere: what they request, and what is known of them once their engine has ended them."""

import asyncio
import json
import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from batch_captures import call_of, demo, link, planned
from repository import ROOT

from splatpipe.pipeline.app.batch.capture_list import read_captures
from splatpipe.pipeline.app.batch.driver import fresh_call
from splatpipe.pipeline.app.batch.jobs import job as job_module
from splatpipe.pipeline.app.batch.jobs import slurm_queue as slurm
from splatpipe.pipeline.app.batch.jobs import snakemake_process
from splatpipe.pipeline.app.batch.jobs.attempts import AttemptLog, AttemptResult
from splatpipe.pipeline.app.batch.jobs.job_errors import ERRORS_FILE, ErrorRecorder, read_errors
from splatpipe.pipeline.app.batch.jobs.plan import BatchPlan, Call, StageJob, workflow_jobs
from splatpipe.pipeline.app.batch.jobs.shards import CLUSTER_BYTES, NOTHING, stage_job, useful_threads
from splatpipe.pipeline.app.batch.jobs.snakemake_process import Profile, open_profile, require_snakemake
from splatpipe.pipeline.app.batch.jobs.workflow import workflow_text
from splatpipe.pipeline.app.batch.monitor import BatchMonitor
from splatpipe.pipeline.app.batch.pages.state import CaptureState
from splatpipe.pipeline.app.batch.planning import Settings, make_plan
from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_STAGE, EXIT_TERMINATED, MachineError
from splatpipe.pipeline.engine.runs.needs import Need
from splatpipe.stages.line import LINE

TERMINATED = AttemptResult(EXIT_TERMINATED, "Stopped. Finished work is kept.")
DIED = AttemptResult(EXIT_STAGE, "The stage train was killed by SIGKILL.", "See the log.")
PERMANENT = AttemptResult(EXIT_INPUT, "No two photos overlap.", "Fly again.", final=True)
DONE = AttemptResult(0)


def cluster_call(out: Path, *stages: StageJob, retries: int = 1) -> Call:
    call = call_of(out, replace(planned("house"), jobs=stages), retries=retries)
    call.write_plan(replace(call.plan(), local=False))
    return call


def small(stage: str, *, joined: bool = False) -> StageJob:
    return StageJob(stage, 2, 900_000_000, 60.0, 1_000_000, joined)


def report(call: Call, job: str, message: str, number: str = "12", log: str = "/logs/12.log") -> None:
    """Report the end of a job as Snakemake logs it."""
    record = logging.LogRecord("snakemake.logging", logging.ERROR, "", 0, "Error in rule", None, None)
    record.__dict__ |= {
        "event": "job_error",
        "rule_msg": f"{message}For further error details see the cluster/cloud log and the log files of the rule(s).",
        "output": [f"done-1/0001-house/{job} (send to storage)"],
        "log": [None, log],
        "aux": {"external_jobid": number},
    }
    assert ErrorRecorder(call.folder / ERRORS_FILE).filter(record)


def slurm_says(state: str) -> str:
    return f"SLURM-job '12' failed, SLURM status is: '{state}'. Detailed failure reason unavailable (status command)."


def attempt(call: Call, stage: str, ending: AttemptResult | None, number: int = 1, host: str = "far") -> None:
    """Record an attempt as a job on another host does."""
    path = call.attempts_file("0001-house")
    path.parent.mkdir(exist_ok=True)
    begun = {"stage": stage, "began_s": time.time(), "host": host, "process": 1, "number": number}
    with path.open("a") as file:
        file.write(json.dumps({"begun": begun}) + "\n")
    if ending is not None:
        AttemptLog(path).end(ending)


def house(call: Call) -> CaptureState:
    return BatchMonitor(call).state().captures[0]


def test_an_attempt_without_an_end_lives_until_its_engine_has_ended_it(tmp_path: Path) -> None:
    call = cluster_call(tmp_path, small("ingest"), small("train"), retries=0)
    attempt(call, "ingest", DONE)
    attempt(call, "train", None)
    assert (house(call).state, house(call).stage) == ("running", "train")
    report(call, "train", slurm_says("FAILED"))
    assert (house(call).state, house(call).reason) == (
        "failed",
        "Slurm ended its job 12 as FAILED, before it could say why.",
    )
    assert "/logs/12.log" in house(call).hint


@pytest.mark.parametrize(
    ("state", "ending", "reason"),
    [
        ("OUT_OF_MEMORY", TERMINATED, "more memory than its job had requested"),
        ("OUT_OF_MEMORY", DIED, "more memory than its job had requested"),
        ("TIMEOUT", TERMINATED, "time limit"),
        ("PREEMPTED", TERMINATED, "preempted"),
        ("CANCELLED", None, "scancel"),
        ("NODE_FAIL", None, "node on which it ran has failed"),
        ("FAILED", DIED, DIED.message),
        ("FAILED", PERMANENT, PERMANENT.message),
        ("OUT_OF_MEMORY", PERMANENT, PERMANENT.message),
    ],
)
def test_the_reason_is_the_engines_where_it_ended_the_job_and_else_the_jobs_own(
    tmp_path: Path, state: str, ending: AttemptResult | None, reason: str
) -> None:
    call = cluster_call(tmp_path, small("train"), retries=0)
    attempt(call, "train", ending)
    report(call, "train", slurm_says(state))
    assert house(call).state == "failed" and reason in house(call).reason and house(call).hint


def test_a_job_that_slurm_calls_failed_is_out_of_memory_if_its_log_says_so(tmp_path: Path) -> None:
    log = tmp_path / "12.log"
    line = (
        "slurmstepd-two: error: Detected 1 oom-kill event(s) in StepId=2.0. Some of your processes may have been killed"
    )
    for text, reason in (("srun: error", DIED.message), (line, "more memory than its job had requested")):
        call = cluster_call(tmp_path / reason[:5], small("train"), retries=0)
        log.write_text(f"Building DAG of jobs...\n{text}\n")
        attempt(call, "train", DIED)
        report(call, "train", slurm_says("FAILED"), log=str(log))
        assert reason in house(call).reason


def test_a_job_that_dies_before_it_begins_is_an_attempt(tmp_path: Path) -> None:
    call = cluster_call(tmp_path, small("ingest", joined=True), small("features"), small("train"))
    attempt(call, "ingest", DONE)
    report(call, "features", "SLURM sbatch failed. The error message was 'sbatch: error: Memory is too large'.\n")
    assert (house(call).state, house(call).stage, house(call).tries) == ("waiting", "features", 1)
    report(call, "features", slurm_says("NODE_FAIL"))
    assert (house(call).state, house(call).stage, house(call).tries) == ("failed", "features", 2)
    assert house(call).earlier == ("features: Its job failed: sbatch: error: Memory is too large.",)


def test_an_attempt_that_the_engine_starts_again_by_itself_is_none(tmp_path: Path) -> None:
    call = cluster_call(tmp_path, small("train"), retries=0)
    attempt(call, "train", TERMINATED)
    assert (house(call).state, house(call).tries, house(call).earlier) == ("waiting", 0, ())
    attempt(call, "train", None)
    assert (house(call).state, house(call).tries) == ("running", 1)
    AttemptLog(call.attempts_file("0001-house")).end(DONE)
    assert (house(call).state, house(call).tries, house(call).earlier) == ("done", 1, ())


def test_retries_are_those_of_the_job_whichever_of_its_stages_fails(tmp_path: Path) -> None:
    call = cluster_call(tmp_path, small("ingest", joined=True), small("features"), retries=1)
    attempt(call, "ingest", DIED)
    report(call, "features", slurm_says("FAILED"))
    assert house(call).state == "waiting"
    attempt(call, "ingest", DONE, number=2)
    attempt(call, "features", DIED, number=2)
    report(call, "features", slurm_says("FAILED"))
    assert (house(call).state, house(call).stage, house(call).reason) == ("failed", "features", DIED.message)


def test_retries_of_a_hopeless_stage_are_no_attempts(tmp_path: Path) -> None:
    call = cluster_call(tmp_path, small("ingest", joined=True), small("features"), retries=2)
    attempt(call, "ingest", PERMANENT)
    for _retry in range(3):
        report(call, "features", slurm_says("FAILED"))
        assert (house(call).state, house(call).stage, house(call).reason) == ("failed", "ingest", PERMANENT.message)
        assert (house(call).tries, house(call).earlier) == (1, ())


def test_with_the_batch_stopped_nothing_counts_that_its_engine_has_not_ended(tmp_path: Path) -> None:
    call = cluster_call(tmp_path, small("train"), retries=0)
    attempt(call, "train", TERMINATED)
    call.stop_file.touch()
    call.write_end(time.time(), 130, "")
    assert house(call).state == "stopped"


def test_malformed_lines_of_the_engines_reports_are_skipped(tmp_path: Path) -> None:
    assert not read_errors(tmp_path)
    good = '{"of": ["k", "train"], "message": "m", "job": "", "log": ""}\n'
    (tmp_path / ERRORS_FILE).write_text('{"of"\n[]\n7\n{"of": 1}\n' + good)
    assert [error.reason for error in read_errors(tmp_path)["k", "train"]] == ["Its job failed: m."]


def test_other_messages_of_snakemake_are_not_recorded(tmp_path: Path) -> None:
    record = logging.LogRecord("snakemake.logging", logging.INFO, "", 0, "Building DAG of jobs...", None, None)
    assert ErrorRecorder(tmp_path / ERRORS_FILE).filter(record) and not (tmp_path / ERRORS_FILE).exists()


def plan_of(tmp_path: Path, settings: Settings) -> BatchPlan:
    link(tmp_path / "captures" / "house", demo()[:12])
    call = fresh_call(tmp_path / "out")
    return make_plan(read_captures(tmp_path / "captures", call.out), call, settings)


def test_a_job_elsewhere_requests_memory_for_what_starts_it_and_one_that_is_off_is_none(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, Settings("preview", local=False, node_threads=2, node_memory_bytes=6_000_000_000))
    stages = [job.stage for job in plan.captures[0].jobs]
    assert not {"facades", "cloud", "mesh"} & set(stages) and {"ingest", "train"} < set(stages)
    assert min(job.memory_bytes for job in plan.captures[0].jobs) >= NOTHING.memory_bytes + CLUSTER_BYTES
    assert max(job.threads for job in plan.captures[0].jobs) == 2


def test_light_stages_share_a_job(tmp_path: Path) -> None:
    (capture,) = plan_of(tmp_path, Settings("preview", local=False)).captures
    jobs = workflow_jobs(capture.jobs)
    assert list(jobs) == ["publish"] and [job.stage for job in jobs["publish"]] == [job.stage for job in capture.jobs]


def test_shards_their_stage_and_the_one_that_counts_them_have_their_own_jobs(tmp_path: Path) -> None:
    (capture,) = plan_of(tmp_path, Settings("preview", local=False, tables=({"blocks": {"least": 2}},))).captures
    jobs = workflow_jobs(capture.jobs)
    assert list(jobs) == ["blocks", "train", "publish"] and [job.stage for job in jobs["train"]] == ["train"]
    assert [job.stage for each in jobs.values() for job in each] == [job.stage for job in capture.jobs]


def test_a_stage_waits_for_its_shards_only_where_another_job_counts_them(tmp_path: Path) -> None:
    both = replace(planned("house"), jobs=(small("blocks", joined=True), small("train"), small("publish")))
    divided = replace(planned("barn"), jobs=(small("blocks"), small("train")))
    text = workflow_text(call_of(tmp_path, both, divided), BatchPlan(str(tmp_path), 1.0, (both, divided)), LINE)
    assert 'joined(wildcards, "train", "blocks")' in text and "checkpoint blocks:" in text
    waited: list[str] = []

    def get(capture: str) -> None:
        waited.append(capture)

    names: dict[str, Any] = {"checkpoints": SimpleNamespace(blocks=SimpleNamespace(get=get))}
    exec(text[text.index("JOBS =") : text.index("def memory")], names)
    exec(text[text.index("def before") : text.index("wildcard_constraints")], names)
    for capture in (both, divided):
        names["joined"](SimpleNamespace(capture=capture.key), "train", "blocks")
    assert waited == [divided.key]


def test_training_is_forecast_for_the_largest_node_and_the_stage_that_decides_on_blocks_has_its_memory(
    tmp_path: Path,
) -> None:
    asked = []
    for node_bytes in (2_000_000_000, 64_000_000_000):
        plan = plan_of(tmp_path / str(node_bytes), Settings("high", local=False, node_memory_bytes=node_bytes))
        memory = {job.stage: job.memory_bytes for job in plan.captures[0].jobs}
        assert memory["blocks"] >= memory["train"]
        asked.append(memory["train"])
    assert asked[0] < asked[1]


def test_a_gpu_is_requested_only_by_jobs_that_use_it(tmp_path: Path) -> None:
    (capture,) = plan_of(tmp_path, Settings("preview", local=False, gpu=True)).captures
    jobs = {name: [job.stage for job in each] for name, each in workflow_jobs(capture.jobs).items()}
    assert jobs["initialize"][-1] == "initialize" and jobs["evaluate"] == ["blocks", "train", "clean", "evaluate"]


def test_a_long_stage_has_a_job_of_its_own(tmp_path: Path) -> None:
    settings = Settings("high", local=False, tables=({"train": {"time_budget_s": 86400.0}},))
    (capture,) = plan_of(tmp_path, settings).captures
    for stages in workflow_jobs(capture.jobs).values():
        assert len(stages) == 1 or max(job.seconds for job in stages) < 300.0


@pytest.mark.parametrize(("parallel", "threads"), [(0.0, 1), (0.6, 3), (0.7, 4), (0.98, 8), (1.0, 8)])
def test_a_stage_requests_the_processors_that_it_keeps_busy(parallel: float, threads: int) -> None:
    need = Need(10**9, 100.0, 0, parallel=parallel)
    assert useful_threads(need, 8) == threads == stage_job("dsm", need, 8, local=False).threads
    assert stage_job("dsm", need, 8).threads == 8 and useful_threads(need, 1) == 1


def test_a_retry_requests_no_more_memory_than_the_largest_node_has(tmp_path: Path) -> None:
    call = cluster_call(tmp_path, small("ingest", joined=True), small("features"))
    plan = replace(call.plan(), node_memory_bytes=2_000_000_000)
    text = workflow_text(call, plan, LINE)
    memory = text[text.index("def memory") : text.index("def before")]
    names: dict[str, object] = {}
    exec(memory, names)
    asked = names["memory"]
    assert [asked(900, attempt) for attempt in (1, 2, 3)] == [900, 1800, 2000] and asked(2500, 3) == 2500
    assert '"features": [2, 900, 21, 2]' in text and '"ingest"' not in text


def run_job(
    call: Call, monkeypatch: pytest.MonkeyPatch, started: Sequence[str], ending: AttemptResult, number: int
) -> tuple[int, str]:
    """Run a joined job in this process with a stand-in for its command, which starts stages and ends."""
    ran = ""

    def run(_call: Call, _capture: object, job: StageJob, _threads: int, _signals: object, progress: Any) -> object:
        nonlocal ran
        ran = job.stage
        events = call.folder / "events.jsonl"
        with progress.following(events), events.open("a") as file:
            for stage in started:
                file.write(json.dumps({"kind": "stage_started", "stage": stage}) + "\n")
            file.write('{"kind": "stage_st')
        return ending

    monkeypatch.setattr(job_module, "_run", run)
    monkeypatch.setattr(job_module, "end_with_parent", lambda: None)
    monkeypatch.setattr(job_module, "_Signals", lambda: None)
    monkeypatch.setattr(job_module, "FOLLOW_S", 0.01)
    marker = call.folder / "done" / "features"
    monkeypatch.setattr(sys, "argv", ["job", str(call.folder), "0001-house", "features", "2", str(marker), str(number)])
    try:
        job_module.main()
    except SystemExit as end:
        return int(str(end.code)), ran
    assert marker.exists()
    return 0, ran


def test_a_job_of_several_stages_is_one_command_that_goes_on_where_its_last_attempt_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("ingest", "control", "features")
    call = cluster_call(tmp_path, *(small(name, joined=name != "features") for name in names), small("train"))

    def recorded() -> list[tuple[str, int, int | None]]:
        return [(e.stage, e.number, e.exit_code) for e in AttemptLog(call.attempts_file("0001-house")).read()]

    assert run_job(call, monkeypatch, ("ingest", "mesh", "control"), DIED, 1) == (EXIT_STAGE, "features")
    assert recorded() == [("ingest", 1, 0), ("control", 1, EXIT_STAGE)]
    assert run_job(call, monkeypatch, ("control",), DONE, 2) == (0, "features")
    assert recorded()[2:] == [("control", 2, 0), ("features", 2, 0)]
    call.stop_file.touch()
    assert run_job(call, monkeypatch, (), DIED, 3) == (0, "") and len(recorded()) == 4


def test_a_hopeless_stage_is_not_repeated_and_without_room_none_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = cluster_call(tmp_path, small("ingest", joined=True), replace(small("features"), disk_bytes=1 << 62))
    code, ran = run_job(call, monkeypatch, (), DONE, 1)
    assert (code, ran) == (4, "") and "the stages to features need about" in house(call).reason
    assert run_job(call, monkeypatch, (), DONE, 2) == (4, "")
    assert len(AttemptLog(call.attempts_file("0001-house")).read()) == 1


ANSWERS = {
    "sinfo": "2 6000\n16+ 64000+\n",
    "squeue": "{folder}|Resources|rule_train_wildcards_0001-house\n"
    "{folder}|PartitionConfig|rule_train_shard_wildcards_0001-house_2\n"
    "{folder}|ReqNodeNotAvail, UnavailableNodes:two|rule_splat_depths_wildcards_0001-house\n"
    "/elsewhere|Resources|rule_train_wildcards_0002-barn\n{folder}|Resources|somebody's job\nnonsense\n",
}


def test_slurm_says_how_large_its_nodes_are_and_why_jobs_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call = cluster_call(tmp_path, small("ingest", joined=True), small("train"))
    monkeypatch.setattr(slurm, "_answer", lambda words: ANSWERS[words[0]].format(folder=call.folder))
    assert slurm.largest_node("normal") == (16, 64_000_000_000)
    slurm.store_queue(call.folder)
    assert slurm.read_queue(call.folder) == {
        "0001-house/train": "Waiting in Slurm's queue: no node has enough free (Resources).",
        "0001-house/train.2": "Waiting in Slurm's queue: no node of its partition is large enough (PartitionConfig).",
        "0001-house/splat_depths": "Waiting in Slurm's queue: the nodes that could run it are down or drained "
        "(ReqNodeNotAvail, UnavailableNodes:two).",
    }
    assert (house(call).state, house(call).stage) == ("waiting", "ingest")
    assert house(call).reason == "Waiting in Slurm's queue: no node has enough free (Resources)."
    attempt(call, "ingest", None)
    assert (house(call).state, house(call).reason) == ("running", "")
    monkeypatch.setattr(slurm, "_answer", lambda words: "")
    assert slurm.largest_node("") == (0, 0)


def test_a_profile_states_its_executor_and_its_largest_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snakemake_process, "largest_node", lambda partition: (4 if partition == "normal" else 1, 7))
    shipped = open_profile(ROOT / "configs" / "batch" / "slurm")
    assert shipped.executor == "slurm" and shipped.largest_machine() == (4, 7)
    assert "slurm-status-command: squeue" in shipped.text and "snakemake-executor-plugin-slurm==2.8.0" in shipped.text
    assert Profile(None, f"{shipped.text}\nmax-threads: 16\n").largest_machine() == (16, 7)
    assert Profile(None, "executor: 'kubernetes'\nmax-threads: 3").largest_machine() == (3, 0)
    assert Profile().local and Profile().largest_machine() == (0, 0)


def test_what_is_lacking_is_named_with_a_command_that_works(monkeypatch: pytest.MonkeyPatch) -> None:
    lacking: Sequence[str] = ()
    monkeypatch.setattr(snakemake_process.importlib.util, "find_spec", lambda name: None if name in lacking else name)
    require_snakemake(Profile())
    require_snakemake(Profile(None, "executor: slurm"))
    lacking = ("snakemake",)
    with pytest.raises(MachineError) as lacks:
        require_snakemake(Profile())
    assert lacks.value.hint == f"Install it: {sys.executable} -m pip install 'snakemake>=9.20,<10'"
    lacking = ("snakemake_executor_plugin_slurm",)
    with pytest.raises(MachineError, match="no executor slurm") as lacks:
        require_snakemake(Profile(None, "executor: slurm"))
    assert lacks.value.hint == f"Install it: {sys.executable} -m pip install snakemake-executor-plugin-slurm==2.8.0"
    lacking = ("snakemake_executor_plugin_kubernetes", "pip")
    with pytest.raises(MachineError) as lacks:
        require_snakemake(Profile(None, "executor: kubernetes"))
    assert "SNAKEMAKE_PLUGINS" in lacks.value.hint


def test_the_user_is_called_as_the_machine_calls_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call = Call(tmp_path)
    monkeypatch.delenv("LOGNAME", raising=False)
    monkeypatch.setattr(snakemake_process.pwd, "getpwuid", lambda _number: SimpleNamespace(pw_name="anna"))
    assert snakemake_process.snakemake_environment(call)["LOGNAME"] == "anna"

    def unknown(number: int) -> None:
        raise KeyError(number)

    monkeypatch.setattr(snakemake_process.pwd, "getpwuid", unknown)
    assert snakemake_process.snakemake_environment(call)["LOGNAME"].startswith("user-")


def test_an_error_whose_text_is_on_the_next_line_is_told_with_it(tmp_path: Path) -> None:
    call = Call(tmp_path)
    call.snakemake_log.write_text("Building\nWorkflowError:\nAt least one job did not complete successfully.\n")
    assert snakemake_process.last_error_line(call) == "WorkflowError: At least one job did not complete successfully."


@pytest.mark.parametrize(("plugins_own", "slept"), [(5, 5), (180, 10)])
def test_an_executor_polls_as_often_as_snakemake_is_set_to(
    monkeypatch: pytest.MonkeyPatch, plugins_own: int, slept: int
) -> None:
    from snakemake_interface_executor_plugins.executors.remote import RemoteExecutor

    found = []

    async def sleep(seconds: float) -> None:
        found.append(seconds)

    monkeypatch.setattr(RemoteExecutor, "sleep", None)
    monkeypatch.setattr(snakemake_process.asyncio, "sleep", sleep)
    snakemake_process.limit_poll_intervals()
    settings = SimpleNamespace(seconds_between_status_checks=10)
    executor: Any = SimpleNamespace(
        workflow=SimpleNamespace(remote_execution_settings=settings), next_seconds_between_status_checks=plugins_own
    )
    asyncio.run(RemoteExecutor.sleep(executor))
    assert found == [slept]
