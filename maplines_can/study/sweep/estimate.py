"""How long a study will take, from small parts of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any

from ..scenes import table as scene_table
from ..sets import Chunk, Gaussians, LineSet
from .plan import LIMIT_PARTS, Study
from .tasks import chunk_result, limit_result

#: Gaussians of the two parts of a chunk that are timed, and those for the limit.
SMALL, LARGER, FOR_LIMIT = 200, 1200, 2000


def cpu_seconds(study: Study) -> float:
    """Return about how much CPU time all tasks of a study take on this machine [s].

    A chunk costs something for itself and something for each Gaussian: two small parts of the first
    chunk of each set are timed, a scene of each number of lines, and the limit of some Gaussians.
    It takes some seconds. Of two studies it said 11 and 99 s, and 18 and 82 s were seen.
    """
    scenes = sum(
        len(sizes) and sum(sizes) * _seconds(partial(_scene, study, lines))
        for lines, sizes in study.scene_sizes.items()
    )
    return scenes + sum(_of_set(study, line_set) for line_set in study.sets)


def _of_set(study: Study, line_set: LineSet) -> float:
    """Return the time for the chunks and the limit of a set [s]."""
    sizes = line_set.sizes(study.n, study.chunk_size)
    n = min(sum(sizes), LARGER)
    (first,) = islice(line_set.chunks(min(study.n, LARGER), LARGER, study.seed), 1)
    given = first()
    n = min(n, len(given.mean))
    small = min(SMALL, n)
    total = 0.0
    for plans, gaussians in ((study.plans, sum(sizes)), (study.field_plans, study.fields_n)):
        gaussians = min(gaussians, sum(sizes))
        if not plans or not gaussians:
            continue
        chunks = -(-gaussians // study.chunk_size)
        each = [
            _seconds(partial(chunk_result, _head(given, size), plans, []))
            for size in (small, small, n)  # the first one makes the codecs
        ][1:]
        slope = max(each[1] - each[0], 0.0) / max(n - small, 1)
        total += chunks * max(each[0] - slope * small, 0.0) + gaussians * slope
    making = _seconds(first) / max(len(given.mean), 1)
    if study.limit_n:
        most = min(study.limit_n, sum(sizes), FOR_LIMIT, len(given.mean))
        for part in LIMIT_PARTS:
            limit = partial(limit_result, [_head(given, most)], most, part, study.seed)
            total += _seconds(limit) * min(study.limit_n, sum(sizes)) / most
    return total + making * sum(sizes)


def _head(given: Gaussians, n: int) -> Chunk:
    return partial(Gaussians, given.mean[:n], given.cov[:n])


def _scene(study: Study, lines: int) -> Any:
    return scene_table.chunk(lines, 0, 1, study.codes, study.seed)


def _seconds(work: Callable[[], Any]) -> float:
    """Return the CPU time of a piece of work [s]."""
    began = time.process_time()
    work()
    return time.process_time() - began
