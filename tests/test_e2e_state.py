"""AUTOSAR's E2E check and state machine, row by row, and what a consumer sees of them."""

import json
import re
import threading
import time
from dataclasses import asdict, replace
from functools import cache

import can
import e2e
import numpy as np
import pytest
from dbcs import default_codec, edited
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can import Codec, Link, MapLine, Monitor, Receiver, Slot, Transmitter
from maplines_can.bus import Sent
from maplines_can.cli import main
from maplines_can.study import road
from maplines_can.wire import E2EConfig, E2EState, ProfileStatus, Reason, SequenceCheck
from maplines_can.wire.protection.e2e_state import StateMachine, check

MS = 1_000_000
CYCLE = 50 * MS
SLOT = Slot.EGO_LEFT
OK, NONEWDATA, ERROR, REPEATED, OKSOMELOST, WRONGSEQUENCE = ProfileStatus
VALID, NODATA, INIT, INVALID = E2EState

LETTERS = {"o": OK, "l": OKSOMELOST, "e": ERROR, "r": REPEATED, "w": WRONGSEQUENCE, "n": NONEWDATA}
STATES = {"D": NODATA, "I": INIT, "V": VALID, "X": INVALID}

#: Windows of three sizes and bounds that all differ where they may.
SMALL = E2EConfig(
    window_size_init=3,
    window_size_valid=5,
    window_size_invalid=4,
    min_ok_state_init=2,
    min_ok_state_valid=2,
    min_ok_state_invalid=3,
    max_error_state_init=1,
    max_error_state_valid=2,
    max_error_state_invalid=0,
)


# ---- the check ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("last", "counter", "status"),
    [
        pytest.param(None, 77, OK, id="first"),
        pytest.param(7, 8, OK, id="next"),
        pytest.param(255, 0, OK, id="next-round"),
        pytest.param(7, 7, REPEATED, id="same"),
        pytest.param(7, 9, OKSOMELOST, id="one-lost"),
        pytest.param(7, 10, OKSOMELOST, id="at-max-delta"),
        pytest.param(254, 1, OKSOMELOST, id="at-max-delta-over-the-round"),
        pytest.param(7, 11, WRONGSEQUENCE, id="one-beyond"),
        pytest.param(7, 6, WRONGSEQUENCE, id="one-back"),
        pytest.param(0, 255, WRONGSEQUENCE, id="one-back-over-the-round"),
    ],
)
def test_the_counter_check(last, counter, status):
    """E2E_P05Check with max_delta_counter 3: the step from the last counter decides."""
    assert check(counter, last, 3) is status


@given(st.integers(0, 255), st.integers(0, 255), st.integers(1, 127))
def test_every_counter_has_one_status(last, counter, max_delta):
    """As the standard says it: by the difference on the circle of counters."""
    forward = counter - last if counter >= last else counter + 256 - last
    expected = (
        REPEATED
        if forward == 0
        else OK
        if forward == 1
        else OKSOMELOST
        if forward <= max_delta
        else WRONGSEQUENCE
    )
    assert check(counter, last, max_delta) is expected


