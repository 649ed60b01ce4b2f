"""Raw values of a record of the pose error, or of one that is conditional on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ..layout.pose_layout import Owner


@dataclass(frozen=True, slots=True)
class RawRecord:
    """Content of a record of the pose error, or of one that is conditional on it.

    Args:
        owner: ``POSE``, or the slot of the line.
        counter: E2E counter.
        raw: raw values by signal, of all but page numbers, transfer IDs, counter and checksum, and
            ``HasCovariance``.
    """

    owner: Owner
    counter: int
    raw: Mapping[str, int]

    @property
    def count(self) -> int:
        """Number of components: a line in a scene is no mixture."""
        return 1
