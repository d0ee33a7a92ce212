"""Do the tests notice a wrong line? Changes one line of the sources at a time and runs the tests until one fails.

    python benchmarks mutation_tests WORK [--count 40] [--seed 1]

WORK gets a clone of this checkout's last commit, in which the lines are changed, and ``mutations.jsonl``: a run that
was stopped goes on where it was. At least two mutations in each room and four in the kernels (two of the CPU's, two of
CUDA's, which the harness runs).

1. Each mutation meets the unit tests and tests of parts that reach its file by imports, the nearest first, up to the
   first failure; those farther away, and those that wait for a run of the demo, only in the next step.
2. Those not noticed so far are applied together, and both rings run whole. Each test that fails runs again on each of
   the mutations alone; those noticed are taken out, until both rings pass.
3. The same with the slow tests. What survives these, too, may be equivalent.

Tests that compare the sources with a record (`stages/versions.toml`) do not count: they notice every change.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from reach import Reach

ROOT = Path(__file__).resolve().parents[2]
ROOMS = (
    *("app", "edit", "engine", "film", "geometry", "mvs", "photos", "raster", "render", "sfm", "splat", "surface"),
    *("survey", "train", "web"),
)
PER_ROOM = 2
NATIVE = "pipeline/native"
KERNELS = ((f"{NATIVE}/*/*.cpp", 2), (f"{NATIVE}/cuda/*.cu*", 2))
UNTESTABLE = ("bind_", "sbom", "options.py", "__init__.py")  # glue, defaults
TEXT_CHECKS = ("test_every_version_matches_the_present_sources", "test_every_name_imported")
NEAREST = 6  # test files that a mutation meets alone
TIMEOUT_S = 300  # time limit of a test: a mutation may make a loop endless
NO_TESTS = 5  # pytest's exit code
FIRST = ("-x", "--max-worker-restart", "0")  # an endless loop ends its worker, and that is a failure, too
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)  # parameters may have blanks
COMPARED = {ast.Lt: ">=", ast.GtE: "<", ast.Gt: "<=", ast.LtE: ">", ast.Eq: "!=", ast.NotEq: "=="}
COMPUTED = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}
SIGNS = {ast.Lt: "<", ast.GtE: ">=", ast.Gt: ">", ast.LtE: "<=", ast.Eq: "==", ast.NotEq: "!="}
SIGNS |= {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}  # type: ignore[dict-item]
CPP_SIGNS = {
    "+": "-",
    "-": "+",
    "*": "/",
    "<": ">=",
    ">": "<=",
    "<=": ">",
    ">=": "<",
    "==": "!=",
    "&&": "||",
    "||": "&&",
}
CPP_SIGN = re.compile(r"(?<= )(\+|-|\*|<=|>=|<|>|==|&&|\|\|)(?= )")
CPP_SKIPPED = re.compile(r"^\s*(//|#|\*|/\*|template|using|namespace|static_assert|case )|<<|operator")


@dataclass(frozen=True)
class Mutation:
    """A changed line.

    Attributes:
        file: Path relative to the root.
        line: Number of the line, from 1.
        before: The line as it was.
        after: The line as it is tested.
    """

    file: str
    line: int
    before: str
    after: str

    def apply(self, root: Path) -> None:
        """Change the line in a checkout."""
        self._replace(root, self.before, self.after)

    def revert(self, root: Path) -> None:
        """Change it back."""
        self._replace(root, self.after, self.before)

    def _replace(self, root: Path, old: str, new: str) -> None:
        path = root / self.file
        lines = path.read_text(encoding="utf-8").split("\n")
        assert lines[self.line - 1] == old, f"{self.file}:{self.line} is not what it was"
        lines[self.line - 1] = new
        path.write_text("\n".join(lines), encoding="utf-8")


@dataclass
class Finding:
    """What noticed a mutation.

    Attributes:
        mutation: The changed line.
        ring: "rings", "slow", or "" for nothing; "not compiled" for one that the compiler noticed.
        test: The first test that failed.
        seconds: Wall time of each part of the search.
    """

    mutation: Mutation
    ring: str = ""
    test: str = ""
    seconds: dict[str, float] = field(default_factory=dict)


def python_mutations(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line number, changed line) for the operators and calls inside the functions of a module."""
    lines = text.split("\n")
    for function in (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)):
        for statement in function.body:
            for node in ast.walk(statement):
                if isinstance(node, ast.FunctionDef | ast.Lambda | ast.Raise):
                    continue
                change = _python_change(node, lines)
                if change is not None:
                    yield change


