"""The signals of each covariance code, for the DBC writer."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from ...wire.layout.record_signals import PARAMETER_SIGNALS
from ..codes.integer_cholesky import ORDER, entry_name
from ..codes.triangle import PAIRS, half_name, triangle_name
from .dbc_writer import SignalSpec

#: Units of the states.
UNITS = ("m", "rad", "1/m", "1/m^2")
#: Units of the rows of Cholesky codes.
_UNIT_OF_ROW = {
    **dict(zip(PARAMETER_SIGNALS, UNITS, strict=True)),
    "Along": "m",
    "Across": "m",
    "Heading": "rad",
}
#: Largest standard deviations of the linear codes: a street turn with 10 deg of heading.
MAX_SIGMA = (4.0, 0.25, 0.0625, 0.015625)
#: log2 of the smallest standard deviation [octave], usually half a step of the mean.
MIN_OCTAVES = (-12.0, -18.0, -24.0, -32.0)


def covariance_signals(code: str, finer_bits: int = 0) -> tuple[SignalSpec, ...]:
    """Return the signals of a code.

    Args:
        code: a name of ``study.codes.CODES``.
        finer_bits: more bits for each signal, for finer steps; negative for fewer.

    Raises:
        ValueError: the code does not have such widths.
    """
    signals: Iterable[SignalSpec]
    match code:
        case "Cholesky":
            signals = (*_PIVOTS_AND_RATIOS, _INFLATION)
        case "LogCholesky":
            signals = _PIVOTS_AND_RATIOS
        case "IntegerCholesky":
            signals = (_SCALE_EXPONENT, *_integer_entries())
        case "Linear" | "LinearNearest":
            signals = _linear_triangle()
        case "LogCorrelation":
            signals = (*_sigmas(), *_correlations())
        case "Sigmas":
            signals = _sigmas()
        case "Float16" | "Float32":
            signals = _float_triangle(int(code.removeprefix("Float")))
        case _:
            signals = ()
    if finer_bits and code in ("Float16", "Float32", "MeanOnly"):
        raise ValueError(f"finer_bits must be 0 for {code}, got {finer_bits}")
    return tuple(_finer(spec, finer_bits) for spec in signals)


def _finer(spec: SignalSpec, bits: int) -> SignalSpec:
    if spec is _SCALE_EXPONENT:
        return spec
    if spec is _INFLATION:  # the inflation needed shrinks with the steps: its bits stay
        return replace(spec, factor=spec.factor / 2.0**bits)
    return spec.finer(bits)


# The numbers of a signal stand on one line, its texts below.
# fmt: off

# ---- the default code -----------------------------------------------------------------


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
_PIVOTS_AND_RATIOS = (
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
_INFLATION = SignalSpec(
    name="Inflation", bits=3, factor=0.0124, unit="octave",
    about="log2 of the factor on the whole covariance that makes up for rounding: the decoded "
          "covariance is 2^Inflation L L^T.",
    why="steps of 0.9 % of the variance; up to 6.2 %, enough for all but two roundings in a "
        "thousand")


# ---- codes for comparison -------------------------------------------------------------

_SCALE_EXPONENT = SignalSpec(
    name="ScaleExponent", bits=3, offset=-5, unit="octave",
    about="log2 of the common factor of all elements.",
    why="as in SBAS Message Type 28")


def _integer_entries() -> Iterator[SignalSpec]:
    for i in range(4):
        for j in range(i, 4):
            yield SignalSpec(
                name=entry_name(i, j), bits=9 if i == j else 10, signed=i != j,
                about=f"Element of the upper Cholesky factor, of {PARAMETER_SIGNALS[ORDER[i]]} and "
                      f"{PARAMETER_SIGNALS[ORDER[j]]}; units: 2^-8 m, 2^-12 rad, 2^-14 1/m, "
                      "2^-16 1/m^2.",
                why="as in SBAS Message Type 28")


def _linear_triangle() -> Iterator[SignalSpec]:
    for i, j in PAIRS:
        first, second = (f"{MAX_SIGMA[k]:g} {UNITS[k]}" for k in (i, j))
        yield SignalSpec(
            name=triangle_name(i, j), bits=16,
            factor=MAX_SIGMA[i] * MAX_SIGMA[j] * 2.0 ** (-16 if i == j else -15),
            unit=f"{UNITS[i]} {UNITS[j]}", signed=i != j,
            about=f"Covariance of {PARAMETER_SIGNALS[i]} and {PARAMETER_SIGNALS[j]}.",
            why=f"up to sigmas of {first} and {second}")


def _float_triangle(bits: int) -> Iterator[SignalSpec]:
    """Yield entries as binary32, or as bit patterns of binary16 (a DBC has no type for it)."""
    is_float = bits == 32
    for i, j in PAIRS:
        unit = f"{UNITS[i]} {UNITS[j]}"
        pattern = "" if is_float else ", as the bit pattern of IEEE 754 binary16"
        yield SignalSpec(
            name=triangle_name(i, j) if is_float else half_name(i, j), bits=bits,
            unit=unit if is_float else "", is_float=is_float,
            about=f"Covariance of {PARAMETER_SIGNALS[i]} and {PARAMETER_SIGNALS[j]} "
                  f"[{unit}]{pattern}.",
            why=f"a float{bits}")


def _sigmas() -> Iterator[SignalSpec]:
    for state, unit, least in zip(PARAMETER_SIGNALS, UNITS, MIN_OCTAVES, strict=True):
        yield SignalSpec(
            name=f"Sigma{state}", bits=8, factor=0.0625 if least > -20 else 0.109375, offset=least,
            unit="octave",
            about=f"log2 of the standard deviation of {state} [{unit}].",
            why="from the resolution of the mean upwards")


def _correlations() -> Iterator[SignalSpec]:
    for i, j in PAIRS:
        if i != j:
            yield SignalSpec(
                name=f"Corr{PARAMETER_SIGNALS[i]}{PARAMETER_SIGNALS[j]}", bits=8, factor=0.01,
                signed=True,
                about=f"Correlation of {PARAMETER_SIGNALS[i]} and {PARAMETER_SIGNALS[j]}.",
                why="steps of 1 %, as in ETSI's CorrelationCellValue")
