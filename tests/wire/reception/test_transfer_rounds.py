"""Transfers of one ID are told apart by time and counter, and intact ones are not lost."""

from functools import cache
from typing import Any

import numpy as np
from answers import one
from hypothesis import given, settings
from hypothesis import strategies as st
from support.dbcs import default_codec
from support.e2e_streams import MS, SLOT, check_accounts

from maplines_can import MapLine
from maplines_can.study import road

CAN_ID, PAGES, RECORDS = 0x340, 4, 1024


# -- two transfers of one ID ------------------------------------------------------------------


@cache
def pages() -> Any:
    """Return the pages of consecutive records, all different."""
    means, covs = road(RECORDS, seed=7)
    means[:, 0] = np.arange(RECORDS) / 64 - 8
    payloads = default_codec().batch.encode(means, covs, slot=SLOT)
    return [[row[8 * i : 8 * i + 8].tobytes() for i in range(PAGES)] for row in payloads]


def schedule(
    rng: Any,
    cycles: int,
    components: int,
    *,
    pace: float = 1,
    late_ms: float = 0,
    loss: float = 0.1,
    duplicated: float = 0.05,
    late: float = 0.05,
) -> list[tuple[float, int, int]]:
    """Return the arrivals (time [ms], record, page) of lines at 20 Hz times ``pace``.

    A tenth of the lines is sent by a sender that is held up for 60 ms at any page.
    """
    n = cycles * components * PAGES
    frame = np.arange(n)
    line, place = frame // (components * PAGES), frame % (components * PAGES)
    held_up = np.where(
        rng.random(cycles) < 0.1, rng.integers(components * PAGES, size=cycles), 10**6
    )
    sent = (50 * line + 0.25 * place) / pace + 60 / pace * (place >= held_up[line])
    sent = np.maximum.accumulate(sent)
    arrivals = []
    for copy in (rng.random(n) >= loss, rng.random(n) < duplicated):
        delay = np.where(rng.random(n) < late, rng.uniform(0, late_ms, n), 0.0)
        arrivals.append(np.stack([sent + delay, frame], axis=1)[copy])
    order = np.concatenate(arrivals)
    order = order[np.argsort(order[:, 0], kind="stable")]
    return [(at, int(i) // PAGES, int(i) % PAGES) for at, i in order]


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32),
    components=st.integers(1, 8),
    pace=st.sampled_from([1, 2.5, 8]),
    late_ms=st.sampled_from([0.0, 20.0, 60.0, 120.0]),
    loss=st.sampled_from([0.0, 0.1, 0.4]),
    late=st.sampled_from([0.05, 0.5]),
)
def test_no_delivered_line_is_made_of_two_transfers(
    seed: int, components: int, pace: float, late_ms: float, loss: float, late: float
) -> None:
    """Under any of it, also for senders that are faster than the cycle time of the DBC."""
    codec, rng = default_codec(), np.random.default_rng(seed)
    arrivals = schedule(rng, 24, components, pace=pace, late_ms=late_ms, loss=loss, late=late)
    decoder = codec.decoder()
    delivered = [
        answer
        for at, record, page in arrivals
        if isinstance(
            answer := one(decoder.feed(CAN_ID, pages()[record][page], round(at * MS))), MapLine
        )
    ]
    check_accounts(decoder)
    numbers = [round(64 * (line.gaussian.mean[0] + 8)) for line in delivered]
    assert numbers == sorted(set(numbers))
    for number, line in zip(numbers, delivered, strict=True):
        sent = codec.batch.decode_one(b"".join(pages()[number]), SLOT)
        assert isinstance(sent, MapLine)
        assert np.array_equal(line.gaussian.mean, sent.gaussian.mean)
        assert np.array_equal(line.gaussian.cov, sent.gaussian.cov)