def _python_change(node: ast.AST, lines: Sequence[str]) -> tuple[int, str] | None:
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in COMPARED:
        return _swap(node.left, node.comparators[0], SIGNS[type(node.ops[0])], COMPARED[type(node.ops[0])], lines)
    if isinstance(node, ast.BinOp) and type(node.op) in COMPUTED and not _is_text(node):
        return _swap(node.left, node.right, SIGNS[type(node.op)], COMPUTED[type(node.op)], lines)
    if isinstance(node, ast.BoolOp):
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        return _swap(node.values[0], node.values[1], old, new, lines)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not) and node.lineno == node.operand.lineno:
        line = lines[node.lineno - 1]
        return node.lineno, line[: node.col_offset] + line[node.operand.col_offset :]
    if isinstance(node, ast.AugAssign | ast.Expr) and node.lineno == node.end_lineno:
        is_call = isinstance(node, ast.AugAssign) or isinstance(node.value, ast.Call)
        line = lines[node.lineno - 1]
        return (
            (node.lineno, line[: node.col_offset] + "pass") if is_call and line.strip() == ast.unparse(node) else None
        )
    return None


def _is_text(node: ast.BinOp) -> bool:
    return any(
        isinstance(side, ast.Constant | ast.JoinedStr) and not _is_number(side) for side in (node.left, node.right)
    )


def _is_number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float)


def _swap(left: ast.expr, right: ast.expr, old: str, new: str, lines: Sequence[str]) -> tuple[int, str] | None:
    """Return the line with the operator between two operands of one line exchanged."""
    if left.end_lineno != right.lineno or left.end_col_offset is None:
        return None
    line = lines[right.lineno - 1].encode()
    between = line[left.end_col_offset : right.col_offset].decode()
    if between.count(old) != 1:
        return None
    changed = line[: left.end_col_offset] + between.replace(old, new).encode() + line[right.col_offset :]
    return right.lineno, changed.decode()


