"""Signals of each covariance code, for the DBC writer."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

from ...wire.message.layout import STATE_SIGNALS
from ..codes.floats import half_name
from ..codes.integer_cholesky import ORDER, entry_name
from ..codes.linear import PAIRS, triangle_name
from .dbc_writer import SignalSpec

__all__ = ["covariance_signals", "pivot_signal", "ratio_signal"]


def ratio_signal(
    row: str, column: str, bits: int, factor: float, zero: float = 0.5, why: str = ""
) -> SignalSpec:
    """The signal of an entry left of the diagonal.

    Args:
        row: state of the row.
        column: state of the column.
        bits: width.
        factor: step.
        zero: where in the range 0 lies, from 0 at its low end to 1 at its high one.
        why: what the range is made for.
    """
    offset = -(2.0**bits) * zero * factor
    signed = zero == 0.5
    ends = offset, offset + 2**bits * factor
    reach = f"+-{ends[1]:g}" if signed else f"{ends[0]:g} to {ends[1]:g}"
    return SignalSpec(
        f"Ratio{row}{column}",
        bits,
        factor,
        "",
        f"Part of {row} that goes with {column}: entry ({row}, {column}) of the lower Cholesky "
        f"factor of the covariance, divided by the pivot of {row}.",
        f"step {_fraction(factor)}: the expected KL of its rounding is step^2/24; range "
        f"{reach}, {why or 'as far as a pose-only covariance drives it'}",
        offset=0.0 if signed else offset,
        signed=signed,
    )


def _fraction(factor: float) -> str:
    numerator, denominator = factor.as_integer_ratio()
    return f"{numerator}/{denominator}" if 1 < denominator < 10**6 else f"{factor:g}"


def pivot_signal(
    state: str, given: tuple[str, ...], bits: int, factor: float, offset: float
) -> SignalSpec:
    """The signal of a diagonal entry.

    Args:
        state: of the row.
        given: states of the rows before it.
        bits: width.
        factor: step [octave].
        offset: low end of the range [octave].
    """
    unit = UNIT_OF_STATE[state]
    *first, last = given or ("",)
    of = f" given {', '.join(first)}{' and ' if first else ''}{last}" if given else ""
    return SignalSpec(
        f"Pivot{state}",
        bits,
        factor,
        "octave",
        f"log2 of the standard deviation of {state} [{unit}]{of}.",
        f"from the resolution of the mean's own grid, 2^{offset:g} {unit}, upwards in steps of "
        f"{100 * (2**factor - 1):.2g} %",
        offset=float(offset),
    )


#: Units of the states.
UNIT_OF_STATE = dict(zip(STATE_SIGNALS, ("m", "rad", "1/m", "1/m^2"), strict=True))
#: The rows of the default wire. They are what ``maplines design`` makes of the targets in
#: dbc/README.md, where also is told why this order, these ranges and steps.
PIVOTS_AND_RATIOS = (
    pivot_signal("C1", (), 9, 0.054, -32),
    pivot_signal("C0", ("C1",), 9, 0.0401, -23),
    ratio_signal("C0", "C1", 12, 1 / 32, zero=5 / 8),
    pivot_signal("YOff", ("C1", "C0"), 9, 0.034, -12),
    ratio_signal("YOff", "C1", 8, 5 / 128),
    ratio_signal("YOff", "C0", 8, 3 / 64),
    pivot_signal("Beta", ("C1", "C0", "YOff"), 9, 0.0341, -18),
    ratio_signal("Beta", "C1", 15, 3 / 64, zero=1 / 8),
    ratio_signal("Beta", "C0", 15, 5 / 128),
    ratio_signal("Beta", "YOff", 8, 1 / 32, zero=3 / 8),
)


INFLATION = SignalSpec(
    "Inflation",
    3,
    0.0124,
    "octave",
    "log2 of the factor on the whole covariance that makes up for the rounding: the decoded "
    "covariance is 2^Inflation L L^T.",
    "steps of 0.9 % of the variance; up to 6.2 %, what all but two in a thousand roundings need",
)


#: Units of the states, in the order of a mean.
UNITS = tuple(UNIT_OF_STATE.values())
#: Largest standard deviations that linear entries hold: a street turn with 10 deg of heading.
LARGEST_SIGMA = (4.0, 0.25, 0.0625, 0.015625)
#: log2 of the least standard deviation [octave], half a step of the mean as a rule.
LEAST_OCTAVES = (-12.0, -18.0, -24.0, -32.0)


def _finer(specs: Iterable[SignalSpec], finer_bits: int) -> tuple[SignalSpec, ...]:
    return tuple(spec.finer(finer_bits) for spec in specs)


def _log_cholesky(finer_bits: int) -> tuple[SignalSpec, ...]:
    return _finer(PIVOTS_AND_RATIOS, finer_bits)


def _cholesky(finer_bits: int) -> tuple[SignalSpec, ...]:
    # The inflation needed shrinks with the steps, so it needs no bits of its own for that.
    inflation = replace(INFLATION, factor=INFLATION.factor / 2.0**finer_bits)
    return (*_log_cholesky(finer_bits), inflation)


def _integer_cholesky(finer_bits: int) -> tuple[SignalSpec, ...]:
    exponent = SignalSpec(
        "ScaleExponent",
        3,
        1,
        "octave",
        "log2 of what multiplies all elements of the factor.",
        "as SBAS Message Type 28",
        offset=-5,
    )
    entries = (
        SignalSpec(
            entry_name(i, j),
            9 if i == j else 10,
            1,
            "",
            f"Element of the upper Cholesky factor, of {STATE_SIGNALS[ORDER[i]]} and "
            f"{STATE_SIGNALS[ORDER[j]]}; units: 2^-8 m, 2^-12 rad, 2^-14 1/m, 2^-16 1/m^2.",
            "as SBAS Message Type 28",
            signed=i != j,
        )
        for i in range(4)
        for j in range(i, 4)
    )
    return (exponent, *_finer(entries, finer_bits))


def _linear(finer_bits: int) -> tuple[SignalSpec, ...]:
    specs = (
        SignalSpec(
            triangle_name(i, j),
            16,
            LARGEST_SIGMA[i] * LARGEST_SIGMA[j] * 2.0 ** (-16 if i == j else -15),
            f"{UNITS[i]} {UNITS[j]}",
            f"Covariance of {STATE_SIGNALS[i]} and {STATE_SIGNALS[j]}.",
            f"up to sigmas of {LARGEST_SIGMA[i]:g} {UNITS[i]} and {LARGEST_SIGMA[j]:g} {UNITS[j]}",
            signed=i != j,
        )
        for i, j in PAIRS
    )
    return _finer(specs, finer_bits)


def _sigmas(finer_bits: int) -> tuple[SignalSpec, ...]:
    specs = (
        SignalSpec(
            f"Sigma{state}",
            8,
            0.0625 if least > -20 else 0.109375,
            "octave",
            f"log2 of the standard deviation of {state} [{unit}].",
            "from the mean's own resolution upwards",
            offset=least,
        )
        for state, unit, least in zip(STATE_SIGNALS, UNITS, LEAST_OCTAVES, strict=True)
    )
    return _finer(specs, finer_bits)


def _log_correlation(finer_bits: int) -> tuple[SignalSpec, ...]:
    correlations = (
        SignalSpec(
            f"Corr{STATE_SIGNALS[i]}{STATE_SIGNALS[j]}",
            8,
            0.01,
            "",
            f"Correlation of {STATE_SIGNALS[i]} and {STATE_SIGNALS[j]}.",
            "steps of 1 %, as ETSI's CorrelationCellValue",
            signed=True,
        )
        for i, j in PAIRS
        if i != j
    )
    return (*_sigmas(finer_bits), *_finer(correlations, finer_bits))


def _float_triangle(code: str, bits: int, finer_bits: int) -> tuple[SignalSpec, ...]:
    _refuse_widths(f"for {code}", finer_bits)
    is_float = bits == 32
    pattern = "" if is_float else ", as the bit pattern of IEEE 754 binary16"
    return tuple(
        SignalSpec(
            (triangle_name if is_float else half_name)(i, j),
            bits,
            1.0,
            f"{UNITS[i]} {UNITS[j]}" if is_float else "",
            f"Covariance of {STATE_SIGNALS[i]} and {STATE_SIGNALS[j]} "
            f"[{UNITS[i]} {UNITS[j]}]{pattern}.",
            f"a float{bits}",
            is_float=is_float,
        )
        for i, j in PAIRS
    )


def _mean_only(finer_bits: int) -> tuple[SignalSpec, ...]:
    _refuse_widths("where no covariance is sent", finer_bits)
    return ()


def _refuse_widths(why: str, finer_bits: int) -> None:
    if finer_bits:
        raise ValueError(f"finer_bits must be 0 {why}, got {finer_bits}")


_SIGNALS: dict[str, Callable[[int], tuple[SignalSpec, ...]]] = {
    "Cholesky": _cholesky,
    "LogCholesky": _log_cholesky,
    "IntegerCholesky": _integer_cholesky,
    "Linear": _linear,
    "LinearNearest": _linear,
    "LogCorrelation": _log_correlation,
    "Float16": partial(_float_triangle, "Float16", 16),
    "Float32": partial(_float_triangle, "Float32", 32),
    "Sigmas": _sigmas,
    "MeanOnly": _mean_only,
}


def covariance_signals(code: str, finer_bits: int = 0) -> tuple[SignalSpec, ...]:
    """Return the signals of a code.

    Args:
        code: a name of ``study.codes.CODES``.
        finer_bits: extra bits of each signal, all of them for finer steps; negative for fewer.

    Raises:
        ValueError: the code has no such widths.
    """
    return _SIGNALS[code](finer_bits)
