"""Transfers of one ID are told apart by time and counter, and intact ones are not lost."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import one
from dbcs import DBC, default_codec, edited
from e2e_streams import CYCLE, MS, SLOT, check_accounts, frames
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can import MapLine
from maplines_can.study import road
from maplines_can.wire import Reason
from maplines_can.wire.layout.message_layout import Layout
from maplines_can.wire.reception.settings import decoder_settings, timeout_cycles

CAN_ID, PAGES, RECORDS = 0x340, 4, 1024


def test_transfers_whose_pages_are_60_ms_apart_are_delivered() -> None:
    """Every third time the sender is descheduled in the middle of a line, for 60 ms."""
    decoder, answers, t_ns = default_codec().decoder(), [], 0
    for line in range(120):
        t_ns = max(t_ns, line * CYCLE)
        for page, frame in enumerate(frames(line)):
            if line % 3 == 0 and page == 1 + line // 3 % 3:
                t_ns += 60 * MS
            answers.append(one(decoder.feed(frame.can_id, frame.data, t_ns)))
            t_ns += MS // 4
    assert sum(isinstance(answer, MapLine) for answer in answers) == 120
    assert not decoder.counts


@pytest.mark.parametrize(("apart_ms", "reason"), [(75, None), (76, Reason.TIMEOUT)])
def test_the_time_out_is_one_and_a_half_cycles(apart_ms: int, reason: Any) -> None:
    """Of the DBC, or as it is given."""
    for settings_, factor in (({}, 1), ({"timeout_ms": 150}, 2), ({"cycle_ms": 100}, 2)):
        decoder = default_codec().decoder(**settings_)  # type: ignore[arg-type]
        *first, last = frames(0)
        for frame in first:
            decoder.feed(frame.can_id, frame.data, 0)
        answer = one(decoder.feed(last.can_id, last.data, factor * apart_ms * MS))
        assert isinstance(answer, MapLine) is (reason is None)
        assert decoder.counts == ({reason: 3} if reason else {})


@pytest.mark.parametrize(
    ("edits", "cycles"),
    [
        pytest.param([], 1.5, id="16-ids-8-components"),
        pytest.param(
            [(r"(ComponentCount.*\|)3(@.*)\[1\|8\]", r"\g<1>2\2[1|4]")], 1.5, id="at-most-1.5"
        ),
    ],
)
def test_the_default_follows_from_the_dbc(edits: Any, cycles: float, tmp_path: Path) -> None:
    """(transfer IDs / components - 0.5) cycles, 0.5 to 1.5, and half the DBC's cycle at least."""
    layout = Layout.from_dbc(edited(tmp_path, *edits) if edits else DBC)
    assert timeout_cycles(layout) == cycles
    for cycle_ms, timeout_ms in ((None, 75), (20, 30), (10, 25), (500, 750)):
        settings = decoder_settings(layout, cycle_ms=cycle_ms)
        assert {one.timeout_ns for one in settings.values()} == {timeout_ms * MS}


class FewIds:
    """A layout with other numbers of transfer IDs and components."""

    signals = ("ComponentCount",)

    def __init__(self, bits: int, components: float) -> None:
        self.bits, self.components = bits, components

    def __getitem__(self, name: str) -> Any:
        class Signal:
            length, physical_range = self.bits, (1.0, self.components)

        return Signal


@pytest.mark.parametrize(
    ("bits", "components", "cycles"),
    [(4, 8, 1.5), (4, 16, 0.5), (3, 8, 0.5), (5, 24, 5 / 6), (4, 1, 1.5)],
)
def test_fewer_transfer_ids_shorten_the_time_out(bits: int, components: Any, cycles: Any) -> None:
    """To half a cycle at least."""
    assert timeout_cycles(FewIds(bits, components)) == pytest.approx(cycles)  # type: ignore[arg-type]


# -- two transfers of one ID ------------------------------------------------------------------


@cache
def pages() -> Any:
    """Return the pages of consecutive records, all different."""
    means, covs = road(RECORDS, seed=7)
    means[:, 0] = np.arange(RECORDS) / 64 - 8
    payloads = default_codec().batch.encode(means, covs, slot=SLOT)
    return [[row[8 * i : 8 * i + 8].tobytes() for i in range(PAGES)] for row in payloads]


