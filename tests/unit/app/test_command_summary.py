"""Errors of other libraries become messages for the user."""

from splatpipe.pipeline.app.terminal.summary import for_the_user
from splatpipe.pipeline.engine.errors import MachineError


def test_names_that_the_environment_cannot_write_are_told_with_what_to_do() -> None:
    try:
        "run \udcc3\udcbc".encode()
    except UnicodeEncodeError as error:
        user_error = for_the_user(error)
    assert isinstance(user_error, MachineError)
    assert "letters that this environment cannot write" in user_error.message
    assert "LC_ALL=C.UTF-8" in user_error.hint
