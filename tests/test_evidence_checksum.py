"""The evidence of the checksum against brute force, on records that are short enough for it."""

from itertools import combinations, product
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evidence import checksum as tool

from maplines_can.model.e2e import StateMachine, Windows, checksum

PAGE = Path(__file__).parents[1] / "docs" / "assurance.md"


def words(bits: int) -> Any:
    """All patterns of so many bits, (2^bits, bits / 8) bytes."""
    return np.arange(2**bits, dtype=">u4").view(np.uint8).reshape(-1, 4)[:, 4 - bits // 8 :]


def weights_by_enumeration(record: int) -> list[int]:
    """Weights of all changes of a record that keep its checksum right: every data word once."""
    data = words(8 * (record - 2))
    records = np.concatenate([np.zeros((len(data), 2), np.uint8), data], axis=1)
    clean = checksum(bytes(record), 0, 0)
    crc = np.array([checksum(one.tobytes(), 0, 0) ^ clean for one in records])
    flips = np.bitwise_count(data).sum(axis=1) + np.bitwise_count(crc)
    return list(np.bincount(flips, minlength=8 * record + 1))


@pytest.mark.parametrize("record", [3, 4])
def test_weights_agree_with_enumeration(record: int) -> None:
    assert tool.undetected_by_weight(tool.syndromes(record)) == weights_by_enumeration(record)


def test_few_flips_agree_with_enumeration() -> None:
    """Of a whole record, with and without the data ID: sets of up to four syndromes."""
    for with_id in (False, True):
        bits = tool.syndromes(with_id=with_id).astype(int)
        counts = tool.undetected_by_weight(tool.syndromes(with_id=with_id))
        sums = np.bincount([a ^ b for a, b in combinations(bits, 2)], minlength=2**16)

        assert counts[0] == 1
        assert len(set(bits)) == len(bits)  # no two flips cancel
        assert 0 not in bits  # no one does
        assert counts[:3] == [1, 0, 0]
        assert counts[3] == sums[bits].sum() / 3 == 0
        # A set of four is three pairs of pairs with the same sum, which share no bit.
        assert counts[4] == sum(comb(int(n), 2) for n in sums) / 3


@pytest.mark.parametrize("length", [1, 2, 3, 9])
def test_bursts_agree_with_enumeration(length: int) -> None:
    bits = tool.syndromes(4).astype(int)
    for start, undetected in tool.bursts(length, tool.syndromes(4)):
        found = 0
        for inner in product((0, 1), repeat=max(length - 2, 0)):
            pattern = (1, *inner, 1)[:length] if length > 1 else (1,)
            xor = 0
            for place, flipped in enumerate(pattern):
                xor ^= bits[start + place] * flipped
            found += xor == 0
        assert undetected == found


def test_the_bound_of_a_valid_slot_agrees_with_a_simulation() -> None:
    """The state machine itself, on records that are accepted and wrong at random."""
    rng, accepted_share, wrong_share, n = np.random.default_rng(3), 0.75, 0.05, 40_000
    machine, used = StateMachine(Windows()), 0
    for accepted, wrong in zip(
        rng.random(n) < accepted_share, rng.random(n) < wrong_share / accepted_share, strict=True
    ):
        machine.step("OK" if accepted else "ERROR")
        used += bool(accepted and wrong and machine.state == "VALID")
    bound = wrong_share * tool.at_least(5, 9, accepted_share)
    assert 0 < used / n < bound + 4 * (bound / n) ** 0.5


def test_the_figures_of_the_page() -> None:
    """Those in the text of docs/assurance.md are those of the tool."""
    page, figures = PAGE.read_text(encoding="utf-8"), tool.checksum()
    bursts = figures["undetected bursts of 16 bits or less"]
    counts = [figures["undetected patterns of 4 bits"], comb(256, 4), bursts["of all across it"]]
    counts += [figures["undetected patterns of 4 bits, with the data ID"]]
    assert bursts["across it"] == 2
    assert "misses two of" in page
    for count in counts:
        assert (f"{count:_}".replace("_", " ") if count > 9999 else str(count)) in page
    for p in figures["greatest bit error probability"].values():
        assert f"{p:.1e}".replace("e-0", "e-") in page