class Mixing:
    """A decoder of pages whose records are all intact: a wrong checksum is of two transfers."""

    def __init__(self) -> None:
        self.decoder, self.complete = default_codec().decoder(), list[int]()

    @property
    def mixed(self) -> int:
        return self.decoder.counts[Reason.CRC] // PAGES

    def feed(self, record: int, page: int, t_ms: float = 0.0) -> None:
        data = pages()[record % RECORDS][page]
        answer = self.decoder.feed(CAN_ID, data, round(t_ms * MS))
        if not isinstance(answer, Reason):
            self.complete += [round(64 * (line.gaussian.mean[0] + 8)) for line in answer]


def test_a_page_0_with_a_newer_counter_starts_anew() -> None:
    """Of the older transfer nothing is left, so a page that is lost is not replaced by its own."""
    mixing = Mixing()
    for record, page in [(3, 0), (3, 1), (19, 0), (19, 2), (19, 3)]:
        mixing.feed(record, page)
    assert mixing.decoder.counts == {Reason.REPLACED: 2}
    assert (mixing.mixed, mixing.decoder.pending) == (0, 3)
    mixing.feed(19, 1)
    assert mixing.complete == [19]


def test_a_late_page_0_of_an_older_transfer_does_no_harm() -> None:
    """The newer transfer is complete without it."""
    mixing = Mixing()
    for record, page in [(19, 0), (19, 1), (3, 0), (19, 2), (19, 3)]:
        mixing.feed(record, page)
    assert mixing.decoder.counts == {Reason.REPLACED: 1}
    assert (mixing.mixed, mixing.complete) == (0, [19])


@pytest.mark.parametrize(("later", "newest"), [(16, 1), (112, 1), (128, 0), (240, 0)])
def test_of_two_counters_half_a_round_apart_the_first_is_kept(later: int, newest: int) -> None:
    """A counter is newer if it is ahead by less than half of the counter modulus."""
    mixing = Mixing()
    records = (3, 3 + later)
    for record in records:
        mixing.feed(record, 0)
    for page in range(1, PAGES):
        mixing.feed(records[newest], page)
    assert mixing.decoder.counts == {Reason.REPLACED: 1}
    assert mixing.complete == [records[newest]]


@pytest.mark.parametrize("later", range(1, 16))
def test_a_good_record_ends_transfers_of_the_previous_round(later: int) -> None:
    """Whatever the time: half of the IDs later at the latest, and so before its ID comes again."""
    mixing = Mixing()
    for page in (0, 1, 3):
        mixing.feed(3, page)
    for page in range(PAGES):
        mixing.feed(3 + later, page)
    is_ended = later >= 8
    assert mixing.decoder.pending == (0 if is_ended else 3)
    assert mixing.decoder.counts == ({Reason.INCOMPLETE: 3} if is_ended else {})


def test_a_transfer_that_begins_after_a_record_is_not_ended_by_it() -> None:
    """The next records may overtake the last pages of one."""
    mixing = Mixing()
    for record, page in [(3, 0), (4, 0), (3, 1), (11, 0), (3, 2), (3, 3)]:
        mixing.feed(record, page)
    assert mixing.complete == [3]
    assert mixing.decoder.pending == 2


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


@pytest.mark.parametrize(
    ("components", "late_ms", "most"),
    [(1, 0, 0), (1, 25, 0), (4, 0, 0), (4, 25, 0), (8, 0, 1), (8, 2, 1), (8, 25, 25)],
)
def test_hardly_a_record_of_two_transfers_reaches_the_checksum(
    components: int, late_ms: float, most: int
) -> None:
    """Of 12 000 records; 10 % of the frames lost, 5 % doubled, 5 % late, a sender held up.

    With 8 components a transfer ID comes again after 100 ms, or 40 ms if the first of the two lines
    is held up for 60 ms: more than the jitter of half a cycle. The checksum misses one in 65 536.
    """
    mixing = Mixing()
    for at, record, page in schedule(
        np.random.default_rng(3), 12_000 // components, components, late_ms=late_ms
    ):
        mixing.feed(record, page, at)
    assert mixing.mixed <= most
    assert len(mixing.complete) > 0.55 * 12_000  # those that are late are STALE


@settings(max_examples=60, deadline=None)
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
