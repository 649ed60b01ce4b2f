"""The one description of the default wire: what ``dbc/maplines.dbc`` holds, and why."""

from __future__ import annotations

from ..line import Kind, Status
from .contract import Contract, SignalSpec

__all__ = ["DEFAULT"]


def _ratio(row: str, column: str, bits: int, factor: float) -> SignalSpec:
    return SignalSpec(
        f"Ratio{row}{column}",
        bits,
        factor,
        "",
        f"Part of {row} that goes with {column}: entry ({row}, {column}) of the lower Cholesky "
        f"factor of the covariance, divided by the pivot of {row}.",
        f"step 1/{round(1 / factor)}: the expected KL of its rounding is step^2/24; range "
        f"+-{2 ** (bits - 1) * factor:g}, as far as a pose-only covariance drives it",
        signed=True,
    )


def _pivot(state: str, unit: str, of: str, factor: float, offset: int) -> SignalSpec:
    return SignalSpec(
        f"Pivot{state}",
        9,
        factor,
        "octave",
        f"log2 of the standard deviation of {state} [{unit}]{of}.",
        f"from the resolution of the mean's own grid, 2^{offset} {unit}, upwards in steps of "
        f"{100 * (2**factor - 1):.1f} %",
        offset=float(offset),
    )


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
        "burst number, which the other pages repeat.",
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
_ROWS_1_2 = (
    _pivot("C1", "1/m^2", "", 0.054, -32),
    _pivot("Beta", "rad", " given C1", 0.034, -18),
    _ratio("Beta", "C1", 12, 1 / 16),
    _ratio("YOff", "C1", 8, 1 / 16),
    _ratio("YOff", "Beta", 9, 1 / 32),
)
_ROWS_3_4 = (
    _pivot("YOff", "m", " given C1 and Beta", 0.034, -12),
    _pivot("C0", "1/m", " given C1, Beta and YOff", 0.04, -23),
    _ratio("C0", "C1", 14, 1 / 16),
    _ratio("C0", "Beta", 14, 1 / 16),
    _ratio("C0", "YOff", 8, 1 / 16),
    SignalSpec(
        "Inflation",
        4,
        1 / 96,
        "octave",
        "log2 of the factor on the whole covariance that makes up for the rounding: the decoded "
        "covariance is 2^Inflation L L^T.",
        "steps of 0.7 % of the variance; up to 11 %, more than the rounding ever needs",
    ),
)

#: What ``dbc/maplines.dbc`` describes.
DEFAULT = Contract(
    pages=(
        (*_PROTECTION, _MEAN[0], _MEAN[1], _STATUS, _KIND),
        (_MEAN[2], _MEAN[3], *_EXTENT),
        (*_ROWS_1_2, *_COMPONENT),
        _ROWS_3_4,
    )
)
