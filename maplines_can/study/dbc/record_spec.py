"""The one description of the wire: what a record holds, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ...line import Kind, Status
from ..codes import CODES
from .covariance_spec import covariance_signals
from .dbc_writer import DbcWriter, SignalSpec, paged

__all__ = ["DEFAULT", "SECURED", "SERVICE", "dbc_writer_for"]


_PROTECTION = (
    SignalSpec(
        "Crc",
        16,
        1,
        "",
        "CRC-16/CCITT-FALSE over all other bytes of the record, then the slot's E2EDataId, low "
        "byte first (AUTOSAR E2E profile 5).",
        "profile 5 asks for 16 bits, and for this place at the head of the record",
    ),
    SignalSpec(
        "Counter",
        8,
        1,
        "",
        "Counts the records of the slot (AUTOSAR E2E profile 5); its low four bits are the "
        "transfer number, which the other pages repeat.",
        "profile 5 asks for 8 bits; 256 lines are 12.8 s at 20 Hz",
    ),
)
_MEAN = (
    SignalSpec(
        "YOff",
        16,
        2**-10,
        "m",
        "Lateral offset of the line at x = 0, positive to the left.",
        "half a step is 0.5 mm; +-32 m holds four lanes to either side",
        signed=True,
    ),
    SignalSpec(
        "Beta",
        16,
        2**-16,
        "rad",
        "Heading of the line relative to the car, positive to the left; tan(Beta) is the slope.",
        "half a step is 0.6 mm at 80 m; +-28.6 deg",
        signed=True,
    ),
    SignalSpec(
        "C0",
        19,
        2**-21,
        "1/m",
        "Curvature at x = 0: the second derivative of y(x), positive to the left.",
        "half a step is 0.8 mm at 80 m; +-0.125 1/m is a radius of 8 m",
        signed=True,
    ),
    SignalSpec(
        "C1",
        26,
        2**-30,
        "1/m^2",
        "Curvature rate: the third derivative of y(x).",
        "a step is an eighth of what a good pose leaves open, since coarser ones blur how c1 goes "
        "with beta; a turn of radius 15 m needs 0.02 of the 0.031",
        signed=True,
    ),
)
_STATUS = SignalSpec(
    "Status",
    3,
    1,
    "",
    "What the covariance is worth.",
    "six values; 6 and 7 are refused",
    choices={status.value: status.name for status in Status},
)
_KIND = SignalSpec(
    "Kind",
    3,
    1,
    "",
    "What the line is on the road.",
    "eight values",
    choices={kind.value: kind.name for kind in Kind},
)
_EXTENT = (
    SignalSpec(
        "XMin",
        3,
        8,
        "m",
        "The cubic holds from here on. Rounded up: never claims too much.",
        "-32 to 24 m: from what lies behind the car to where a merging line begins",
        offset=-32,
    ),
    SignalSpec(
        "XMax",
        5,
        8,
        "m",
        "The cubic holds up to here. Rounded down: never claims too much.",
        "0 to 248 m, beyond the reach of any camera",
    ),
    SignalSpec(
        "Age",
        5,
        8,
        "ms",
        "Time from the pose to the sending, rounded up; 248 means this or more.",
        "a step is 24 cm of way at 30 m/s, along the line where it matters least",
    ),
)
_COMPONENT = (
    SignalSpec(
        "ComponentIndex", 3, 1, "", "Which component of a Gaussian mixture, from 0.", "8 components"
    ),
    SignalSpec(
        "ComponentCount",
        3,
        1,
        "",
        "How many components the line has; 1 is a plain Gaussian.",
        "8 components",
        offset=1,
    ),
    SignalSpec(
        "ComponentWeight",
        5,
        2**-5,
        "",
        "Weight of the component.",
        "steps of 1/32, and no component weighs nothing",
        offset=2**-5,
    ),
)
#: What a record holds besides its covariance.
SERVICE = (*_PROTECTION, *_MEAN, _STATUS, _KIND, *_EXTENT, *_COMPONENT)

_COVARIANCE = covariance_signals("Cholesky")
#: What ``dbc/maplines.dbc`` describes.
DEFAULT = DbcWriter(
    pages=(
        (*_PROTECTION, _MEAN[0], _MEAN[1], _STATUS, _KIND),
        (_MEAN[2], _MEAN[3], *_EXTENT),
        (*_COVARIANCE[:5], *_COMPONENT),
        _COVARIANCE[5:],
    )
)
#: What ``dbc/maplines-secoc.dbc`` describes: the same, and an authenticated message for each slot.
SECURED = replace(DEFAULT, first_secured_can_id=0x350)


def dbc_writer_for(
    code: str, finer_bits: int = 0, field_bits: Mapping[str, int] | None = None
) -> DbcWriter:
    """The writer of any covariance code, in as few pages as it fits.

    Args:
        code: a name of ``CODES``.
        finer_bits: so many bits more in each field of the covariance, for finer steps.
        field_bits: so many bits more in single fields, by name, over the same range: of the
            covariance or of the mean.

    Raises:
        ValueError: there is no such code or field, or it has no such widths.

    >>> [len(dbc_writer_for(code).pages) for code in ("MeanOnly", "Cholesky", "Float32")]
    [3, 4, 11]
    """
    if code not in CODES:
        raise ValueError(f"code must be one of {', '.join(CODES)}, got {code!r}")
    if code == DEFAULT.covariance_code and not finer_bits and not field_bits:
        return DEFAULT
    signals = (*SERVICE, *covariance_signals(code, finer_bits))
    if field_bits:
        names = [spec.name for spec in (*_MEAN, *signals[len(SERVICE) :])]
        if unknown := [name for name in field_bits if name not in names]:
            raise ValueError(
                f"field_bits must be of {', '.join(names)}, got {', '.join(map(repr, unknown))}"
            )
        signals = tuple(spec.finer(field_bits.get(spec.name, 0)) for spec in signals)
    return DbcWriter(paged(signals), covariance_code=code)
