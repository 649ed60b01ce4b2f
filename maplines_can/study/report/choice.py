"""Recommendation of a covariance code for each number of frames, from the summary of a sweep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from .tables import Row, Tables, number, percent

#: A code with the same widths on every set of the sweep: its rows of the summary.
Variant = list[Row]


class Choice(NamedTuple):
    """Recommendation for a number of classic CAN frames, and its reason."""

    advice: str
    reason: str


def choices(tables: Tables) -> list[Choice]:
    """Return a recommendation for each number of frames at which it changes.

    A code is valid if every decoded covariance was positive definite and covered its target, on
    all sets. Of the valid ones that fit, the one with the least KL at 99 % of the Gaussians is
    best, on the set where that is largest.
    """
    variants = _variants(tables)
    found: list[Choice] = []
    last: Variant | None = None
    for frames in sorted({_frames(variant) for variant in variants}):
        fitting = [variant for variant in variants if _frames(variant) <= frames]
        valid = [variant for variant in fitting if not _fault(variant)]
        best = min(valid, key=_kl_99, default=None)
        if best is None:
            advice = f"For {_words(frames)} choose none."
            found.append(Choice(advice, f"No code that fits is valid: {_faults(fitting)}."))
        elif best is not last:
            found.append(_choice(frames, best, valid, fitting, is_first=last is None))
        last = best
    return found


def _choice(
    frames: int,
    best: Variant,
    valid: Sequence[Variant],
    fitting: Sequence[Variant],
    *,
    is_first: bool,
) -> Choice:
    row = best[0]
    finer = f" with {bits_more(row['finer_bits'])} in each field" if row["finer_bits"] else ""
    advice = (
        f"For {_words(frames)} choose {row['code']}{finer}: {row['covariance_bits']} bits for the "
        "covariance."
    )
    kl = _kl_99(best)
    reason = (
        f"On each set, 99 % of its Gaussians have a KL up to {number(kl)} nat, as if all four "
        f"standard deviations were {_wider(kl)} too large."
    )
    if not is_first:
        return Choice(advice, reason)
    by_construction = row["definite_guarantee"] and row["covering_guarantee"]
    others = {variant[0]["code"]: variant for variant in sorted(valid, key=_kl_99, reverse=True)}
    others.pop(row["code"])
    reason = (
        f"It is always positive definite and never overconfident"
        f"{', by construction' if by_construction else ' on these sets'}. {reason}"
    )
    if others:
        rest = ", ".join(f"{number(_kl_99(v))} nat with {code}" for code, v in others.items())
        reason += f" That is the least of the valid codes: {rest}."
    if faults := _faults([variant for variant in fitting if variant not in valid]):
        reason += f" The other codes that fit are not valid: {faults}."
    return Choice(advice, reason)


def _variants(tables: Tables) -> list[Variant]:
    """Return the codes with each of their widths for which all sets have results."""
    found: dict[tuple[str, int], Variant] = {}
    for row in tables.summary:
        found.setdefault((row["code"], row["finer_bits"]), []).append(row)
    return [rows for rows in found.values() if len(rows) == len(tables.sets)]


def _frames(variant: Variant) -> int:
    return int(variant[0]["classic_frames"])


def _kl_99(variant: Variant) -> float:
    """Return the KL at 99 % on the worst set; infinite if it is not defined."""
    return max(math.inf if math.isnan(row["kl_p99"]) else row["kl_p99"] for row in variant)


def _fault(variant: Variant) -> str:
    """Return why a variant is not valid; empty if it is."""
    if not variant[0]["covariance_bits"]:
        return "sends no covariance"
    for column, words in (
        ("not_positive_definite", "is not positive definite"),
        ("overconfident", "is overconfident"),
    ):
        if (most := max(row[column] for row in variant)) > 0:
            return f"{words} for up to {percent(most)} of the Gaussians"
    return ""


def _faults(variants: Sequence[Variant]) -> str:
    """Return why each code is not valid, for the widths nearest to those of its DBC."""
    nearest = {v[0]["code"]: v for v in sorted(variants, key=lambda v: -abs(v[0]["finer_bits"]))}
    return "; ".join(f"{code} {fault}" for code, v in nearest.items() if (fault := _fault(v)))


def _wider(kl: float) -> str:
    """Return by how much all four standard deviations exceed the true ones at this KL.

    With the variances r times the true ones, the KL is 2 (1/r - 1 + ln r) nat.

    >>> _wider(0.01), _wider(1e-4), _wider(15.0)
    ('5.2 %', '0.5 %', 'more than ten times')
    """
    low, high = 1.0, 10.0
    if kl > 2 * (1 / high**2 - 1 + 2 * math.log(high)):
        return "more than ten times"
    for _ in range(60):
        middle = (low + high) / 2
        below = 2 * (1 / middle**2 - 1 + 2 * math.log(middle)) < kl
        low, high = (middle, high) if below else (low, middle)
    return percent(float(f"{low - 1:.2g}"))


def bits_more(bits: int) -> str:
    """Return a change of a width in words.

    >>> bits_more(2), bits_more(-1)
    ('2 bits more', '1 bit less')
    """
    return f"{abs(bits)} bit{'s' * (abs(bits) != 1)} {'more' if bits > 0 else 'less'}"


def _words(frames: int) -> str:
    return f"{frames} classic CAN frame" + "s" * (frames != 1)
