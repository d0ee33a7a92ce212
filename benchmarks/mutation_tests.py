"""Do the tests notice a wrong line? Changes one line of the sources at a time and runs the tests until one fails.

    python benchmarks/mutation_tests.py WORK [--count 40] [--seed 1]

WORK gets a clone of this checkout's last commit with links to its sources (`make develop`), in which the lines are
changed, and ``mutations.jsonl``, a row per mutation: a run that was stopped goes on after the last one. At least two
mutations in each room and four in the kernels (two of the CPU's, two of CUDA's, which the harness runs).

A mutation meets first the unit tests and tests of parts that reach its file, the nearest by imports first; then the
rest of both; what survives meets the slow groups' tests that reach it. What survives these, too, may be equivalent.
Tests that compare the sources with a record (`stages/versions.toml`) do not count: they notice every change.
"""

from __future__ import annotations

import argparse
import ast
import json
import random
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from reach import Reach

ROOT = Path(__file__).resolve().parents[1]
ROOMS = (
    *("app", "edit", "engine", "film", "geometry", "mvs", "photos", "raster", "render", "sfm", "splat", "surface"),
    *("survey", "train", "web"),
)
PER_ROOM = 2
NATIVE = "pipeline/raster/native"
KERNELS = ((f"{NATIVE}/*.cpp", 2), (f"{NATIVE}/cuda/*.cu*", 2))
UNTESTABLE = ("bindings", "sbom", "options.py", "__init__.py")  # glue, defaults
TEXT_CHECKS = ("test_every_version_matches_the_present_sources", "test_every_name_imported")
TIMEOUT_S = 240  # of a test: a mutation may make a loop endless
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)
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


def make_clone(work: Path) -> Path:
    """Return a clone of the last commit with an environment of its own, linked to its sources."""
    clone = work / "clone"
    if not clone.exists():
        work.mkdir(parents=True, exist_ok=True)
        subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
    build(clone)
    subprocess.run(["make", "-s", ".venv/.browser"], cwd=clone, check=True)
    return clone


def build(clone: Path) -> bool:
    """Compile what changed and link the sources; return whether it compiled."""
    done = subprocess.run(["make", "-s", "develop", "SPLATPIPE_CUDA=off"], cwd=clone, capture_output=True, check=False)
    return done.returncode == 0


def run_tests(clone: Path, files: Sequence[str]) -> tuple[str, float]:
    """Run test files up to the first failure; return the test that failed, or "", and the seconds."""
    if not files:
        return "", 0.0
    begin = time.monotonic()
    workers = ["-n", "logical", "--maxprocesses", "8", "--dist", "loadfile", "--no-loadscope-reorder"]
    skipped = ["-k", " and ".join(f"not {name}" for name in TEXT_CHECKS)]
    limits = ["-o", f"timeout={TIMEOUT_S}", "-o", "timeout_method=thread"]
    command = [clone / ".venv/bin/python", "-m", "pytest", "-q", "-x", "-m", "not cuda", *workers, *skipped, *limits]
    done = subprocess.run([*command, *files], cwd=clone, capture_output=True, text=True, check=False)
    seconds = time.monotonic() - begin
    if done.returncode in (0, 5):
        return "", seconds
    failed = FAILED.search(done.stdout)
    return failed[1] if failed else f"pytest ended with {done.returncode}: {done.stdout[-200:]!r}", seconds


def search(mutation: Mutation, clone: Path, reach: Reach) -> Finding:
    """Apply a mutation, and look for a test that notices it."""
    finding = Finding(mutation)
    is_native = mutation.file.startswith(NATIVE)
    mutation.apply(clone)
    try:
        if is_native and not mutation.file.startswith(f"{NATIVE}/cuda"):
            begin = time.monotonic()
            if not build(clone):
                finding.ring = "not compiled"
                return finding
            finding.seconds["build"] = time.monotonic() - begin
        near = reach.rings(mutation.file)
        rest = [name for name in reach.all_rings() if name not in near]
        for part, ring, files in (
            ("near", "rings", near),
            ("rest", "rings", rest),
            ("slow", "slow", reach.slow(mutation.file)),
        ):
            finding.test, finding.seconds[part] = run_tests(clone, files)
            if finding.test:
                finding.ring = ring
                break
    finally:
        mutation.revert(clone)
        if is_native:
            build(clone)
    return finding


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
    clone = make_clone(given.work.resolve())
    mutations = choose(clone, given.count, given.seed)
    log = given.work / "mutations.jsonl"
    rows = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    reach = Reach(clone)
    for mutation in mutations[len(rows) :]:
        finding = search(mutation, clone, reach)
        rows.append(asdict(finding))
        with log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        _say(rows[-1])
    summarize(rows)


def _say(row: dict[str, object]) -> None:
    place = row["mutation"]
    assert isinstance(place, dict) and isinstance(row["seconds"], dict)
    seconds = ", ".join(f"{part} {value:.0f} s" for part, value in row["seconds"].items())
    print(f"{row['ring'] or 'SURVIVED':12} {place['file']}:{place['line']}  {seconds}  {row['test']}")
    print(f"  - {place['before'].strip()}\n  + {place['after'].strip()}")
    sys.stdout.flush()


def summarize(rows: Sequence[dict[str, object]]) -> None:
    """Print how many mutations each ring noticed."""
    counts = {ring: sum(row["ring"] == ring for row in rows) for ring in ("rings", "slow", "not compiled", "")}
    print(f"\n{len(rows)} mutations, noticed by the first two rings: {counts['rings']}, only by slow tests:")
    print(f"{counts['slow']}, by the compiler: {counts['not compiled']}, by nothing: {counts['']}")
    share = counts["rings"] / max(counts["rings"] + counts["slow"], 1)
    print(f"The first two rings notice {100.0 * share:.0f} % of what any test notices.")


if __name__ == "__main__":
    main()
