"""A stopped batch."""

from pathlib import Path

import pytest
from batch_captures import call_of, planned

from splatpipe.pipeline.app.batch.driver import STOPPED_NOTICE_S, Driver, Notifications
from splatpipe.pipeline.app.batch.jobs.snakemake_process import open_profile
from splatpipe.pipeline.engine.errors import EXIT_TERMINATED, StopSignal


def test_a_stopped_batch_notifies_only_of_itself_and_waits_for_no_notice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Docker kills ten seconds after SIGTERM, and the jobs may have taken eight of them."""
    call = call_of(tmp_path, planned("house", "train"), planned("barn", "train"))
    said: list[str] = []
    hangs = "echo $SPLATPIPE_STATE,$SPLATPIPE_CAPTURE >> notice; sleep 99"
    driver = Driver(call, open_profile(None), Notifications(said.append, hangs))

    def stop(_lock: int) -> None:
        raise StopSignal(EXIT_TERMINATED)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(driver, "_work", stop)
    with pytest.raises(StopSignal):
        driver.run(0)
    assert (tmp_path / "notice").read_text() == f"stopped,{tmp_path.name}\n"
    assert [line for line in said if "--notify" in line] == [
        f"The --notify command did not end within {STOPPED_NOTICE_S:.0f} s and was killed."
    ]
