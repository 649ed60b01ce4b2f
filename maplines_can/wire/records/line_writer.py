"""Records of map lines: one for each line, or one for each component of its mixture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...values.gaussian import Gaussian
from ...values.line import MapLine
from ..layout.attributes import RecordAttributes
from ..layout.pose_layout import Owner
from ..layout.validation import CheckedGaussians
from .components import MixtureWriter
from .writer import RecordWriter


@dataclass(frozen=True, slots=True, eq=False)
class _Record:
    """Content of one record of a line."""

    line: MapLine
    gaussian: Gaussian
    index: int
    count: int
    weight: float
    cover: NDArray[np.float64]  #: (4, 4) that the decoded covariance must cover besides its own


class LineWriter:
    """Writer of map lines."""

    def __init__(self, writer: RecordWriter, mixture_writer: MixtureWriter) -> None:
        self._writer, self._mixture_writer = writer, mixture_writer
        self._counters = 2 ** writer.layout["Counter"].length

    def write(
        self, lines: Sequence[MapLine], counters: Mapping[Owner, int]
    ) -> tuple[list[list[NDArray[np.uint8]]], Counter[Owner]]:
        """Return the records of each line, and the counters that follow them.

        The counters are of the next record of each slot; 0 if there is none. That of the pose error
        does not change.
        """
        records_of_lines = [self._records(line) for line in lines]
        records = [record for records in records_of_lines for record in records]
        following: Counter[Owner] = Counter(counters)
        counter = []
        for record in records:
            slot = record.line.slot
            counter.append(following[slot] % self._counters)
            following[slot] = (following[slot] + 1) % self._counters
        payloads = self._writer.write(
            CheckedGaussians(
                np.array([record.gaussian.mean for record in records]),
                np.array([record.gaussian.cov for record in records]),
                np.zeros(len(records), dtype=bool),  # a Gaussian is never indefinite
            ),
            RecordAttributes(
                slot=[record.line.slot for record in records],
                counter=counter,
                kind=[record.line.kind for record in records],
                x_min=[record.line.x_min for record in records],
                x_max=[record.line.x_max for record in records],
                age=[record.line.age for record in records],
                status=[record.line.status for record in records],
                component_index=[record.index for record in records],
                component_count=[record.count for record in records],
                component_weight=[record.weight for record in records],
            ),
            np.array([record.cover for record in records]),
        )
        left = iter(payloads)
        return [[next(left) for _ in records] for records in records_of_lines], following

    def _records(self, line: MapLine) -> list[_Record]:
        if line.mixture is None:
            return [_Record(line, line.gaussian, 0, 1, 1.0, np.zeros((4, 4)))]
        mixture, k = line.mixture, len(line.mixture.weights)
        weights, cover = self._mixture_writer.cover(
            mixture.weights[None], mixture.means[None], mixture.covs[None]
        )
        return [
            _Record(line, gaussian, i, k, float(weights[0, i]), cover[0])
            for i, gaussian in enumerate(mixture.components)
        ]
