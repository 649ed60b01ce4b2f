"""How far off the stated pose is while GNSS drifts."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplines_can.testing.sensor_faults import FaultedMeasurement, SensorFault

from .harness import evidence, progress
from .sensor_faults import SETUP, STEP, drive_of

Array = NDArray[np.float64]

#: Rate that filters are told, which know that GNSS drifts [m/s].
STATED = 0.04


@evidence(seeds=2, rates=(1.0,), seconds=20.0)
def gnss_drifts(
    seeds: int = 20, rates: tuple[float, ...] = (1.0, 0.3, 0.1), seconds: float = 130.0
) -> dict[str, Any]:
    """Let GNSS drift on a straight road without a map, and measure how far off the pose is.

        sigmas      largest error along or across in stated standard deviations, until no pose is
                    stated; the median and the worst of the cars, and the share within 4
        error       that of the same pose, median [m]
        said        median time until no pose is stated, and how many cars do so
        sigma       stated standard deviation in that axis at the end of the drift, median [m]

    Args:
        seeds: number of cars.
        rates: of the drift, along and across the road [m/s]; beside them, none.
        seconds: its duration [s].
    """
    result: dict[str, Any] = {}
    unknown = replace(SETUP.errors, gnss=None)
    for told, errors in (
        ("known", SETUP.errors),
        ("known, and its drift", replace(SETUP.errors, gnss_drift=STATED)),
        ("found out", unknown),
        ("found out, and its drift known", replace(unknown, gnss_drift=STATED)),
    ):
        drive = drive_of("straight road", seeds, errors, seconds + 1.0)
        cases = [(0.0, "none"), *((rate, axis) for rate in rates for axis in ("along", "across"))]
        for rate, axis in progress(cases, "drifts"):
            step = rate * np.array([axis == "along", axis == "across"])
            fault = SensorFault("gnss", "drift", partial(_drifted, rate=step))
            course = drive.run(fault, seconds, 0.0)
            of_axis = int(axis == "across")
            share = (np.abs(course.errors) / course.sigmas)[..., :2].max(axis=-1)
            until = np.logical_and.accumulate(course.known, axis=0)
            share = np.where(until, share, 0.0)
            worst = share.max(axis=0)
            size = np.hypot(course.errors[..., 0], course.errors[..., 1])
            said = ~until[-1]
            first = (~until).argmax(axis=0)[said] * STEP
            result[f"GNSS error {told}; {rate:g} m/s {axis}"] = {
                "sigmas, median": float(np.median(worst)),
                "sigmas, worst": float(worst.max()),
                "within 4 sigmas": float((worst <= 4.0).mean()),
                "error [m]": float(np.median(size[share.argmax(axis=0), np.arange(seeds)])),
                "said after [s]": float(np.median(first)) if said.any() else None,
                "cars that say so": int(said.sum()),
                "sigma [m]": float(np.median(course.sigmas[-1, :, of_axis])),
            }
    return result


def _drifted(at: FaultedMeasurement, rate: Array) -> Any:
    return at.one._replace(position=at.one.position + at.t * rate)
