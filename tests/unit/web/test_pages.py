"""The pages' bundled scripts, in a real browser."""

import pytest

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.web import asset


def test_a_script_that_was_not_built_is_reported_with_what_to_do() -> None:
    with pytest.raises(MachineError, match=r"lacks nothing\.js"):
        asset("nothing.js")
    assert "--accent" in asset("page.css")
