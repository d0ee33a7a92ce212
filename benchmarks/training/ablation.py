"""Measure what each technique gains: ``ablation --data CAPTURE [CAPTURE …] --threads N --work DIR --json FILE``.

`splatpipe run` trains every variant (`ablation.toml`: a name, and options on top of the base) on every capture with
every seed, at the base's size, iterations and cap. Photos are registered once per capture. Finished runs are kept in
the work folder and not repeated: running the same command again resumes after an interruption.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from commands import Command, CommandEnd, benchmark, run_all, splatpipe
from comparison import MEASURES, differences, means, written
from finished import ResultLog, best_and_end, clear, figures, tidy, work_folder
from measure import SilentReporter, machine, write_figures
from tables import Row, print_table
from variants import NAME, Variant, base_of, choose, config_of, split

from splatpipe.pipeline.engine.digests import HashTable, digest
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.runs.job_runner import versions
from splatpipe.pipeline.engine.runs.source import open_source
from splatpipe.pipeline.raster.isa import isa_name
from splatpipe.stages.line import LINE

VARIANTS = Path(__file__).with_suffix(".toml")
FRONT_SIZE = 4.0  # photos are registered once at this multiple of the training size; each run downsamples them
MAX_FRONT_MEGAPIXELS = 200.0  # megapixels
CURVE = "curve.json"
RECORDED = ("psnr", "psnr_cc", "best_psnr")  # figures of a finished run, recorded along the way
AS_TRAINED = ("clean.enabled=false",)  # training is what is compared; a variant with cleaning sets this option
FRONT = ("ingest", "features", "matches", "sparse", "georef", "undistort")


@dataclass(frozen=True)
class AblationCase:
    """A training run to be measured.

    Attributes:
        variant: The variant's name.
        capture: The capture's name.
        seed: Seed of every random choice.
        key: Digest of everything that the figures depend on.
        command: The command that produces them.
        out: Folder that the command writes them to.
        followed: Whether the command is `time_to_quality`, which reports only the best and the final figures.
    """

    variant: str
    capture: str
    seed: int
    key: str
    command: Command
    out: Path
    followed: bool = False

    def named(self, figures: Row) -> Row:
        """Return a row of the result table."""
        return {"variant": self.variant, "capture": self.capture, "seed": self.seed} | figures

    def figures(self, end: CommandEnd, threads: int) -> Row:
        """Read the figures that the command wrote."""
        return best_and_end(self.out / CURVE) if self.followed else figures(self.out / "out", end, threads)


def base_sets(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the options that all variants share."""
    return (
        f"train.iterations={arguments.iterations}",
        f"train.max_gaussians={arguments.max_gaussians}",
        f"undistort.max_megapixels={arguments.megapixels!r}",
        "split.every=4",
        *base_of(arguments.variants),
        *split(arguments.base),
    )


def captures_of(texts: Sequence[str]) -> dict[str, Path]:
    """Map names to captures: PATH, named after its last folder, or NAME=PATH.

    Raises:
        UsageError: if two captures have the same name, or a name is invalid.
    """
    found: dict[str, Path] = {}
    for text in texts:
        name, equals, rest = text.partition("=")
        named = bool(equals) and not Path(text).exists()
        path = Path(rest if named else text)
        name = name if named else path.resolve().name
        if name in found or not NAME.fullmatch(name):
            raise UsageError(f'"{name}" cannot be the name of {path}, or is taken.', hint="Write --data NAME=PATH.")
        found[name] = path
    return found


