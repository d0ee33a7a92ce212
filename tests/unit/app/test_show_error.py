"""What a user is told is printed as it is."""

import pytest

from splatpipe.pipeline.app.terminal.console import show_error
from splatpipe.pipeline.engine.errors import SplatpipeError


def test_colons_in_names_and_commands_are_not_turned_into_pictures(capsys: pytest.CaptureFixture[str]) -> None:
    show_error(SplatpipeError("a:smile:b.jpg [red]is a film.", hint="ffmpeg -map 0:v:0"))
    printed = capsys.readouterr().err
    assert "a:smile:b.jpg [red]is a film." in printed and "ffmpeg -map 0:v:0" in printed