@settings(max_examples=150, deadline=None)
@given(st.lists(st.integers(0, 32 * 8 - 1), max_size=4), st.integers(0, 254))
def test_a_record_is_in_error_where_autosar_e2e_says_so(bits, counter):
    """The witness writes the counter and the checksum, and judges what is flipped after that."""
    data_id = default_codec().layout.channels[SLOT].data_id
    before, after = (record(k).tobytes() for k in (counter, counter + 1))
    counted = bytearray(before)
    e2e.p05.e2e_p05_protect(counted, data_id, increment_counter=True)
    assert counted[2] == after[2]
    damaged = bytearray(after)
    for bit in bits:
        damaged[bit // 8] ^= 1 << bit % 8
    decoder = default_codec().decoder()
    decoder.feed(0x348, before, 0)
    decoder.feed(0x348, bytes(damaged), CYCLE)
    good = e2e.p05.e2e_p05_check(bytes(damaged), data_id)
    assert decoder.checks[SLOT].status is (OK if good else ERROR)


# ---- the state machine, row by row -------------------------------------------------------------


@pytest.mark.parametrize(
    ("statuses", "states"),
    [
        # NODATA: the first that is neither ERROR nor NONEWDATA, and it does not count
        pytest.param("n", "D", id="nodata-nonewdata"),
        pytest.param("e", "D", id="nodata-error"),
        pytest.param("eeeeeennnnnn", "DDDDDDDDDDDD", id="nodata-errors-do-not-add-up"),
        pytest.param("o", "I", id="nodata-ok"),
        pytest.param("l", "I", id="nodata-oksomelost"),
        pytest.param("r", "I", id="nodata-repeated"),
        pytest.param("w", "I", id="nodata-wrongsequence"),
        pytest.param("eeo", "DDI", id="nodata-left-after-errors"),
        pytest.param("eeoeoo", "DDIIIV", id="errors-before-init-are-forgotten"),
        # INIT: window 3, OKs 2, errors 1
        pytest.param("oo", "II", id="init-one-ok-less"),
        pytest.param("ooo", "IIV", id="init-oks-at-bound"),
        pytest.param("oll", "IIV", id="oksomelost-is-an-ok"),
        pytest.param("oeoo", "IIIV", id="init-both-at-bound"),
        pytest.param("oee", "IIX", id="init-one-error-more"),
        pytest.param("oone", "IIII", id="init-neither"),
        pytest.param("oono", "IIIV", id="init-ok-at-the-edge-of-the-window"),
        pytest.param("oonno", "IIIII", id="init-ok-just-out-of-the-window"),
        pytest.param("oene", "IIIX", id="init-error-at-the-edge-of-the-window"),
        pytest.param("oenne", "IIIII", id="init-error-just-out-of-the-window"),
        pytest.param("onrwnrw", "IIIIIII", id="init-others-count-as-neither"),
        # VALID: window 5, OKs 2, errors 2
        pytest.param("oooee", "IIVVV", id="valid-both-at-bound"),
        pytest.param("oooeee", "IIVVVX", id="valid-one-error-more"),
        pytest.param("ooonnn", "IIVVVV", id="valid-oks-at-bound"),
        pytest.param("ooonnnn", "IIVVVVX", id="valid-one-ok-less-nonewdata"),
        pytest.param("ooorrrr", "IIVVVVX", id="valid-one-ok-less-repeated"),
        pytest.param("ooowwww", "IIVVVVX", id="valid-one-ok-less-wrongsequence"),
        pytest.param("oooelerlw", "IIVVVVVVV", id="valid-all-kinds-within-both-bounds"),
        pytest.param("oooeooee", "IIVVVVVX", id="valid-error-at-the-edge-of-the-window"),
        pytest.param("oooeoooee", "IIVVVVVVV", id="valid-error-just-out-of-the-window"),
        # The window grows from 3 to 5 between INIT and VALID
        pytest.param("oeooee", "IIIVVX", id="init-s-error-goes-along"),
        pytest.param("oenooee", "IIIIVVV", id="what-left-init-s-window-does-not-come-back"),
        # INVALID: window 4, OKs 3, errors 0, from an empty window
        pytest.param("oeeoo", "IIXXX", id="invalid-one-ok-less"),
        pytest.param("oeeooo", "IIXXXV", id="invalid-oks-at-bound"),
        pytest.param("oeeoono", "IIXXXXV", id="invalid-ok-at-the-edge-of-the-window"),
        pytest.param("oeeoonno", "IIXXXXXX", id="invalid-ok-just-out-of-the-window"),
        pytest.param("oeeooeo", "IIXXXXX", id="invalid-one-error-more"),
        pytest.param("oeeeooo", "IIXXXXX", id="invalid-error-at-the-edge-of-the-window"),
        pytest.param("oeeeoooo", "IIXXXXXV", id="invalid-error-just-out-of-the-window"),
        pytest.param("oeennnnnnnn", "IIXXXXXXXXX", id="invalid-silence"),
        pytest.param("oeeooonn", "IIXXXVVV", id="valid-again"),
    ],
)
def test_the_table_of_states(statuses, states):
    """Each transition of E2E_SMCheck, at its bounds and one off, and at the edge of its window."""
    machine = StateMachine(SMALL)
    assert [STATES[letter] for letter in states] == [machine.step(LETTERS[s]) for s in statuses]


@pytest.mark.parametrize(
    ("clear", "statuses", "states"),
    [
        pytest.param(True, "oooeeeooo", "IIVVVXXXV", id="from-valid-cleared"),
        pytest.param(False, "oooeeeooo", "IIVVVXXXX", id="from-valid-kept"),
        pytest.param(False, "oooeeeoooo", "IIVVVXXXXV", id="from-valid-kept-until-it-leaves"),
        pytest.param(True, "oeeooo", "IIXXXV", id="from-init-cleared"),
        pytest.param(False, "oeeooo", "IIXXXX", id="from-init-kept"),
        pytest.param(False, "oooonnnnooo", "IIVVVVVXXXV", id="oks-of-before-do-not-suffice"),
    ],
)
def test_what_invalid_begins_with(clear, statuses, states):
    """With clear_to_invalid an empty window, else the last checks."""
    machine = StateMachine(replace(SMALL, clear_to_invalid=clear))
    assert [STATES[letter] for letter in states] == [machine.step(LETTERS[s]) for s in statuses]


class Reference:
    """E2E_SMCheck as the standard has it: an array, an index, and routines on them."""

    def __init__(self, config):
        self.c = asdict(config)
        self.window = [None] * config.window_size_valid  # None: E2E_P_NOTAVAILABLE
        self.top, self.state = 0, "nodata"

    def size(self, state):
        return self.c[f"window_size_{state}"]

    def newest(self, n):
        return [self.window[(self.top - 1 - i) % len(self.window)] for i in range(n)]

    def clear(self):
        self.window, self.top = [None] * len(self.window), 0

    def clear_remaining(self, state):
        if self.size(self.state) < self.size(state):
            for i in range(self.size(self.state), len(self.window)):
                self.window[(self.top - 1 - i) % len(self.window)] = None

    def to_invalid(self):
        self.clear() if self.c["clear_to_invalid"] else self.clear_remaining("invalid")
        self.state = "invalid"

    def step(self, status):
        if self.state == "nodata":
            if status not in (ERROR, NONEWDATA):
                self.clear()
                self.state = "init"
            return self.state
        self.window[self.top] = OK if status == OKSOMELOST else status
        self.top = (self.top + 1) % len(self.window)
        last = self.newest(self.size(self.state))
        self.oks, self.errors = last.count(OK), last.count(ERROR)
        few_errors = self.errors <= self.c[f"max_error_state_{self.state}"]
        many_oks = self.oks >= self.c[f"min_ok_state_{self.state}"]
        if self.state == "init" and few_errors and many_oks:
            self.clear_remaining("valid")
            self.state = "valid"
        elif (self.state == "init" and not few_errors) or (
            self.state == "valid" and not (few_errors and many_oks)
        ):
            self.to_invalid()
        elif self.state == "invalid" and few_errors and many_oks:
            self.clear_remaining("valid")
            self.state = "valid"
        return self.state


@st.composite
def configs(draw):
    """Any that the standard allows, with small windows."""
    errors = sorted(draw(st.lists(st.integers(0, 3), min_size=3, max_size=3)))
    oks = sorted(draw(st.lists(st.integers(1, 4), min_size=3, max_size=3)))
    pairs = {"valid": (oks[0], errors[2]), "init": (oks[1], errors[1])}
    pairs["invalid"] = (oks[2], errors[0])
    sizes = {name: sum(pair) + draw(st.integers(0, 3)) for name, pair in pairs.items()}
    sizes["valid"] = max(sizes.values())
    values = {f"window_size_{name}": size for name, size in sizes.items()}
    values |= {f"min_ok_state_{name}": ok for name, (ok, _) in pairs.items()}
    values |= {f"max_error_state_{name}": error for name, (_, error) in pairs.items()}
    return E2EConfig(**values, clear_to_invalid=draw(st.booleans()))


@settings(max_examples=300)
@given(configs(), st.text("oooooolerwn", max_size=80))
def test_the_machine_is_the_standard_s(config, statuses):
    """Any configuration and any checks: states and counts of an array with an index."""
    machine, reference = StateMachine(config), Reference(config)
    for letter in statuses:
        state = machine.step(LETTERS[letter])
        assert state.name.lower() == reference.step(LETTERS[letter])
        last = reference.newest(reference.size(reference.state)) if state is not NODATA else []
        assert (machine.ok_count, machine.error_count) == (last.count(OK), last.count(ERROR))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"max_delta_counter": 0}, "max_delta_counter must be a whole number from 1 to 127, got 0"),
        ({"max_delta_counter": 128}, "from 1 to 127, got 128"),
        ({"window_size_init": 2.5}, "window_size_init must be a whole number from 1"),
        ({"min_ok_state_valid": 0}, "min_ok_state_valid must be a whole number from 1"),
        ({"max_error_state_init": -1}, "max_error_state_init must be a whole number from 0"),
        ({"window_size_init": 6}, r"must fit into window_size_init, got 6 \+ 1 > 6"),
        ({"window_size_init": 11}, "window_size_init must be window_size_valid or less"),
        ({"window_size_invalid": 11}, "window_size_invalid must be window_size_valid or less"),
        ({"min_ok_state_init": 9}, "min_ok_state_init <= min_ok_state_invalid must hold"),
        ({"max_error_state_invalid": 2}, "max_error_state_invalid <= max_error_state_init"),
    ],
)
def test_a_configuration_that_the_standard_forbids(values, words):
    """The message names the constraint and the values."""
    with pytest.raises(ValueError, match=words):
        E2EConfig(**values)