def front_sets(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the base options for the photos: larger than the training size, since each run downsamples them."""
    size = min(MAX_FRONT_MEGAPIXELS, FRONT_SIZE * config_of(base_sets(arguments), 0).undistort.max_megapixels)
    return (*base_sets(arguments), f"undistort.max_megapixels={size!r}")


def placed(
    captures: Mapping[str, Path], work: Path, arguments: argparse.Namespace, sets: Sequence[str], *, photos_only: bool
) -> tuple[dict[str, Path], list[Row]]:
    """Run the captures through the pipeline up to `undistort`; return their datasets and the failures.

    Args:
        captures: Captures by name.
        work: The work folder.
        arguments: The parsed command line.
        sets: Options, as assignments.
        photos_only: Leave captures that already are datasets as they are.
    """
    sections = {stage: getattr(config_of(sets, 0), stage).model_dump(mode="json") for stage in FRONT}
    datasets, commands = dict(captures), []
    for name, path in captures.items():
        if photos_only and open_source(path, work).model is not None:
            continue
        key = digest([contents(path, work, arguments.threads), sections, versions()])
        datasets[name] = out = work / "fronts" / f"{name}-{key[:12]}"
        words = ("run", str(path), str(out), "--until", FRONT[-1], "--seed", "0", *options(sets))
        threads = ("--threads", str(arguments.threads * arguments.jobs))
        commands.append(splatpipe(name, (*words, *threads), out.with_name(f"{out.name}.log")))
    failures = []
    with closing(run_all(commands, 1)) as ends:
        for end in ends:
            print_progress(f"{end.command.name}: {end.failure or 'dataset made'}, {end.wall_s:.0f} s")
            front = datasets.pop(end.command.name)
            if end.failure:
                failures.append({"capture": end.command.name, "message": end.failure})
            else:
                (datasets[end.command.name],) = (front / "stages").glob("undistort-*/dataset")
    return {name: datasets[name] for name in captures if name in datasets}, failures


def contents(path: Path, work: Path, threads: int) -> dict[str, str]:
    """Return digests of a capture's files, cached in the work folder."""
    table = HashTable(work / "photos-index.json", remember=True)
    return open_source(path, work, LINE, config_of((), 0)).digests(table, threads, SilentReporter())


def options(sets: Sequence[str]) -> tuple[str, ...]:
    """Return the assignments as command-line arguments."""
    return tuple(word for each in sets for word in ("--set", each))


def cases_of(
    variants: Sequence[Variant],
    datasets: Mapping[str, Path],
    reduced: Mapping[str, Path],
    work: Path,
    arguments: argparse.Namespace,
) -> list[AblationCase]:
    """Return every variant on every capture with every seed; all runs of one seed come before the next seed.

    Args:
        variants: The base and the others.
        datasets: Input of the pipeline, by capture.
        reduced: The same at the training size, as each run produces them, for the captures that are followed.
        work: The work folder.
        arguments: The parsed command line.
    """
    stages = {stage.name: stage.version for stage in LINE}
    build = {"stages": stages, "versions": versions(), "isa": isa_name()}
    digests = {name: contents(path, work, arguments.threads) for name, path in datasets.items()}
    cases = []
    for seed in range(arguments.seeds):
        for capture, dataset in datasets.items():
            for variant in variants:
                sets = (*AS_TRAINED, *base_sets(arguments), *variant.sets)
                config = config_of(sets, seed).model_dump(mode="json")
                facts = {"capture": digests[capture], "config": config, "seed": seed, "threads": arguments.threads}
                key = digest(build | facts)
                name = f"{capture}-{variant.name}-{seed}-{key[:12]}"
                out = work / "runs" / name
                words = ("run", str(dataset), str(out / "out"), "--seed", str(seed), *options(sets))
                command = splatpipe(name, (*words, "--threads", str(arguments.threads)), out / "log")
                cases.append(AblationCase(variant.name, capture, seed, key, command, out))
                if capture in reduced:
                    cases.append(followed(cases[-1], sets, reduced[capture], arguments))
    return cases


def followed(case: AblationCase, sets: Sequence[str], dataset: Path, arguments: argparse.Namespace) -> AblationCase:
    """Return the same training again, bit-identical, with its held-out views measured along the way."""
    name = f"{case.command.name}-curve"
    out = case.out.with_name(name)
    config = config_of(sets, case.seed)
    facts = {"data": dataset, "threads": arguments.threads, "every": arguments.curve, "seed": case.seed}
    facts |= {"json": out / CURVE, "iterations": config.train.iterations}
    facts |= {"max-gaussians": config.train.max_gaussians}
    words = [word for key, value in facts.items() for word in (f"--{key}", str(value))]
    words += ["--held-out", config.split.views, "--set", *sets]
    command = Command(name, benchmark("time_to_quality", *words), out / "log")
    key = digest([case.key, arguments.curve])
    return AblationCase(case.variant, case.capture, case.seed, key, command, out, followed=True)


def run_cases(cases: Sequence[AblationCase], finished: ResultLog, arguments: argparse.Namespace) -> dict[str, str]:
    """Run whatever is not finished, and store its figures.

    Returns:
        Error messages of the failed runs, by key.
    """
    wanted = {case.key: case for case in cases if case.key not in finished.rows}
    by_name = {case.command.name: case for case in wanted.values()}
    for case in wanted.values():
        clear(case.out)
    leave = (lambda _out: None) if arguments.keep else tidy
    failures: dict[str, str] = {}
    walls: list[float] = []
    try:
        with closing(run_all([case.command for case in wanted.values()], arguments.jobs)) as ends:
            for end in ends:
                case = by_name[end.command.name]
                if end.failure:
                    failures[case.key] = outcome = end.failure
                else:
                    row = case.figures(end, arguments.threads)
                    finished.add(case.key, row)
                    outcome = ", ".join(f"{key} {row[key]:.2f} dB" for key in RECORDED if row.get(key) is not None)
                leave(case.out)
                walls.append(end.wall_s)
                left = sum(walls) / len(walls) * (len(wanted) - len(walls)) / arguments.jobs
                what = f"{case.capture} {case.variant} seed {case.seed}: {outcome or 'done'}"
                print_progress(
                    f"{len(walls)}/{len(wanted)}  {what}, {end.wall_s:.0f} s; about {left / 60.0:.0f} min left"
                )
    finally:
        for case in wanted.values():
            leave(case.out)
    return failures


def show(rows: Sequence[Row], failed: Sequence[Row], variants: Sequence[str]) -> list[Row]:
    """Print a table per capture and the differences; return the differences."""
    followed = any("below_best" in row for row in rows)
    headings = {heading: f"{heading}:" for heading, (key, _) in MEASURES.items() if followed or key != "below_best"}
    for capture in dict.fromkeys(row["capture"] for row in (*rows, *failed)):
        table = means([row for row in rows if row["capture"] == capture], variants)
        columns = {"variant": "variant:", "runs": "runs:"} | headings
        messages = [row for row in failed if row["capture"] == capture]
        if messages:
            columns["failed"] = "failed:"
        for line in table:
            mine = [row["message"] for row in messages if row["variant"] in (line["variant"], None)]
            line["failed"] = f"{len(mine)}: {mine[0]}" if mine else None
        print_table(f"{capture}: mean over the seeds ± half of the range", table, columns)
    found = differences(rows, variants[1:])
    if found:
        title = "difference to base, mean over the captures ± standard error over the pairs"
        print_table(title, written(found), {"variant": "variant:", "pairs": "pairs:"} | headings)
    return found


def ablate(arguments: argparse.Namespace) -> int:
    """Run the whole ablation; return the exit code: 1 if a run failed."""
    variants = choose(arguments.variants, arguments.variant, arguments.only, base_sets(arguments))
    captures = captures_of(arguments.data)
    with work_folder(arguments.work) as work:
        print_progress(f"What is finished is kept in {work}")
        facts = machine(arguments.threads) | {"jobs": arguments.jobs, "seeds": arguments.seeds}
        datasets, lost = placed(captures, work, arguments, front_sets(arguments), photos_only=True)
        reduced: dict[str, Path] = {}
        if arguments.curve is not None:
            reduced, lost_here = placed(datasets, work, arguments, base_sets(arguments), photos_only=False)
            lost += lost_here
        finished = ResultLog(work)
        cases = cases_of(variants, datasets, reduced, work, arguments)
        failures = run_cases(cases, finished, arguments)
        rows = rows_of(cases, finished.rows)
    failed = [{"variant": None, "seed": None} | row for row in lost]
    failed += [case.named({"message": failures[case.key]}) for case in cases if case.key in failures]
    names = [variant.name for variant in variants]
    facts["differences"] = show(rows, failed, names)
    facts |= {"failed": failed, "base": base_sets(arguments)}
    facts["variants"] = [{"variant": each.name, "set": each.sets, "what": each.what} for each in variants]
    write_figures("ablation", facts, rows, arguments.json)
    if arguments.work is None and not failed:
        shutil.rmtree(work)
    return 1 if failed else 0


def rows_of(cases: Sequence[AblationCase], finished: Mapping[str, Row]) -> list[Row]:
    """Return a row per training, with the results of following it."""
    curves = {(case.variant, case.capture, case.seed): finished.get(case.key, {}) for case in cases if case.followed}
    return [
        case.named(finished[case.key] | curves.get((case.variant, case.capture, case.seed), {}))
        for case in cases
        if not case.followed and case.key in finished
    ]


def print_progress(text: str) -> None:
    """Print progress."""
    print(text, file=sys.stderr, flush=True)


def parser() -> argparse.ArgumentParser:
    """Build the command-line parser."""
    options = argparse.ArgumentParser(description=__doc__)
    say = options.add_argument
    say("--data", nargs="+", required=True, metavar="[NAME=]PATH", help="photos, or images/ and sparse/0, undistorted")
    say("--threads", type=positive, default=1, help="of each run")
    say("--jobs", type=positive, default=2, help="runs at once")
    say("--json", type=Path, help="where the figures go")
    say("--work", type=Path, help="folder that keeps what is finished; else a temporary one")
    say("--seeds", type=positive, default=3, help="how many, from 0")
    say("--iterations", type=positive, default=2000)
    say("--max-gaussians", type=positive, default=50_000)
    say("--megapixels", type=float, default=0.2, help="of the training")
    say("--base", default="", metavar="'SECTION.OPTION=VALUE …'", help="options that all variants have")
    say("--variants", type=Path, default=VARIANTS, metavar="FILE.toml", help="instead of the ones beside this script")
    say("--variant", action="append", default=[], metavar="NAME='SECTION.OPTION=VALUE …'", help="one more; repeatable")
    say("--only", nargs="+", metavar="NAME", help="these variants besides the base")
    say("--curve", type=float, metavar="CPU_S", help="train once more, measured so often: is the end the best?")
    say("--keep", action="store_true", help="keep all that the runs leave, and not just their metrics.json and log")
    return options


def positive(text: str) -> int:
    """Parse an integer of at least 1."""
    if (value := int(text)) < 1:
        raise ValueError(text)
    return value


def main(words: Sequence[str] | None = None) -> int:
    options = parser()
    try:
        return ablate(options.parse_args(words))
    except UsageError as error:
        options.error(f"{error.message} {error.hint}")
    except SplatpipeError as error:
        print_progress(f"{error.message} {error.hint}")
        return error.exit_code
    except KeyboardInterrupt:
        print_progress("Stopped. The same command with --work and that folder goes on.")
        return 130


if __name__ == "__main__":
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # respect nohup
            signal.signal(number, signal.default_int_handler)
    sys.exit(main())
