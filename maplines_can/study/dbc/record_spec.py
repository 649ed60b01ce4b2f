"""The description of the record, from which its DBCs are written: each signal, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ...values.line import Status
from ..codes import CODES
from .covariance_spec import covariance_signals
from .dbc_writer import DbcWriter, SignalSpec, paged
from .pose_spec import AGE, CRC, KIND, POSE_WITH_LEVELS

# fmt: off
_PROTECTION = (
    CRC,
    SignalSpec(
        name="Counter", bits=8,
        about="Counts the records of the slot (AUTOSAR E2E profile 5). Its low four bits are the "
              "transfer number, which the other pages repeat.",
        why="profile 5 asks for 8 bits; 256 lines are 12.8 s at 20 Hz"),
)
_MEAN = (
    SignalSpec(
        name="YOff", bits=16, factor=2**-10, unit="m", signed=True,
        about="Lateral offset of the line at x = 0, positive to the left.",
        why="half a step is 0.5 mm; +-32 m holds four lanes to either side"),
    SignalSpec(
        name="Beta", bits=16, factor=2**-16, unit="rad", signed=True,
        about="Heading of the line relative to the car, positive to the left; tan(Beta) is the "
              "slope.",
        why="half a step is 0.6 mm at 80 m; +-28.6 deg"),
    SignalSpec(
        name="C0", bits=19, factor=2**-21, unit="1/m", signed=True,
        about="Curvature at x = 0: the second derivative of y(x), positive to the left.",
        why="half a step is 0.8 mm at 80 m; +-0.125 1/m is a radius of 8 m"),
    SignalSpec(
        name="C1", bits=26, factor=2**-30, unit="1/m^2", signed=True,
        about="Curvature rate: the third derivative of y(x).",
        why="a step is an eighth of the sigma of c1 given beta with a good pose, since coarser "
            "steps blur their correlation; a turn of radius 15 m needs 0.02 of the 0.031"),
)
_STATUS = SignalSpec(
    name="Status", bits=3, choices={status.value: status.name for status in Status},
    about="Validity of the covariance.", why="six values; 6 and 7 are refused")
_EXTENT = (
    SignalSpec(
        name="XMin", bits=3, factor=4, offset=-20, unit="m",
        about="Start of the range where the cubic is valid, rounded up: never too wide.",
        why="-20 to 8 m: from behind the car to where a line begins beside it"),
    SignalSpec(
        name="XMax", bits=5, factor=4, unit="m",
        about="End of the range where the cubic is valid, rounded down: never too wide.",
        why="0 to 124 m; in a roundabout a cubic holds for 15 m, of which steps of 8 m would "
            "leave a point"),
    AGE,
)
_COMPONENT = (
    SignalSpec(
        name="ComponentIndex", bits=3,
        about="Component of a Gaussian mixture, from 0.", why="8 components"),
    SignalSpec(
        name="ComponentCount", bits=3, offset=1,
        about="Number of components of the line; 1 is a plain Gaussian.", why="8 components"),
    SignalSpec(
        name="ComponentWeight", bits=5, factor=2**-5, offset=2**-5,
        about="Weight of the component.", why="steps of 1/32; no component has weight 0"),
)
# fmt: on
#: The signals of a record other than its covariance.
SERVICE = (*_PROTECTION, *_MEAN, _STATUS, KIND, *_EXTENT, *_COMPONENT)

_COVARIANCE = covariance_signals("Cholesky")
#: The writer of ``dbc/maplines.dbc``.
DEFAULT = DbcWriter(
    pages=(
        (*_PROTECTION, _MEAN[0], _MEAN[1], _STATUS, KIND),
        (_MEAN[2], _MEAN[3], *_EXTENT),
        (*_COVARIANCE[:5], *_COMPONENT),
        _COVARIANCE[5:],
    ),
    pose=POSE_WITH_LEVELS,
)
#: The writer of ``dbc/maplines-secoc.dbc``: the same, with an authenticated message for each slot.
SECURED = replace(DEFAULT, first_secured_can_id=0x350)


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
    names = [spec.name for spec in (*_MEAN, *covariance)]
    if unknown := [name for name in bits if name not in names]:
        raise ValueError(
            f"field_bits must be of {', '.join(names)}, got {', '.join(map(repr, unknown))}"
        )
    signals = [spec.finer(bits.get(spec.name, 0)) for spec in (*SERVICE, *covariance)]
    return DbcWriter(paged(signals), covariance_code=code)
