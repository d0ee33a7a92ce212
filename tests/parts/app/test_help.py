"""Each command's ``--help`` is complete and short, and shells complete commands, presets and stages."""

import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import typer
from command import splatpipe
from repository import ROOT

from splatpipe.pipeline.app.cli.help import PAGES
from splatpipe.pipeline.app.cli.main import app

EVERY = typer.main.get_command(app).commands  # type: ignore[attr-defined]
COMMANDS = {name: command for name, command in EVERY.items() if not command.hidden}  # without former names
SCREENS = 100  # lines: two screens of a terminal, 80 columns wide
SENTENCE = 160  # characters


@cache
def help_text(name: str) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "80")
        patch.setenv("TERMINAL_WIDTH", "80")
        return splatpipe(name, "--help").stdout


def test_every_command_has_a_page_of_help() -> None:
    assert set(PAGES) == set(COMMANDS)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_states_what_is_done_read_and_written_in_two_screens(name: str) -> None:
    sentence = COMMANDS[name].help.partition("\n\n")[0]
    assert sentence.endswith(".")
    assert len(sentence) <= SENTENCE
    text = help_text(name)
    words = " ".join(text.split())
    assert len(text.splitlines()) <= SCREENS
    assert " ".join(PAGES[name].about.replace("\\[", "[").split()) in words
    assert "See also: " in words


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_the_examples_in_help_are_valid_calls(name: str, tmp_path: Path) -> None:
    for example in PAGES[name].examples:
        first, *arguments = example.split()
        assert first == name
        COMMANDS[name].make_context(name, arguments)
        assert f"splatpipe {example}" in help_text(name)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_leads_to_a_page_that_names_the_command(name: str) -> None:
    pages = [ROOT / page for page in PAGES[name].see_also.split(", ")]
    assert all(page.is_file() for page in pages)


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home folder without completion, and a ``splatpipe`` in its ``bin``."""
    program = tmp_path / "bin" / "splatpipe"
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\nfrom splatpipe.pipeline.app.cli.main import main\nmain()\n")
    program.chmod(0o755)
    return tmp_path


def bash(home: Path, script: str) -> str:
    environment = {"HOME": str(home), "PATH": f"{home / 'bin'}:{os.environ['PATH']}"}
    environment |= {name: os.environ[name] for name in ("PYTHONPATH",) if name in os.environ}
    command = [str(shutil.which("bash")), "--norc", "-c", script]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=home)
    assert done.returncode == 0, done.stderr
    return done.stdout


# What bash does when Tab is pressed after a line of words: it calls the function that complete has for the program.
PRESS_TAB = """
source ~/.bashrc
read -r -a COMP_WORDS <<< "$LINE"
[ "${LINE: -1}" = " " ] && COMP_WORDS+=("")
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
COMP_LINE=$LINE COMP_POINT=${#LINE}
of_splatpipe=$(complete -p splatpipe | sed 's/.*-F \\([^ ]*\\).*/\\1/')
$of_splatpipe splatpipe "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


def test_bash_completes_commands_presets_and_stages_once_installed(home: Path) -> None:
    assert "installed" in bash(home, "splatpipe --install-completion; true")

    def completed(line: str) -> list[str]:
        return bash(home, f"LINE='{line}'\n{PRESS_TAB}").split()

    assert completed("splatpipe re") == ["render", "report"]
    assert completed("splatpipe run --pres") == ["--preset"]
    assert completed("splatpipe run --preset p") == ["preview"]
    assert completed("splatpipe run --until fe") == ["features"]
    assert completed("splatpipe stage splat") == ["splat_depths"]