def cpp_mutations(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line number, changed line) for the operators with blanks around them in C++ or CUDA code."""
    for number, line in enumerate(text.split("\n"), start=1):
        code = line.split("//")[0]
        if CPP_SKIPPED.search(line):
            continue
        for sign in CPP_SIGN.finditer(code):
            yield number, line[: sign.start()] + CPP_SIGNS[sign[0]] + line[sign.end() :]


def candidates(root: Path, pattern: str) -> list[Mutation]:
    """Return all mutations of the files that match a pattern."""
    found = []
    for path in sorted(root.glob(pattern)):
        if path.suffix not in (".py", ".cpp", ".cu", ".cuh") or path.name.startswith(UNTESTABLE):
            continue
        text = path.read_text(encoding="utf-8")
        lines = text.split("\n")
        changes = python_mutations(text) if path.suffix == ".py" else cpp_mutations(text)
        name = str(path.relative_to(root))
        found += [Mutation(name, number, lines[number - 1], after) for number, after in changes]
    return sorted(set(found), key=lambda each: (each.file, each.line, each.after))


def choose(root: Path, count: int, seed: int) -> list[Mutation]:
    """Return the mutations of a seed: the required ones of rooms and kernels, then any others; files differ."""
    rng = random.Random(seed)
    chosen: list[Mutation] = []

    def draw(pattern: str, number: int) -> None:
        pool = [each for each in candidates(root, pattern) if each.file not in {one.file for one in chosen}]
        for _ in range(number):
            pool = [each for each in pool if each.file not in {one.file for one in chosen}]
            files = sorted({each.file for each in pool})
            file = rng.choice(files)
            chosen.append(rng.choice([each for each in pool if each.file == file]))

    for room in ROOMS:
        draw(f"pipeline/{room}/**/*.py", PER_ROOM)
    draw("stages/*.py", PER_ROOM)
    for pattern, number in KERNELS:
        draw(pattern, number)
    draw("pipeline/**/*.py", count - len(chosen))
    return chosen


@dataclass(frozen=True)
class Workshop:
    """A clone whose sources are imported instead of the installed ones.

    Attributes:
        folder: Holds the clone, its kernels and the log.
    """

    folder: Path

    @property
    def clone(self) -> Path:
        """The checkout in which lines are changed."""
        return self.folder / "clone"

    @property
    def environment(self) -> dict[str, str]:
        """Variables with which Python imports the clone's ``splatpipe``."""
        return {**os.environ, "PYTHONPATH": str(self.folder / "path"), "PYTHONDONTWRITEBYTECODE": "1"}

    def prepare(self) -> None:
        """Clone the last commit, once, with the installed kernels and pages."""
        if self.clone.exists():
            return
        links = self.folder / "path" / "splatpipe"
        links.mkdir(parents=True)
        subprocess.run(["git", "clone", "-q", str(ROOT), str(self.clone)], check=True)
        for name in ("pipeline", "stages", "configs", "demo"):
            (links / name).symlink_to(self.clone / name)
        (links / "__init__.py").symlink_to(self.clone / "pipeline/door/__init__.py")
        found = importlib.util.find_spec("splatpipe.pipeline")
        assert found is not None and found.origin is not None
        installed = Path(found.origin).resolve().parent
        for library in (installed / "native").glob("*.so"):
            shutil.copy2(library, self.clone / NATIVE)
        shutil.copytree(installed / "web" / "dist", self.clone / "pipeline" / "web" / "dist")
        self.build()

    def build(self) -> bool:
        """Compile the CPU's kernels where they changed; return whether they compiled."""
        programs, work = Path(sys.prefix) / "bin", self.folder / "kernels"
        if not (work / "build.ninja").exists():
            nanobind = subprocess.check_output([sys.executable, "-m", "nanobind", "--cmake_dir"], text=True).strip()
            defines = {"CMAKE_BUILD_TYPE": "Release", "CMAKE_MAKE_PROGRAM": programs / "ninja"}
            defines |= {"Python_EXECUTABLE": sys.executable, "nanobind_DIR": nanobind}
            made = [programs / "cmake", "-S", self.clone / NATIVE, "-B", work, "-G", "Ninja"]
            subprocess.run([*made, *(f"-D{name}={value}" for name, value in defines.items())], check=True)
        done = subprocess.run([programs / "ninja", "-C", work, "_native"], capture_output=True, check=False)
        for library in work.glob("_native*.so"):
            target = self.clone / NATIVE / library.name
            target.unlink(missing_ok=True)  # not overwritten: a running program may have it mapped
            shutil.copy2(library, target)
        return done.returncode == 0

    def change(self, mutations: Sequence[Mutation]) -> bool:
        """Apply mutations; return whether the kernels compiled."""
        for mutation in mutations:
            mutation.apply(self.clone)
        return self._built(mutations)

    def restore(self, mutations: Sequence[Mutation]) -> None:
        """Take mutations back."""
        for mutation in reversed(mutations):
            mutation.revert(self.clone)
        self._built(mutations)

    def _built(self, mutations: Sequence[Mutation]) -> bool:
        compiled = [each for each in mutations if each.file.startswith(NATIVE) and "/cuda/" not in each.file]
        return self.build() if compiled else True

    def failures(self, tests: Sequence[str], first: bool) -> list[str]:
        """Run test files or single tests; return those that failed: only the first, or all."""
        if not tests:
            return []
        workers = ["-n", "logical", "--maxprocesses", "8", "--dist", "loadfile", "--no-loadscope-reorder"]
        skipped = ["-m", "not cuda", "-k", " and ".join(f"not {name}" for name in TEXT_CHECKS)]
        limits = ["-o", f"timeout={TIMEOUT_S}", "-o", "timeout_method=thread", *(FIRST if first else [])]
        command = [sys.executable, "-m", "pytest", "-q", *workers, *skipped, *limits, *tests]
        done = subprocess.run(
            command, cwd=self.clone, env=self.environment, capture_output=True, text=True, check=False
        )
        if done.returncode == NO_TESTS and any("::" in name for name in tests):
            raise SystemExit(f"pytest does not find one of {tests}")  # its workers only say that no tests ran
        if done.returncode in (0, NO_TESTS):
            return []
        return FAILED.findall(done.stdout) or [f"pytest ended with {done.returncode}: {done.stdout[-300:]}"]