def test_a_step_must_be_less_than_half_of_the_counters_of_the_dbc(tmp_path):
    """A narrow counter shrinks the default, and contradicts a step that is given."""
    narrow = [(rf"({name} m0 : 16\|)8@1\+ \(1,0\) \[0\|255\]", r"\g<1>4@1+ (1,0) [0|15]")
              for name in ("Counter",)]  # fmt: skip
    codec = Codec.from_dbc(edited(tmp_path, *narrow, (r"Counter : 16\|8@1\+", "Counter : 16|4@1+")))
    assert codec.decoder().checks[SLOT].received(3, 3, 0) is None
    with pytest.raises(ValueError, match=r"max_delta_counter must be less than 8.*got 16"):
        codec.decoder(e2e=E2EConfig())


# ---- the decoder -------------------------------------------------------------------------------

MEANS, COVS = road(256, seed=11)


@cache
def record(counter, which=None):
    """One record; its line is another for each counter, or the one that is named."""
    i = counter % 256 if which is None else which
    one = MEANS[i : i + 1], COVS[i : i + 1]
    return default_codec().encode_batch(*one, slot=SLOT, counter=[counter % 256])[0]


@cache
def frames(counter, fd=False, which=None):
    """The frames of that record."""
    return default_codec().frames(record(counter, which=which), SLOT, fd=fd)


