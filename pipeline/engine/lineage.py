"""What an OUT holds that belongs together: a finished artifact and, by digests, all that it was made from.

Unlike ``runner.survey`` this asks neither the configuration nor the photos, so it finds what another version left, too.
"""

from __future__ import annotations

from splatpipe.pipeline.engine.stage import Stage
from splatpipe.pipeline.engine.store import Artifact, Part, Store, is_copy


def delivered(store: Store, stage: Stage) -> Artifact | None:
    """The artifact of a stage whose deliverables lie in OUT; the newest where none does, None without any."""
    artifacts = store.artifacts(stage.name)
    for artifact in artifacts:
        files = artifact.deliverables(stage)
        if files and all(is_copy(file, store.out / name) for name, file in files.items()):
            return artifact
    return artifacts[0] if artifacts else None


def lineage(store: Store, artifact: Artifact) -> dict[str, Part]:
    """The parts of an artifact and of all that it was made from, by their full names; what is gone is left out."""
    found = dict(artifact.parts)
    asked = dict(artifact.manifest["inputs"]["reads"])
    while asked:
        name, digest = asked.popitem()
        if name in found:
            continue
        made = next((a for a in store.artifacts(name.split(".")[0]) if _has(a, name, digest)), None)
        if made is not None:
            found |= {part: where for part, where in made.parts.items() if part not in found}
            asked |= made.manifest["inputs"]["reads"]
    return found


def _has(artifact: Artifact, name: str, digest: str) -> bool:
    part = artifact.parts.get(name)
    return part is not None and part.digest == digest
