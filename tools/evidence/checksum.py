"""Residual error probability of the checksum of a record, and rates per hour.

The checksum is CRC-16/CCITT over 240 transmitted bits and the 16 bits of the data ID, which are
not transmitted; with the checksum itself, 256 bits are transmitted. An error pattern is undetected
if the syndromes of its bits add up to 0. The syndromes are those of the package's own checksum, and
the numbers of undetected patterns are exact (MacWilliams' identity over the 2^16 checks). There are
no random numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from functools import cache
from math import comb, fsum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplines_can.bus import frame_bits
from maplines_can.model import e2e
from maplines_can.wire.protection.e2e_state import E2EConfig

from .harness import evidence

#: Bits of the checksum, of the data ID, and of a page; bytes of a record.
CRC_BITS, ID_BITS, PAGE_BITS, RECORD = 16, 16, 64, 32
#: Eight lines at 50 Hz, and the frames of a classic record.
RECORDS_PER_HOUR, PAGES = 8 * 50 * 3600, 4
#: 1 % of the targets of ASIL B and D for random hardware failures [1/h], as IEC 61784-3 allots it.
TARGETS = {"B": 1e-9, "D": 1e-10}
#: Share of the frames that are damaged on the bus, and of these, the share that the controllers do
#: not detect (CAN Specification 2.0, Bosch 1991).
DAMAGED, CAN_UNDETECTED = 1e-2, 4.7e-11
#: Hamming distance and bits of the CRC of CAN FD frames of 32 bytes (ISO 11898-1:2015).
FD_DISTANCE, FD_CRC_BITS = 6, 21
#: Bits of the MAC of dbc/maplines-secoc.dbc.
MAC_BITS = 64


@evidence
def checksum() -> dict[str, Any]:
    """Compute Hamming distance, undetected patterns and rates of undetected errors."""
    counts, with_id, bits = weights(), undetected_by_weight(syndromes(with_id=True)), syndromes()
    return {
        "Hamming distance, 256 transmitted bits": distance(counts),
        "Hamming distance with the data ID, 272 bits": distance(with_id),
        "undetected patterns of 4 bits": counts[4],
        "undetected patterns of 4 bits, with the data ID": with_id[4],
        "undetected patterns of an odd number of bits": sum(counts[1::2]),
        "undetected bursts of 16 bits or less": burst_counts(bits),
        "undetected share of changes of a page": {
            f"page {page}": float(random_page(page, bits)) for page in range(PAGES)
        },
        "rates [1/h]": rates(),
        "greatest bit error probability": {k: greatest_p(t, counts) for k, t in TARGETS.items()},
    }


def syndromes(record: int = RECORD, *, with_id: bool = False) -> NDArray[np.uint16]:
    """Return the change of the CRC by a flip of each bit, in the order of transmission.

    Args:
        record: length of the record [bytes].
        with_id: append the bits of the data ID, low byte first.
    """
    zeros = bytes(record)
    clean = e2e.checksum(zeros, 0, 0)

    def of_bit(bit: int) -> int:
        if bit >= 8 * record:
            place = bit - 8 * record
            return clean ^ e2e.checksum(zeros, 0, (0x80 >> place % 8) << place // 8 * 8)
        if bit < CRC_BITS:  # the checksum itself, low byte first
            return (0x80 >> bit % 8) << bit // 8 * 8
        flipped = bytearray(zeros)
        flipped[bit // 8] ^= 0x80 >> bit % 8
        return clean ^ e2e.checksum(bytes(flipped), 0, 0)

    return np.array([of_bit(bit) for bit in range(8 * record + ID_BITS * with_id)], np.uint16)


def undetected_by_weight(syndromes: NDArray[np.uint16]) -> list[int]:
    """Return the number of undetected patterns of 0, 1, 2, ... flipped bits, exactly.

    With B_j the number of checks that involve j of the n bits,

        A_w = 2^-16 sum_j B_j K_w(j),    K_w(j): coefficient of z^w in (1 - z)^j (1 + z)^(n - j)
    """
    n = len(syndromes)
    checks = np.arange(2**CRC_BITS, dtype=np.uint32)
    involved = np.zeros(2**CRC_BITS, dtype=np.int64)
    for syndrome in syndromes:
        involved += np.bitwise_count(checks & syndrome) & 1
    counts = [0] * (n + 1)
    column = [comb(n, w) for w in range(n + 1)]  # K_w(0)
    for number in np.bincount(involved, minlength=n + 1).tolist():
        if number:
            counts = [count + number * k for count, k in zip(counts, column, strict=True)]
        column = _next_column(column)
    return [count // 2**CRC_BITS for count in counts]


def _next_column(column: list[int]) -> list[int]:
    """Return the coefficients of P(z) (1 - z) / (1 + z), where 1 + z divides P(z)."""
    result, carry, last = [], 0, 0
    for value in column:
        carry = value - last - carry
        last = value
        result.append(carry)
    return result


@cache
def weights() -> list[int]:
    """Return the numbers of undetected patterns of a record by weight."""
    return undetected_by_weight(syndromes())


def residual(p: float, counts: list[int]) -> float:
    """Return the probability of an undetected error if each bit flips with probability p."""
    n = len(counts) - 1
    return fsum(a * p**w * (1 - p) ** (n - w) for w, a in enumerate(counts) if w and a)


def usable_residual(p: float, counts: list[int], config: E2EConfig | None = None) -> float:
    """Return an upper bound of the probability of an undetected error in a slot that is VALID.

    In VALID, ``min_ok_state_valid`` of the last ``window_size_valid`` records were accepted, this
    one included. So the bound is the residual times the probability that enough of the others were.
    """
    config = config or E2EConfig()
    undetected = residual(p, counts)
    accepted = (1 - p) ** (len(counts) - 1) + undetected
    others = config.window_size_valid - 1
    return undetected * at_least(config.min_ok_state_valid - 1, others, accepted)


def at_least(k: int, n: int, p: float) -> float:
    """Return the probability of k or more of n events of probability p."""
    return fsum(comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(k, n + 1))


def greatest_p(target: float, counts: list[int]) -> float:
    """Return the greatest bit error probability whose residual rate [1/h] meets a target."""
    low, high = 1e-9, 1e-3  # the residual increases between them
    for _ in range(60):
        middle = (low * high) ** 0.5
        meets = RECORDS_PER_HOUR * residual(middle, counts) <= target
        low, high = (middle, high) if meets else (low, middle)
    return low


def bursts(length: int, syndromes: NDArray[np.uint16]) -> Iterator[tuple[int, int]]:
    """Yield the start of each error burst, and the number of undetected ones of this length.

    A burst begins and ends with a flipped bit; those between are arbitrary: 2^(length - 2) of them.
    """
    for start in range(len(syndromes) - length + 1):
        sums = np.array([syndromes[start] ^ (syndromes[start + length - 1] if length > 1 else 0)])
        for inner in syndromes[start + 1 : start + length - 1]:
            sums = np.concatenate([sums, sums ^ inner])
        yield start, int((sums == 0).sum())


def random_page(page: int, syndromes: NDArray[np.uint16]) -> Fraction:
    """Return the share of all changes of one page that are undetected."""
    rank, basis = 0, [0] * CRC_BITS
    for value in syndromes[PAGE_BITS * page : PAGE_BITS * (page + 1)].tolist():
        for bit in reversed(range(CRC_BITS)):
            if not value >> bit & 1:
                continue
            if not basis[bit]:
                basis[bit], rank = value, rank + 1
                break
            value ^= basis[bit]
    return Fraction(2 ** (PAGE_BITS - rank) - 1, 2**PAGE_BITS - 1)


def burst_counts(bits: NDArray[np.uint16]) -> dict[str, int]:
    """Return the numbers of bursts of up to 16 bits, and of the undetected ones."""
    crossing = undetected = elsewhere = 0
    for length in range(1, CRC_BITS + 1):
        for start, missed in bursts(length, bits):
            if start < CRC_BITS < start + length:
                crossing += 2 ** max(length - 2, 0)
                undetected += missed
            else:
                elsewhere += missed
    return {
        "beside the end of the checksum": elsewhere,
        "across it": undetected,
        "of all across it": crossing,
    }


def can_fd_undetected(p: float) -> float:
    """Return an upper bound of the share of CAN FD frames whose error the controllers miss."""
    return at_least(FD_DISTANCE, sum(frame_bits(RECORD, is_fd=True)), p) * 2.0**-FD_CRC_BITS


def rates() -> dict[str, float]:
    """Return the rates of undetected errors [1/h] for each error model."""
    counts, share = weights(), 2.0**-CRC_BITS
    worst = max(usable_residual(p, counts) for p in np.geomspace(1e-4, 1e-1, 301).tolist())
    frames, n = RECORDS_PER_HOUR * PAGES, RECORDS_PER_HOUR
    on_bus, behind = "damaged on the bus,", "damaged behind the controllers: bit error probability"
    return {
        f"{on_bus} classic CAN: 1 % of the frames, of which the controllers miss 4.7e-11": frames
        * (DAMAGED * CAN_UNDETECTED * share),
        f"{on_bus} CAN FD: bit error probability 1e-4, Hamming distance 6 and 21 bits of the "
        "frame's CRC": n * can_fd_undetected(1e-4) * share,
        f"{behind} 1e-6": n * residual(1e-6, counts),
        "the same, 1e-5": n * residual(1e-5, counts),
        "the same, 1e-4": n * residual(1e-4, counts),
        "the same, worst bit error probability, slot VALID": n * worst,
        "one record an hour with a page of random or foreign content": share,
        "every record random, such as by a faulty sender": n * share,
        f"the same with SecOC, a MAC of {MAC_BITS} bits": n * 2.0**-MAC_BITS,
    }


def distance(counts: Iterable[int]) -> int:
    """Return the Hamming distance: the least number of flipped bits that can be undetected."""
    return next(w for w, count in enumerate(counts) if w and count)


def rates_table() -> str:
    """Return the rates as a table for docs/assurance.md."""
    lines = [
        "| error model | undetected [1/h] | 1e-9 (ASIL B) | 1e-10 (ASIL D) |",
        "|---|---:|---|---|",
    ]
    for name, rate in rates().items():
        verdict = (("met" if rate <= target else "**not met**") for target in TARGETS.values())
        number = f"{rate:.2g}" if rate >= 0.1 else f"{rate:.1e}"
        lines.append(f"| {name} | {number} | {' | '.join(verdict)} |")
    return "\n".join(lines)
