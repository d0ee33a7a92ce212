"""Give splatpipe what people in the field bring, and print what it says: ``field_inputs WORK [NAME …]``.

Photos, tables, splats, COLMAP folders, films (with ffmpeg) and whole folders, made from the demo capture after public
reports. Required: each ends as it should and says so in the words that matter; none is destroyed or misplaced in
silence. docs/measurements/inputs.md has the results.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

from field_case import FieldInput
from field_table import table_row
from film_inputs import FILM_INPUTS
from folder_inputs import FOLDER_INPUTS
from model_inputs import MODEL_INPUTS
from photo_inputs import PHOTO_INPUTS
from splat_inputs import SPLAT_INPUTS
from table_inputs import TABLE_INPUTS

FIELD_INPUTS = PHOTO_INPUTS + TABLE_INPUTS + SPLAT_INPUTS + MODEL_INPUTS + FILM_INPUTS + FOLDER_INPUTS
LIMIT_S = 600.0


def try_input(case: FieldInput, folder: Path) -> tuple[str, list[str]]:
    """Make an input, run its commands, print what they print; return its row of the table, and what is wrong."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    case.make(folder)
    printed, ended, answers = "", 0, []
    for command in case.commands:
        start = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", *shlex.split(command)],
            check=False,
            cwd=folder, capture_output=True, text=True, errors="replace", timeout=LIMIT_S, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        ended = done.returncode
        text = done.stderr + done.stdout
        print(f"$ splatpipe {command}\n{text.rstrip()}\n-> {ended}, {time.monotonic() - start:.0f} s", flush=True)
        printed += text
        answers.append((command, text, ended))
    words = " ".join(printed.replace("│", " ").split())
    faults = [f"ended with {ended}, not {case.ends}"] if ended != case.ends else []
    faults += [f"does not say: {wanted}" for wanted in case.says if wanted not in words]
    faults += [f"says: {unwanted}" for unwanted in case.silent_on if unwanted in words]
    return table_row(case, answers, faults), faults


def main() -> None:
    """Run the inputs of these names, or all; print a table at the end, as docs/measurements/inputs.md has it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="a folder for the inputs")
    parser.add_argument("names", nargs="*", help="names of inputs; all without")
    options = parser.parse_args()
    rows, faulty = [], False
    for case in FIELD_INPUTS:
        if not options.names or case.name in options.names:
            print(f"\n=== {case.name}: {(case.make.__doc__ or '').strip()}")
            row, faults = try_input(case, options.work.resolve() / case.name)
            rows.append(row)
            faulty |= bool(faults)
    print("\n| input | it printed | |\n|---|---|---|", *rows, sep="\n")
    sys.exit(faulty)


if __name__ == "__main__":
    main()
