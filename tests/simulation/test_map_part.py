"""Whether the stated map error is right: drives on a map with errors, against the true one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from maplines_can import Codec, MapError, MapLine, Polyline, Slot
from maplines_can.bus import LogWriter, read_log
from maplines_can.maps import Lane, LaneTracker, Map, Road
from maplines_can.maps.line_source import LineSource
from maplines_can.simulation.accuracy import Accuracy, MapPart, accuracy_of
from maplines_can.simulation.pose_source import PoseSource
from maplines_can.simulation.sender_consistency import (
    MapConsistency,
    MapVerdict,
    map_consistency_of,
)
from maplines_can.simulation.trajectory import drive_along
from maplines_can.simulation.transmission import Transmission, TruthRecorder
from maplines_can.simulation.truth import TruthWriter, read_truth
from maplines_can.wire import Reason

Array = NDArray[np.float64]
SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
LENGTH, SPACING, RATE = 2400.0, 2.0, 5.0
GOOD_POSE = (0.02, 0.02, np.radians(0.02))


def road_map(shift: Callable[[Array], Array]) -> Map:
    """A road with bends of 500 m and more; its points are shifted by (n, 2) [m]."""
    x = np.arange(0.0, LENGTH, SPACING)
    left, right, centre = (
        Polyline((points := np.column_stack([x, y + 20 * np.sin(x / 100)])) + shift(points))
        for y in (1.75, -1.75, 0.0)
    )
    lane = Lane("1", left, right, centre, road="A")
    return Map({"1": lane}, {"A": Road("A", "", lane.length, ("1",))})


def drift(sigma: float, length: float) -> Callable[[Array], Array]:
    """Errors that all lines have in common at a place: noise, smoothed over a length [m]."""
    n = int(LENGTH / SPACING)
    frequency = np.fft.rfftfreq(n, SPACING)
    smooth = np.exp(-((2 * np.pi * frequency * length) ** 2) / 2)[:, None]
    white = np.random.default_rng(11).normal(size=(n, 2))
    error = np.fft.irfft(np.fft.rfft(white, axis=0) * smooth, n, axis=0)
    error *= sigma / error.std(axis=0)
    return lambda _: error


def noise(sigma: float) -> Callable[[Array], Array]:
    rng = np.random.default_rng(12)
    return lambda points: rng.normal(0, sigma, points.shape)


def drive(
    folder: Path,
    shift: Callable[[Array], Array],
    stated: MapError | None,
    sigma: tuple[float, float, float] = GOOD_POSE,
    slots: tuple[Slot, ...] = SLOTS[:1],
) -> Accuracy:
    """The accuracy of a drive of 90 s on a map with errors."""
    true, wrong = road_map(np.zeros_like), road_map(shift)
    route = true.route("1", "1")
    car = drive_along(true, route, default_speed=25.0)
    states = car.at(car.times(RATE)[:450])
    source = LineSource(wrong, PoseSource(sigma, 5.0, seed=3).pose, slots, map_error=stated)
    log, table = folder / "drive.log", folder / "drive.csv"
    with TruthWriter(table, slots) as writer:
        truth = TruthRecorder(writer, LaneTracker(true), slots)
        sent = Transmission(
            source, states, 1 / RATE, Codec.from_dbc(), False, (500_000, None),
            lambda start: LogWriter(log, start), truth, lambda *_: None,
        )  # fmt: skip
        sent.simulate(1_700_000_000_000_000_000, lambda _: None)
    decoder = Codec.from_dbc().decoder()
    lines: list[MapLine] = []
    for frame in read_log(log):
        found = decoder.feed(frame.can_id, frame.data, frame.t_ns)
        lines += [] if isinstance(found, Reason) else found
    return accuracy_of(read_truth(table), lines)


def verdict(accuracy: Accuracy) -> MapConsistency:
    found = map_consistency_of(accuracy)
    assert found is not None
    return found


SURVEY = drift(0.1, 50.0)
CASES = [
    pytest.param(SURVEY, MapError(0.0, 0.1, 0.0), MapVerdict.RIGHT, id="drift-right"),
    pytest.param(SURVEY, MapError(0.0, 0.6, 0.0), MapVerdict.TOO_LARGE, id="drift-large"),
    pytest.param(noise(0.05), MapError(0.05), MapVerdict.RIGHT, id="noise-right"),
    pytest.param(noise(0.05), None, MapVerdict.RIGHT, id="noise-seen"),
]


@pytest.mark.parametrize(("shift", "stated", "expected"), CASES)
def test_the_verdict(
    tmp_path: Path, shift: Callable[[Array], Array], stated: MapError | None, expected: MapVerdict
) -> None:
    """One line tells, since the truth has the pose error."""
    found = verdict(drive(tmp_path, shift, stated))
    assert found.verdict is expected, found
    assert expected.value in found.text()


def test_two_lines_tell_as_well(tmp_path: Path) -> None:
    """No line tells without the reported poses, as of a car that does not know its pose."""
    accuracy = drive(tmp_path, SURVEY, None, slots=SLOTS)
    assert verdict(accuracy).verdict is MapVerdict.TOO_SMALL
    unknown = np.full_like(accuracy.of_map.error, np.nan)
    assert map_consistency_of(replace(accuracy, of_map=MapPart(unknown, unknown, unknown))) is None


def test_the_sigma_of_a_pose_hides_that_of_the_map(tmp_path: Path) -> None:
    """Of 0.5 m, the covariance on the wire does not tell 1 cm of the map."""
    found = verdict(drive(tmp_path, np.zeros_like, None, sigma=(0.5, 0.5, np.radians(0.5))))

    assert found.verdict is MapVerdict.HIDDEN
    assert "a better pose tells" in found.text()


def test_the_pose_error_is_no_error_of_the_map(tmp_path: Path) -> None:
    """Errors of 10 cm and 0.1 degrees leave less than 2 cm of an exact map."""
    accuracy = drive(tmp_path, np.zeros_like, None, sigma=(0.1, 0.1, np.radians(0.1)))
    lateral = accuracy.errors["lateral"]

    assert np.nanstd(lateral) > 0.05
    assert np.nanstd(accuracy.of_map.error) < 0.02
