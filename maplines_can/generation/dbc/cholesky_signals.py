"""Signals of a Cholesky factor, and those of the covariance in the default DBC."""

from __future__ import annotations

from ...wire.layout.record_signals import PARAMETER_SIGNALS
from .record_pages import SignalSpec

#: Units of the states.
UNITS = ("m", "rad", "1/m", "1/m^2")
#: Units of the rows of Cholesky codes.
_UNIT_OF_ROW = {
    **dict(zip(PARAMETER_SIGNALS, UNITS, strict=True)),
    "Along": "m",
    "Across": "m",
    "Heading": "rad",
}


# The numbers of a signal stand on one line, its texts below.
# fmt: off


def ratio_signal(
    row: str, column: str, bits: int, factor: float, zero: float = 0.5, why: str = ""
) -> SignalSpec:
    """Return the signal of an entry left of the diagonal.

    Args:
        row: state of the row.
        column: state of the column.
        bits: width.
        factor: step.
        zero: position of 0 in the range, from 0 at its low end to 1 at its high end.
        why: reason for the range.
    """
    offset = -(2.0**bits) * zero * factor
    signed = zero == 0.5
    ends = offset, offset + 2**bits * factor
    reach = f"+-{ends[1]:g}" if signed else f"{ends[0]:g} to {ends[1]:g}"
    return SignalSpec(
        name=f"Ratio{row}{column}", bits=bits, factor=factor, offset=0 if signed else offset,
        signed=signed,
        about=f"Entry ({row}, {column}) of the lower Cholesky factor of the covariance, divided "
              f"by the pivot of {row}.",
        why=f"step {_fraction(factor)}: the expected KL of its rounding is step^2/24; range "
            f"{reach}, {why or 'as far as covariances of pose error alone need'}")


def _fraction(factor: float) -> str:
    numerator, denominator = factor.as_integer_ratio()
    return f"{numerator}/{denominator}" if 1 < denominator < 10**6 else f"{factor:g}"


def pivot_signal(
    state: str, given: tuple[str, ...], bits: int, factor: float, offset: float, why: str = ""
) -> SignalSpec:
    """Return the signal of a diagonal entry.

    Args:
        state: of the row.
        given: states of the rows before it.
        bits: width.
        factor: step [octave].
        offset: low end of the range [octave].
        why: reason for range and steps.
    """
    unit = _UNIT_OF_ROW[state]
    *first, last = given or ("",)
    of = f" given {', '.join(first)}{' and ' if first else ''}{last}" if given else ""
    return SignalSpec(
        name=f"Pivot{state}", bits=bits, factor=factor, offset=offset, unit="octave",
        about=f"log2 of the standard deviation of {state} [{unit}]{of}.",
        why=why or f"from the resolution of the mean, 2^{offset:g} {unit}, upwards in steps of "
                   f"{100 * (2**factor - 1):.2g} %")


#: The rows of the default DBC. ``maplines design`` computes them from the targets in
#: dbc/README.md, which also explains the order, the ranges and the steps.
PIVOTS_AND_RATIOS = (
    pivot_signal("C1", (), 9, 0.054, -32),
    pivot_signal("C0", ("C1",), 9, 0.0401, -23),
    ratio_signal("C0", "C1", 12, 1 / 32, zero=5 / 8),
    pivot_signal("YOff", ("C1", "C0"), 9, 0.034, -12),
    ratio_signal("YOff", "C0", 8, 3 / 64),
    ratio_signal(
        "YOff", "C1", 10, 3 / 64,
        why="for lines that begin ahead of the car, whose YOff depends on the shape"),
    pivot_signal("Beta", ("C1", "C0", "YOff"), 9, 0.0341, -18),
    ratio_signal("Beta", "C1", 14, 3 / 64, zero=1 / 8),
    ratio_signal("Beta", "C0", 14, 5 / 128),
    ratio_signal("Beta", "YOff", 8, 1 / 32, zero=3 / 8),
)
INFLATION = SignalSpec(
    name="Inflation", bits=3, factor=0.0124, unit="octave",
    about="log2 of the factor on the whole covariance that makes up for rounding: the decoded "
          "covariance is 2^Inflation L L^T.",
    why="steps of 0.9 % of the variance; up to 6.2 %, enough for all but two roundings in a "
        "thousand")
CHOLESKY = (*PIVOTS_AND_RATIOS, INFLATION)
# fmt: on
