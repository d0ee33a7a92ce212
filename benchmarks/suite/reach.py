"""Which test files reach a source file, by imports: the nearest first."""

from __future__ import annotations

import ast
from collections import deque
from functools import cache
from pathlib import Path

RINGS = ("tests/unit", "tests/parts")
SLOW = "tests/slow"
ELSEWHERE = ("tests/slow/captures", "tests/slow/device")
PLAIN = ("tests", "tests/scenes", "tests/harness", "tests/lines", "tests/records")  # besides the benchmarks' folders
NATIVE = "pipeline/native"
HARNESS = ("tests/harness/building.py", "tests/harness/on_cpu.py")  # a test that imports these runs CUDA's sources
RUNS_ALL = ("demo_run", "demo_copy", "splatpipe.pipeline.app.cli.main", "from command import")
WHOLE_LINE = "stages/line.py"  # what starts the command, or reads its finished run, runs all stages


class Reach:
    """The imports of a checkout's tests and sources.

    Args:
        root: The checkout.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._plain = (*PLAIN, *sorted(str(path.relative_to(root)) for path in root.glob("benchmarks/*/")))
        self._distances = {
            str(path.relative_to(root)): self._walk(path) for path in sorted(root.glob("tests/**/test_*.py"))
        }

    def all_rings(self) -> list[str]:
        """Return the files of the first two rings."""
        return [name for name in self._distances if name.startswith(RINGS)]

    def rings(self, source: str) -> list[str]:
        """Return the files of the first two rings that reach a source, the nearest first."""
        return [name for name in self._near(source) if name.startswith(RINGS)]

    def all_slow(self) -> list[str]:
        """Return the files of the slow groups that need neither real photos nor a CUDA device."""
        return [name for name in self._distances if name.startswith(SLOW) and not name.startswith(ELSEWHERE)]

    def waits_for_demo(self, name: str) -> bool:
        """Whether a test file uses the finished run of the demo, which takes minutes to make."""
        text = (self._root / name).read_text(encoding="utf-8")
        return "demo_run" in text or "demo_copy" in text

    def _near(self, source: str) -> list[str]:
        targets = self._targets(source)
        found = {}
        for name, distances in self._distances.items():
            steps = [distances[target] for target in targets if target in distances]
            if steps:
                found[name] = min(steps)
        return sorted(found, key=lambda name: (found[name], name))

    def _targets(self, source: str) -> set[str]:
        """Return the files whose import means that a source is run."""
        if source.startswith(f"{NATIVE}/cuda"):
            return set(HARNESS)
        if source.startswith(NATIVE):
            return {f"{NATIVE}/_native.pyi"}
        return {source}

    def _walk(self, test: Path) -> dict[str, int]:
        """Return the steps from a test to every file that it imports, directly or not."""
        first = str(test.relative_to(self._root))
        found, pending = {first: 0}, deque([first])
        while pending:
            name = pending.popleft()
            for other in self._imports(name):
                if other not in found:
                    found[other] = found[name] + 1
                    pending.append(other)
        return found

    @cache  # noqa: B019
    def _imports(self, name: str) -> tuple[str, ...]:
        path = self._root / name
        if path.suffix != ".py":
            return ()
        text = path.read_text(encoding="utf-8")
        found: set[str] = set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                base = self._base(name, node)
                found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("splatpipe."):
                found.add(node.value.partition(":")[0])
        files = {file for module in found if (file := self._file(module))}
        if name.startswith("tests/") and (any(word in text for word in RUNS_ALL)):
            files.add(WHOLE_LINE)
        return tuple(sorted(files))

    @staticmethod
    def _base(name: str, node: ast.ImportFrom) -> str:
        if not node.level:
            return node.module or ""
        above = ["splatpipe", *Path(name).parent.parts]
        return ".".join([*above[: len(above) - node.level + 1], *filter(None, [node.module])])

    def _file(self, module: str) -> str:
        parts = module.split(".")
        stems = (
            [Path(*parts[1:])]
            if parts[0] == "splatpipe" and len(parts) > 1
            else [Path(each, *parts) for each in self._plain]
        )
        for stem in stems:
            for path in (stem.with_name(f"{stem.name}.py"), stem.with_name(f"{stem.name}.pyi"), stem / "__init__.py"):
                if (self._root / path).is_file():
                    return str(path)
        return ""
