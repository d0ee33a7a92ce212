"""Other readings of a control file, and how much of what is known each explains.

A file that contradicts the photos is often sound but written by another convention. Each convention that can be tested
is a reading; it is named only where it explains nearly everything, and the file as it stands far less. A reading is
never used in silence: it becomes a hint at what to correct.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

MIN_WITNESSES = 6  # marks or positions that name a cause; fewer agree by chance
MIN_CONTRADICTING = 3  # that stop a file without naming one; fewer are single mistakes, and told one by one
MIN_EXPLAINED_SHARE = 0.8  # share that a reading must explain to be named
MAX_STATED_RATIO = 0.5  # share that the file as it stands may explain, over the reading's share


@dataclass(frozen=True)
class Evidence:
    """How many of some independent observations a reading explains.

    Attributes:
        explained: That number.
        of: All.
    """

    explained: int
    of: int

    @property
    def share(self) -> float:
        """The explained part; 0 of nothing."""
        return self.explained / self.of if self.of else 0.0


@dataclass(frozen=True)
class Reading:
    """A convention that a file may have been written by.

    Attributes:
        cause: What is different in it, a clause.
        remedy: How to correct the file, a sentence.
    """

    cause: str
    remedy: str


def plausible(
    stated: Evidence, others: Iterable[tuple[Reading, Evidence]], least: int = MIN_WITNESSES
) -> tuple[Reading, Evidence] | None:
    """The reading that explains most, if it explains nearly all and the file as it stands less than half of that.

    Args:
        stated: What the file as it stands explains.
        others: The other readings; of equals, the first is taken.
        least: Number of observations below which nothing is concluded.
    """
    best: tuple[Reading, Evidence] | None = None
    for reading, evidence in others:
        sound = (
            evidence.of >= least
            and evidence.share >= MIN_EXPLAINED_SHARE
            and stated.share < MAX_STATED_RATIO * evidence.share
        )
        if sound and (best is None or evidence.share > best[1].share):
            best = reading, evidence
    return best