def meet_nearest(workshop: Workshop, reach: Reach, mutation: Mutation) -> Finding:
    """Run the nearest test files on a mutation, up to the first failure."""
    finding, begin = Finding(mutation), time.monotonic()
    compiled = workshop.change([mutation])
    try:
        if not compiled:
            finding.ring = "not compiled"
            return finding
        nearest = [name for name in reach.rings(mutation.file) if not reach.waits_for_demo(name)][:NEAREST]
        failed = workshop.failures(nearest, first=True)
        if failed:
            finding.ring, finding.test = "rings", failed[0]
    finally:
        workshop.restore([mutation])
        finding.seconds["nearest"] = time.monotonic() - begin
    return finding


def _failures_of(workshop: Workshop, findings: Sequence[Finding], tests: Sequence[str], *, first: bool) -> list[str]:
    """The failures of tests on mutations, which are taken back whatever happens."""
    mutations = [each.mutation for each in findings]
    workshop.change(mutations)
    try:
        return workshop.failures(tests, first=first)
    finally:
        workshop.restore(mutations)


def meet_all(workshop: Workshop, findings: Sequence[Finding], tests: Sequence[str], ring: str) -> None:
    """Run tests on all mutations that were not noticed, together, and tell which of these each failure notices."""
    begin = time.monotonic()
    while left := [each for each in findings if not each.ring]:
        failed = _failures_of(workshop, left, tests, first=False)
        if not failed:
            break
        print(f"{len(left)} together: {len(failed)} failures, such as {failed[0]}", flush=True)
        for finding in left:
            alone = _failures_of(workshop, [finding], failed, first=True)
            if alone:
                finding.ring, finding.test = ring, alone[0]
        assert any(each.ring for each in left), f"only together: {failed}"
        tests = failed  # what they hid shows when they run again
    for finding in findings:
        if finding.ring in ("", ring):
            finding.seconds[ring] = (time.monotonic() - begin) / max(len(findings), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--list", action="store_true", help="Print the mutations without testing them.")
    given = parser.parse_args()
    if given.list:
        for each in choose(ROOT, given.count, given.seed):
            print(f"{each.file}:{each.line}\n  - {each.before.strip()}\n  + {each.after.strip()}")
        return
    workshop = Workshop(given.work.resolve())
    workshop.prepare()
    mutations = choose(workshop.clone, given.count, given.seed)
    reach = Reach(workshop.clone)
    log = Log(given.work / "mutations.jsonl")
    findings = log.read()
    for mutation in mutations[len(findings) :]:
        findings.append(meet_nearest(workshop, reach, mutation))
        log.write(findings)
        _say(findings[-1])
    for ring, tests in (("rings", reach.all_rings()), ("slow", reach.all_slow())):
        left = [each for each in findings if not each.ring]
        meet_all(workshop, left, tests, ring)
        log.write(findings)
        for each in left:
            _say(each)
    summarize(findings)


@dataclass(frozen=True)
class Log:
    """The findings so far, a row per mutation."""

    path: Path

    def read(self) -> list[Finding]:
        """Return the findings of an earlier call."""
        rows = [json.loads(line) for line in self.path.read_text().splitlines()] if self.path.exists() else []
        return [Finding(Mutation(**row.pop("mutation")), **row) for row in rows]

    def write(self, findings: Sequence[Finding]) -> None:
        """Write all findings."""
        beside = self.path.with_suffix(".new")
        beside.write_text("".join(json.dumps(asdict(each)) + "\n" for each in findings))
        beside.replace(self.path)


def _say(finding: Finding) -> None:
    place = finding.mutation
    seconds = ", ".join(f"{part} {value:.0f} s" for part, value in finding.seconds.items())
    print(f"{finding.ring or 'not noticed':12} {place.file}:{place.line}  {seconds}  {finding.test}")
    print(f"  - {place.before.strip()}\n  + {place.after.strip()}", flush=True)


def summarize(findings: Sequence[Finding]) -> None:
    """Print how many mutations each ring noticed."""
    counts = {ring: sum(each.ring == ring for each in findings) for ring in ("rings", "slow", "not compiled", "")}
    print(f"\n{len(findings)} mutations, noticed by the first two rings: {counts['rings']}, only by slow tests:")
    print(f"{counts['slow']}, by the compiler: {counts['not compiled']}, by nothing: {counts['']}")
    share = counts["rings"] / max(counts["rings"] + counts["slow"], 1)
    print(f"The first two rings notice {100.0 * share:.0f} % of what any test notices.")


if __name__ == "__main__":
    main()
