"""``make versions``: updates ``stages/versions.toml``, and demands raised versions where they are needed."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from record import LINE_FILE, RECORD_FILE, differing, present, recorded, write
from stage_comparison import Comparison, Verdict

ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    """Run the command; return the exit code: 0 if the record is right now."""
    parser = argparse.ArgumentParser(prog="make versions", description=__doc__)
    parser.add_argument("--since", metavar="COMMIT", help="compare with this commit instead of the last right one")
    parser.add_argument("--record", action="store_true", help="record what is there, without a comparison")
    options = parser.parse_args()
    now, before = present(ROOT), recorded(ROOT)
    names = differing(now, before)
    if options.record:
        write(ROOT, now)
        _say(f"{RECORD_FILE}: {', '.join(names) or 'nothing'} recorded without a comparison.")
        return 0
    if not names and not options.since:
        _say(f"All {len(now)} stages are as recorded.")
        return 0
    comparison = Comparison(ROOT, ROOT / "build" / "versions", _say)
    commit = options.since or comparison.last_right(names)
    _say(f"comparing with {commit[:12]}")
    verdicts = comparison.verdicts(commit)
    refused = {name: verdict for name, verdict in verdicts.items() if not verdict.accepted}
    for name in now:
        _say(f"{name:12} {_verdict_text(verdicts.get(name))}")
    kept = {name: before[name] for name in refused if name in before}
    write(ROOT, {name: kept.get(name, stage) for name, stage in now.items() if name in kept or name not in refused})
    if refused:
        _say(f"Raise the version of {', '.join(refused)} in {LINE_FILE}, then `make versions` again.")
    return 1 if refused else 0


def _verdict_text(verdict: Verdict | None) -> str:
    if verdict is None:
        return "the same sources"
    return f"{'recorded' if verdict.accepted else 'NOT recorded'}: {verdict.why}"


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