def feed(decoder, transfer, t_ns):
    """The answer to the last frame of a transfer, its frames 0.25 ms apart."""
    answers = [decoder.feed(f.can_id, f.data, t_ns + i * MS // 4) for i, f in enumerate(transfer)]
    return answers[-1]


def run(decoder, counters, t_ns=0, fd=False, other=0):
    """Lines at 20 Hz, or other ones of the same counters; their answers, and the next time."""
    answers = []
    for counter in counters:
        which = (counter + other) % 256
        answers.append(feed(decoder, frames(counter, fd, which=which), t_ns))
        t_ns += CYCLE
    return answers, t_ns


def check_accounts(decoder):
    dropped = sum(decoder.counts.values())
    assert decoder.frames == decoder.line_frames + dropped + decoder.pending


def test_a_calm_slot_becomes_valid():
    """The seventh line: the first is for NODATA, six count."""
    decoder = default_codec().decoder()
    states = []
    for counter in range(8):
        run(decoder, [counter], counter * CYCLE)
        states.append(decoder.checks[SLOT].state)
    assert states == [INIT] * 6 + [VALID] * 2
    assert decoder.checks[Slot.ROUTE].state is NODATA
    assert decoder.checks[Slot.ROUTE].stats().status is None


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("k", [0, 1, 4, 5, 15, 16, 40])
def test_lines_that_are_lost(k, fd):
    """Up to 15 pass for lost ones; each cycle without one is NONEWDATA, and five end VALID."""
    decoder = default_codec().decoder()
    _, t_ns = run(decoder, range(250, 262), fd=fd)
    (line,), _ = run(decoder, [262 + k], t_ns + k * CYCLE, fd=fd)
    slot = decoder.checks[SLOT]
    assert isinstance(line, MapLine)
    assert slot.statuses[NONEWDATA] == k
    assert slot.lost == decoder.lost == k
    assert slot.status is (OK if k == 0 else OKSOMELOST if k < 16 else WRONGSEQUENCE)
    assert slot.state is (VALID if k < 5 else INVALID)
    check_accounts(decoder)


@pytest.mark.parametrize("silence", [0, 3, 9, 10, 1000])
@pytest.mark.parametrize("at", [10, 120, 130, 250])
def test_a_sender_that_starts_anew(at, silence):
    """Two lines are kept back where they might be old ones and the newest is not older than ten
    cycles; then eight OKs make it VALID.
    """
    decoder = default_codec().decoder()
    _, t_ns = run(decoder, range(at - 10, at))
    slot = decoder.checks[SLOT]
    assert slot.state is VALID
    kept = max(0, min(2, 10 - silence)) if at < 128 else 0
    answers, t_ns = run(decoder, range(kept + 1), t_ns + silence * CYCLE, other=100)
    assert answers[:kept] == [Reason.STALE] * kept
    assert isinstance(answers[kept], MapLine)
    if at < 240:  # from there on 0 looks like the next but some
        assert (slot.status, slot.state) == (WRONGSEQUENCE, INVALID)
        answers, t_ns = run(decoder, range(kept + 1, kept + 8), t_ns, other=100)
        assert slot.state is INVALID
        answers += run(decoder, [kept + 8], t_ns, other=100)[0]
        assert all(isinstance(answer, MapLine) for answer in answers)
        assert slot.lost == 0
    assert slot.state is VALID or at >= 240
    assert not slot.two_senders
    check_accounts(decoder)


@pytest.mark.parametrize("fd", [False, True])
def test_a_sender_that_starts_anew_with_the_same_lines_is_heard_after_half_a_second(fd):
    """Bit for bit they are copies of old ones: until nothing was new for ten cycles."""
    decoder = default_codec().decoder()
    _, t_ns = run(decoder, range(60), fd=fd)
    answers, _ = run(decoder, range(60), t_ns, fd=fd)
    assert answers[:10] == [Reason.DUPLICATE] * 10
    assert all(isinstance(answer, MapLine) for answer in answers[10:])
    assert not decoder.checks[SLOT].two_senders


def test_senders_that_start_anew_again_and_again_are_not_two():
    """Each time two lines are kept back, a trace of a second sender but for what follows."""
    decoder, t_ns = default_codec().decoder(), 0
    for k in range(30):
        _, t_ns = run(decoder, range(20), t_ns, other=20 * k)
    assert decoder.lines == 20 + 29 * 18
    assert not decoder.checks[SLOT].two_senders


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("back", [1, 2, 7, 16, 100, 127])
@pytest.mark.parametrize("later_ms", [1, 24, 26, 40])
def test_a_line_that_comes_late_is_not_delivered(later_ms, back, fd):
    """Whether it was delivered before or not: a newer one was, and the next ones are."""
    decoder = default_codec().decoder()
    counters = [c for c in range(140) if c not in (10, 120, 131, 132)]
    _, t_ns = run(decoder, counters, fd=fd)
    before = decoder.lines
    late = feed(decoder, frames(139 - back, fd), t_ns - CYCLE + later_ms * MS)
    assert late in (Reason.STALE, Reason.DUPLICATE)
    answers, _ = run(decoder, range(140, 150), t_ns, fd=fd)
    assert all(isinstance(answer, MapLine) for answer in answers)
    assert (decoder.lines - before, decoder.checks[SLOT].state) == (10, VALID)
    check_accounts(decoder)


@pytest.mark.parametrize("fd", [False, True])
def test_old_lines_that_come_all_at_once_are_not_delivered(fd):
    """A gateway empties its queue between two lines: in order, but none follows the newest."""
    decoder = default_codec().decoder()
    _, t_ns = run(decoder, range(100), fd=fd)
    queue = [f for c in range(60, 90) for f in frames(c, fd)]
    answers = [decoder.feed(f.can_id, f.data, t_ns - 20 * MS + i) for i, f in enumerate(queue)]
    assert not any(isinstance(answer, MapLine) for answer in answers)
    (line,), _ = run(decoder, [100], t_ns, fd=fd)
    assert isinstance(line, MapLine)


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("later_ms", [1, 24, 30, 500, 10**7])
def test_a_burst_that_comes_again_is_never_delivered_twice(later_ms, fd):
    """Within the time-out reassembly drops it; after that its counter does, however late."""
    decoder = default_codec().decoder()
    run(decoder, range(10), fd=fd)
    t_ns = 9 * CYCLE + later_ms * MS
    assert feed(decoder, frames(9, fd), t_ns) is Reason.DUPLICATE
    assert decoder.counts == {Reason.DUPLICATE: 1 if fd else 4}
    assert decoder.checks[SLOT].statuses[REPEATED] == 1
    assert decoder.lines == 10
    assert isinstance(feed(decoder, frames(10, fd), t_ns + CYCLE), MapLine)
    assert not decoder.checks[SLOT].two_senders
    check_accounts(decoder)


def test_a_sender_that_starts_anew_at_that_very_counter_loses_one_line():
    """It cannot be told from a transfer that was held up, so its first line is refused."""
    decoder = default_codec().decoder()
    run(decoder, [0])
    answers, _ = run(decoder, [0, 1, 2], t_ns=100 * CYCLE)
    assert answers[0] is Reason.DUPLICATE
    assert all(isinstance(answer, MapLine) for answer in answers[1:])


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("lines", [20, 31, 32, 33, 64])
def test_a_sender_that_is_stuck(lines, fd):
    """The same record for ever is one line, INVALID after a while, and not two senders."""
    decoder = default_codec().decoder()
    _, t_ns = run(decoder, range(lines), fd=fd)
    answers, t_ns = run(decoder, [lines - 1] * 30, t_ns, fd=fd)
    slot = decoder.checks[SLOT]
    assert set(answers) == {Reason.DUPLICATE}
    assert (slot.state, slot.statuses[REPEATED], slot.two_senders) == (INVALID, 30, False)
    run(decoder, range(lines, lines + 40), t_ns, fd=fd)
    assert not slot.two_senders
    check_accounts(decoder)


@pytest.mark.parametrize("fd", [False, True])
def test_damaged_records_end_valid(fd):
    """Two of ten do not, the third does; lines go on being delivered."""
    decoder = default_codec().decoder()
    _, t_ns = run(decoder, range(20), fd=fd)
    slot = decoder.checks[SLOT]
    for k in range(3):
        assert slot.state is VALID
        transfer = frames(20 + 2 * k, fd)
        broken = transfer[0]._replace(data=bytes([transfer[0].data[0] ^ 1, *transfer[0].data[1:]]))
        assert feed(decoder, [broken, *transfer[1:]], t_ns) is Reason.CRC
        (line,), t_ns = run(decoder, [21 + 2 * k], t_ns + CYCLE, fd=fd)
        assert isinstance(line, MapLine)
    assert slot.state is INVALID
    assert (slot.statuses[ERROR], slot.statuses[NONEWDATA], slot.lost) == (3, 0, 3)


def test_a_frame_of_the_wrong_length_is_an_error():
    """On an ID of the slot; a foreign one is nobody's."""
    decoder = default_codec().decoder()
    run(decoder, range(10))
    decoder.feed(0x348, b"short", 10 * CYCLE)
    decoder.feed(0x123, b"short", 10 * CYCLE)
    assert decoder.checks[SLOT].statuses[ERROR] == 1
    assert sum(check.statuses[ERROR] for check in decoder.checks.values()) == 1


@cache
def mixture_frames(counter, k, fd, seed=0):
    """The parts of one line, their counters from ``counter``."""
    rng = np.random.default_rng([seed, counter])
    means = MEANS[rng.integers(0, 256, k)]
    weights = np.full((1, k), 1 / k)
    payloads = default_codec().encode_mixtures(
        weights, means[None], np.tile(np.diag([1e-2, 1e-4, 1e-8, 1e-12]), (1, k, 1, 1)),
        slot=SLOT, counter=[counter],
    )[0]  # fmt: skip
    return [frame for p in payloads for frame in default_codec().frames(p, SLOT, fd=fd)]


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("k", [2, 3, 8])
def test_each_part_of_a_mixture_is_a_check(k, fd):
    """A lost line of 8 parts is OKSOMELOST; the last line again, whenever, is REPEATED k times."""
    decoder = default_codec().decoder()
    slot, t_ns, first = decoder.checks[SLOT], 0, 240
    for _ in range(6):
        assert isinstance(feed(decoder, mixture_frames(first % 256, k, fd), t_ns), MapLine)
        first, t_ns = first + k, t_ns + CYCLE
    assert slot.statuses[OK] == 6 * k
    assert slot.state is VALID
    first, t_ns = first + k, t_ns + CYCLE  # one is lost
    line = mixture_frames(first % 256, k, fd)
    assert isinstance(feed(decoder, line, t_ns), MapLine)
    assert (slot.statuses[OKSOMELOST], slot.lost, slot.state) == (1, k, VALID)
    for later_ms in (60, 200, 10_000):
        before = slot.statuses[REPEATED]
        assert feed(decoder, line, t_ns + later_ms * MS) is Reason.DUPLICATE
        assert slot.statuses[REPEATED] - before == k
    assert decoder.lines == 7
    next_ = mixture_frames((first + k) % 256, k, fd)
    assert isinstance(feed(decoder, next_, t_ns + 20_000 * MS), MapLine)
    assert slot.statuses[WRONGSEQUENCE] == 0
    check_accounts(decoder)


def two_senders(decoder, offset_ms, apart, *, fd=False, every=1, k=1, cycles=40, loss=0.0):
    """Two senders of a slot, the second later by an offset and ahead by some counters."""
    rng = np.random.default_rng(3)
    transfers = []
    for cycle in range(cycles):
        senders = [(0, 0)] + ([(offset_ms, apart)] if cycle % every == 0 else [])
        for sender, (ms, ahead) in enumerate(senders):
            counter = (cycle // (every if sender else 1) * k + ahead) % 256
            transfer = (
                frames(counter, fd, which=(counter + 100 * sender) % 256)
                if k == 1
                else mixture_frames(counter, k, fd, seed=sender)
            )
            transfers.append((cycle * CYCLE + ms * MS, transfer))
    for t_ns, transfer in transfers:
        if rng.random() >= loss:
            feed(decoder, transfer, t_ns)
    return decoder.checks[SLOT]


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("offset_ms", [5, 20, 30, 45])
@pytest.mark.parametrize("apart", [0, 1, 2, 5, 8, 16, 100, 128, 200, 255])
def test_two_senders_on_a_slot(apart, offset_ms, fd):
    """However far their counters and times are apart: never VALID for long, and reported."""
    decoder = default_codec().decoder()
    slot = two_senders(decoder, offset_ms, apart, fd=fd)
    assert slot.two_senders
    assert slot.state is not VALID
    check_accounts(decoder)


@pytest.mark.parametrize(
    "how",
    [
        pytest.param({"every": 4}, id="the-second-is-slower"),
        pytest.param({"every": 20, "cycles": 400}, id="the-second-is-much-slower"),
        pytest.param({"loss": 0.1}, id="lines-are-lost"),
        pytest.param({"k": 3}, id="mixtures"),
        pytest.param({"k": 8}, id="mixtures-of-eight"),
    ],
)
@pytest.mark.parametrize("offset_ms", [15, 30])
@pytest.mark.parametrize("apart", [2, 77])
def test_two_senders_are_found_under_harder_conditions(apart, offset_ms, how):
    """Other rates, losses, and lines of many records."""
    how = {"cycles": 80} | how
    assert two_senders(default_codec().decoder(), offset_ms, apart, **how).two_senders


@settings(max_examples=100, deadline=None)
@given(
    st.integers(0, 2**32), st.booleans(), st.sampled_from([1, 1, 3]), st.sampled_from([0.05, 0.3])
)
def test_one_sender_is_not_taken_for_two(seed, fd, k, bad):
    """It loses frames, starts anew, is silent, and much of what it sends comes late or twice."""
    rng = np.random.default_rng(seed)
    decoder, t_ns, counter, anew, arrivals = default_codec().decoder(), 0, 0, 0, []
    for _ in range(300):
        fate = rng.random()
        if fate < 0.005:
            counter, anew = 0, anew + 1
        elif fate < 0.01:
            t_ns += int(rng.integers(1, 40)) * CYCLE
        transfer = (
            frames(counter, fd, which=(counter + 50 * anew) % 256)
            if k == 1
            else mixture_frames(counter, k, fd, seed=anew)
        )
        for i, frame in enumerate(transfer):
            at = t_ns + i * MS // 4
            late = int(rng.integers(1, 300)) * MS
            fate = rng.random()
            if fate >= 0.1:
                arrivals.append((at + late * (fate < 0.1 + bad / 3), len(arrivals), frame))
            if fate > 1 - bad:
                arrivals.append((at + late // 10, len(arrivals), frame))
        counter, t_ns = (counter + k) % 256, t_ns + CYCLE
    for at, _, frame in sorted(arrivals):
        decoder.feed(frame.can_id, frame.data, at)
    assert not decoder.checks[SLOT].two_senders
    check_accounts(decoder)


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("gap_ms", [0, 150, 300, 10_000])
@pytest.mark.parametrize("late_ms", [60, 160, 300, 450])
def test_a_slower_path_repeats_nothing(late_ms, gap_ms, fd):
    """All comes over two gateways, and the faster one fails: nothing twice, nothing backwards."""
    arrivals = []
    for k in range(120):
        for i, frame in enumerate(frames(k, fd)):
            at = k * CYCLE + i * MS // 4
            if not 40 * CYCLE <= at < 40 * CYCLE + gap_ms * MS:
                arrivals.append((at, k, frame))
            arrivals.append((at + late_ms * MS, k, frame))
    decoder = default_codec().decoder()
    delivered = [
        k
        for at, k, frame in sorted(arrivals, key=lambda arrival: arrival[:2])
        if isinstance(decoder.feed(frame.can_id, frame.data, at), MapLine)
    ]
    assert delivered == sorted(set(delivered))
    assert len(delivered) >= 120 - (gap_ms + late_ms) // 50


@pytest.mark.parametrize("every", [1, 5, 10])
def test_a_slot_with_two_senders_is_not_usable(every):
    """However much slower one of them is, once that is known."""
    monitor = Monitor(decoder := default_codec().decoder())
    usable = 0
    for cycle in range(400):
        senders = [(0, 0)] + ([(20, 77)] if cycle % every == 0 else [])
        for ms, ahead in senders:
            counter = (cycle // every if ms else cycle) + ahead
            for i, frame in enumerate(frames(counter % 256, which=(counter + 9 * ms) % 256)):
                monitor.feed(frame.can_id, frame.data, cycle * CYCLE + ms * MS + i * MS // 4)
        usable += cycle >= 200 and monitor.latest(SLOT, cycle * CYCLE + 40 * MS).usable
    assert decoder.checks[SLOT].two_senders
    assert usable == 0


@pytest.mark.parametrize(("good", "certain"), [(10, True), (30, True), (40, False)])
def test_proofs_that_are_far_apart_do_not_add_up(good, certain):
    """Another record with a counter that was there, now and then, is an accident."""
    slot, t_ns = SequenceCheck(E2EConfig(), 256, 4, CYCLE), 0
    for k in range(12 * good):
        slot.received(k % 256, k, t_ns)
        if k % good == 0:
            assert slot.received(k % 256, -1, t_ns + 30 * MS) is Reason.STALE
        t_ns += CYCLE
    assert slot.two_senders is certain


@pytest.mark.parametrize(("share", "certain"), [(0.5, False), (0.7, False), (1.0, True)])
def test_all_that_comes_twice(share, certain):
    """As two senders of the same lines would do, and one line in a hundred is lost."""
    rng = np.random.default_rng(5)
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in range(400):
        for again in (False, True):
            if rng.random() < (share if again else 1) * 0.99:
                slot.received(k % 256, k, k * CYCLE + again * 10 * MS)
    assert slot.two_senders is certain


def test_a_second_sender_that_has_gone_is_forgotten():
    """After 256 cycles."""
    decoder = default_codec().decoder()
    slot = two_senders(decoder, 20, 40)
    assert slot.two_senders
    counter, t_ns = 40 + 40, 40 * CYCLE
    for _ in range(254):
        _, t_ns = run(decoder, [counter % 256], t_ns)
        counter += 1
    assert slot.two_senders
    run(decoder, [c % 256 for c in range(counter, counter + 4)], t_ns)
    assert not slot.two_senders


def test_a_line_lost_a_round_after_another_is_counted():
    """Where the counter stood at the last loss says nothing a round later."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in [*range(11), *range(12, 256 + 10), *range(256 + 11, 256 + 20)]:
        slot.received(k % 256, k % 256, k * CYCLE)
    assert slot.lost == 2


# ---- time ----------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 400), min_size=1, max_size=20))
def test_cycles_without_data_do_not_depend_on_who_asks(steps_ms):
    """One falls due 1.5 cycles after the last record, and one each cycle after that."""
    asked, once = (SequenceCheck(E2EConfig(), 256, 4, CYCLE) for _ in range(2))
    now = 0
    for slot in (asked, once):
        for k in range(10):
            slot.received(k, k, k * CYCLE)
    for step in steps_ms:
        now += step * MS
        asked.elapse(9 * CYCLE + now)
    once.elapse(9 * CYCLE + now)
    assert asked.statuses == once.statuses
    assert asked.state is once.state
    assert once.statuses[NONEWDATA] == max(0, (now + CYCLE // 2) // CYCLE - 1)


def test_a_clock_that_is_set_back_does_not_keep_a_slot_valid():
    """Silence is counted from the new time on."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in range(10):
        slot.received(k, k, 10**18 + k * CYCLE)
    assert slot.elapse(5) is VALID
    assert slot.elapse(5 + 7 * CYCLE) is INVALID


@pytest.mark.parametrize("asks_every_ms", [None, 10, 50, 200])
def test_a_backlog_is_not_missed_twice(asks_every_ms):
    """A receiver that was stopped takes old frames after it was asked: they were missed once."""
    slot, now, asked = SequenceCheck(E2EConfig(), 256, 4, CYCLE), 0, 0
    for k in range(10):
        slot.received(k, k, k * CYCLE)
    stopped, now = 9 * CYCLE, 9 * CYCLE + 2000 * MS
    slot.elapse(now)
    missed = slot.statuses[NONEWDATA]
    assert missed == 39
    for k in range(10, 40):  # at once, with the times at which they came
        slot.received(k, k, stopped + (k - 9) * CYCLE)
        now += MS
        if asks_every_ms and now - asked > asks_every_ms * MS:
            slot.elapse(now)
            asked = now
    assert slot.statuses[NONEWDATA] == missed
    slot.received(50, 50, now)
    assert slot.elapse(now + 74 * MS) is slot.state
    assert slot.statuses[NONEWDATA] <= missed + 1


def test_a_line_that_has_grown_stale_says_so():
    """After three cycles; its age counts from its pose, and the state follows at 275 ms."""
    codec = Codec.from_dbc()
    monitor = Monitor(codec.decoder())
    before = monitor.latest(SLOT, 0)
    assert before == (SLOT, None, np.inf, True, NODATA, None, False)
    for k in range(10):
        line = MapLine.mean_only(SLOT, [1.0 + k / 8, 0, 0, 0], age=0.04)
        for frame in codec.encode(line):
            monitor.feed(frame.can_id, frame.data, k * CYCLE)
    last = 9 * CYCLE
    for waited_ms, stale, state in [
        (0, False, VALID),
        (150, False, VALID),
        (151, True, VALID),
        (274, True, VALID),
        (275, True, INVALID),
        (10**6, True, INVALID),
    ]:
        view = monitor.latest(SLOT, last + waited_ms * MS)
        assert view.line.gaussian.mean[0] == pytest.approx(1.0 + 9 / 8, abs=1e-3)
        assert view.age == pytest.approx(0.04 + waited_ms / 1000)
        assert (view.stale, view.state) == (stale, state)
        assert view.usable == (not stale and state is VALID)


def test_what_is_stale_is_the_caller_s_choice():
    """By cycles of his own, and by the cycle time of the decoder."""
    monitor = Monitor(default_codec().decoder())
    slow = Monitor(default_codec().decoder(cycle_ms=200))
    for frame in frames(0):
        monitor.feed(frame.can_id, frame.data, 0)
        slow.feed(frame.can_id, frame.data, 0)
    assert monitor.latest(SLOT, 60 * MS, stale_cycles=1).stale
    assert not monitor.latest(SLOT, 400 * MS, stale_cycles=8).stale
    assert not slow.latest(SLOT, 600 * MS).stale
    assert slow.latest(SLOT, 601 * MS).stale
    assert monitor.latest(SLOT, -(10**12)).stale  # the clock was set back


def test_a_slot_that_the_dbc_does_not_have():
    """The message names those that it has."""
    with pytest.raises(ValueError, match=r"slot must be one of the DBC's, EGO_LEFT, .* got 99"):
        Monitor(default_codec().decoder()).latest(99, 0)


@pytest.mark.parametrize("cycle_ms", [0, -5, float("nan"), float("inf")])
def test_a_cycle_time_must_be_positive(cycle_ms):
    """The message names value and unit."""
    with pytest.raises(ValueError, match="cycle_ms must be more than 0 ms"):
        default_codec().decoder(cycle_ms=cycle_ms)


# ---- on a bus ----------------------------------------------------------------------------------


@pytest.fixture
def links():
    channel = f"e2e-{time.monotonic_ns()}"
    with (
        Link(interface="virtual", channel=channel) as one,
        Link(interface="virtual", channel=channel) as other,
    ):
        yield one, other


def wait_until(condition, timeout=20.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_a_controller_sees_a_slot_come_and_go(links):
    """Many threads at once ask for the newest line: VALID while lines come, then stale."""
    codec, wrong = Codec.from_dbc(), []
    decoder = codec.decoder(cycle_ms=100)  # and lines at 50 Hz: a busy machine is no fault here
    with Receiver(links[1], decoder, can_ids=codec.can_ids) as receiver:
        stop = threading.Event()

        def control():
            while not stop.is_set():
                view = receiver.latest(SLOT)
                if view.line is not None and view.age < view.line.age:
                    wrong.append(view)

        threads = [threading.Thread(target=control) for _ in range(3)]
        for thread in threads:
            thread.start()
        with Transmitter(links[0], codec, period=0.02) as transmitter:
            transmitter.publish(MapLine.mean_only(SLOT, [1.75, 0, 0, 0]))
            wait_until(lambda: receiver.latest(SLOT).usable)
        wait_until(lambda: receiver.latest(SLOT).stale)
        wait_until(lambda: receiver.latest(SLOT).state is INVALID)
        assert receiver.latest(SLOT).line.gaussian.mean[0] == 1.75
        stop.set()
        for thread in threads:
            thread.join()
        assert wrong == []
        assert list(receiver.slots()) == [SLOT]


def test_time_goes_by_the_clock_of_the_frames(links):
    """An adapter whose time stamps begin at power-up ages its lines all the same."""
    with Receiver(links[1], default_codec().decoder()) as receiver:
        start = time.monotonic()
        for counter in range(2):  # one alone may be of a backlog
            time.sleep(0.25 * counter)
            for frame in frames(counter):
                message = can.Message(
                    timestamp=12.5 + time.monotonic() - start,
                    arbitration_id=frame.can_id,
                    data=frame.data,
                    is_extended_id=False,
                )
                assert links[0].send(message) is Sent.OK
            assert receiver.get(20.0) is not None
        view = receiver.latest(SLOT)
        assert 0 <= view.age - view.line.age < 20.0
        assert receiver.latest(SLOT, now_ns=view.line.t_ns + 151 * MS).stale


def test_receive_prints_the_states_and_names_two_senders(links, capsys):
    """A note of each change, a summary of each slot, and in JSON the checks beside each line."""

    def send():
        for cycle in range(30):
            for ahead in (0, 77):
                for frame in frames(cycle + ahead, which=cycle + ahead):
                    links[0].send(
                        can.Message(
                            arbitration_id=frame.can_id, data=frame.data, is_extended_id=False
                        )
                    )
                time.sleep(0.03)

    bus = ["--interface", "virtual", "--channel", links[0].name.split()[1]]
    sender = threading.Timer(0.2, send)
    sender.start()
    assert main(["receive", *bus, "--timeout", "1", "--json"]) == 0
    sender.join()
    out, err = capsys.readouterr()
    last = json.loads(out.splitlines()[-1])["e2e"]
    assert last["two_senders"]
    assert last["state"] != "VALID"
    assert last["wrong_sequence"] > 8
    notes = [note for note in err.splitlines() if "ego left" in note]
    assert "ego left: INIT; 1 ok" in notes[0]
    assert "TWO SENDERS" in notes[-1]
    assert re.search(r"\d+ ok, \d+ lost, 0 repeated, \d+ wrong sequence, 0 errors", notes[-1])
