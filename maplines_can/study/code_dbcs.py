"""The signals of each covariance code, and its DBC."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from ..generation.dbc.cholesky_signals import CHOLESKY, INFLATION, PIVOTS_AND_RATIOS, UNITS
from ..generation.dbc.dbc_writer import DbcWriter, paged
from ..generation.dbc.record_pages import SignalSpec
from ..generation.dbc.record_spec import DEFAULT, SERVICE
from ..wire.layout.record_signals import PARAMETER_SIGNALS
from .codes import CODES
from .codes.integer_cholesky import ORDER, entry_name
from .codes.triangle import PAIRS, half_name, triangle_name

#: Codes whose signals have no other widths.
FIXED_WIDTHS = ("Float16", "Float32", "MeanOnly")
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
            signals = CHOLESKY
        case "LogCholesky":
            signals = PIVOTS_AND_RATIOS
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
    if finer_bits and code in FIXED_WIDTHS:
        raise ValueError(f"finer_bits must be 0 for {code}, got {finer_bits}")
    return tuple(_finer(spec, finer_bits) for spec in signals)


def _finer(spec: SignalSpec, bits: int) -> SignalSpec:
    if spec is _SCALE_EXPONENT:
        return spec
    if spec is INFLATION:  # the inflation needed shrinks with the steps: its bits stay
        return replace(spec, factor=spec.factor / 2.0**bits)
    return spec.finer(bits)


def dbc_name(code: str) -> str:
    """Return the name of the DBC of a covariance code.

    >>> dbc_name("Cholesky"), dbc_name("Float16")
    ('maplines.dbc', 'maplines-float16.dbc')
    """
    return f"maplines-{code.lower()}.dbc" if code != DEFAULT.covariance_code else "maplines.dbc"


def dbc_named(name: str) -> str | None:
    """Return the text of the DBC with a ``dbc_name``; None if there is no such code."""
    codes = {dbc_name(code): code for code in CODES}
    return dbc_writer_for(codes[name]).dbc() if name in codes else None


def dbc_writer_for(
    code: str, finer_bits: int = 0, field_bits: Mapping[str, int] | None = None
) -> DbcWriter:
    """Return the writer for a covariance code, with as few pages as its signals fit on.

    Args:
        code: a name of ``CODES``.
        finer_bits: more bits for each field of the covariance, for finer steps.
        field_bits: more bits for single fields of the covariance or the mean, by name, over the
            same range.

    Raises:
        ValueError: there is no such code or field, or it does not have such widths.

    >>> [len(dbc_writer_for(code).pages) for code in ("MeanOnly", "Cholesky", "Float32")]
    [3, 4, 11]
    """
    if code not in CODES:
        raise ValueError(f"code must be one of {', '.join(CODES)}, got {code!r}")
    if code == DEFAULT.covariance_code and not finer_bits and not field_bits:
        return DEFAULT
    covariance = covariance_signals(code, finer_bits)
    bits = field_bits or {}
    names = [*PARAMETER_SIGNALS, *(spec.name for spec in covariance)]
    if unknown := [name for name in bits if name not in names]:
        raise ValueError(
            f"field_bits must be of {', '.join(names)}, got {', '.join(map(repr, unknown))}"
        )
    signals = [spec.finer(bits.get(spec.name, 0)) for spec in (*SERVICE, *covariance)]
    return DbcWriter(paged(signals), covariance_code=code)


# The numbers of a signal stand on one line, its texts below.
# fmt: off

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
