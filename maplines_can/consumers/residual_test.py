"""Test of whether residuals with errors that last are plausible, with a rate of false alarms."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .residual_filter import (
    SLOW,
    WHITE_NOISE,
    CameraNoise,
    ResidualFilter,
    ResidualModel,
    outlier_weight,
    threshold,
)

#: The longest window has about this many correlation times of the pose error, and at least
#: ``SLOW``: for so long, the filter takes what grows slowly for an error of a map or of a camera.
#: A lasting fault of b standard deviations adds b^2 / 2 to the noncentrality of the sum for each.
#: In longer windows, the test would find what it is not for, such as small errors that last
#: longer than the model says.
CORRELATION_TIMES = 8.0
#: Longest correlation time that counts for the windows [s].
MAX_TIME = 60.0
#: The shortest window of more than one cycle [s].
SHORTEST = 0.125
#: Ratio of the lengths of windows. With 2, every tenth alarm would be that of two windows.
RATIO = 4.0
#: Most false alarms that can be designed [1/h].
MAX_ALARMS = 10.0
HOUR = 3600.0
#: Numbers of images in the sums that are tested in each image, in Gaussian noise and with heavy
#: tails.
SINGLE, SPANS = (1,), (4, 6, 8)


class ConsistencyResult(NamedTuple):
    """Result of a test. Each field is of the shape of the batch."""

    statistic: NDArray[np.float64]  #: the largest one of this cycle, in units of its threshold
    alarm: NDArray[np.bool_]
    raised: NDArray[np.bool_]  #: the alarm begins in this cycle


class ConsistencyTest:
    """Chi-square test of residuals with at most a designed number of false alarms per hour.

    The innovations of ``ResidualFilter`` are whitened. Tested are each of them, and their sums in
    windows of 1/8, 1/2, 2, ... seconds, one after another, up to about 8 correlation times, and at
    least 32 s::

        1/8 s  |--|--|--|--|--|--|--|--|
        1/2 s  |-----------|-----------|     each is tested when it ends
        2 s    |--------------------------

    Without a fault, the squared norm of a sum of N, over N, is chi-square distributed, and windows
    of one length are independent. A window of the length W fails with the probability
    ``rate W / J``; so each of the J lengths contributes the same number of false alarms per hour,
    and they add up to the designed one. Single innovations detect what jumps; the sums, what grows
    or lasts. If a correlation time is known within a range only, the covariance of a sum is less
    than that of white innovations, and so is the number of false alarms.

    If the noise has heavy tails, an outlier counts with the length of ``OUTLIERS`` only, and the
    sums of the last ``SPANS`` innovations take the place of each of them.

    Each set of residuals has windows of its own, in the time in which it is seen.

    An alarm lasts until no test has failed for the longest window. A fault that lasts fails in it
    again, so it is one alarm.

    Args:
        false_alarms: expected number [1/h].
        batch: shape of the leading axes of the residuals.
        noise: what is known of the noise.

    Raises:
        ValueError: the number is not more than 0 and at most 10.
    """

    def __init__(
        self,
        false_alarms: float,
        batch: tuple[int, ...] = (),
        noise: CameraNoise = WHITE_NOISE,
    ) -> None:
        if not 0 < false_alarms <= MAX_ALARMS:
            raise ValueError(
                f"false_alarms must be more than 0 and up to {MAX_ALARMS:g} per hour, "
                f"got {false_alarms!r}"
            )
        self._rate = false_alarms / HOUR
        self._batch, self._noise = batch, noise
        self._filter = ResidualFilter(batch, noise)
        self._recent: dict[int, _Recent] = {}
        self._spans = SPANS if noise.heavy_tails else SINGLE
        self._windows: dict[object, _Windows] = {}
        self._lasting = _Lasting(batch)
        self._calm = np.full(batch, np.inf)  # time since a test failed [s]

    def step(
        self,
        z: NDArray[np.float64],
        model: ResidualModel,
        dt: float,
        correlation_time: float | tuple[float, float],
        turn: float = 0.0,
        keys: tuple[object, ...] | None = None,
        kept: NDArray[np.float64] | None = None,
    ) -> ConsistencyResult:
        """Test (..., n) residuals.

        Args:
            z: the residuals.
            model: their covariances.
            dt: time since the last ones [s].
            correlation_time: of the pose error, or the shortest and the longest that it may have
                [s].
            turn: of the car within this time [rad].
            keys: identities of the residuals; None: the same as before.
            kept: see ``ResidualFilter.predict``.
        """
        self._filter.predict(model, dt, correlation_time, turn, keys, kept)
        w, response = self._filter.update(z, model)
        lengths = window_lengths(float(np.max(correlation_time)))
        # Lines that come and go do not begin the windows of the others anew.
        key = (w.shape[-1] if keys is None else keys), len(lengths)
        if key not in self._windows:
            self._windows[key] = _Windows(lengths, self._batch, w.shape[-1])
        share = self._rate / (len(lengths) + len(self._spans) + 1)
        if self._noise.heavy_tails:
            w = w * np.sqrt(outlier_weight(w))
        recent = self._recent.setdefault(w.shape[-1], _Recent(self._spans)).add(w, dt, share)
        statistic = np.maximum(recent, self._windows[key].add(w, dt, share))
        statistic = np.maximum(statistic, self._lasting.add(w, response[1:], dt, share))
        failed = statistic > 1
        alarmed = self._calm <= lengths[-1]
        self._calm = np.where(failed, 0.0, self._calm + dt)
        return ConsistencyResult(statistic, self._calm <= lengths[-1], failed & ~alarmed)


class _Recent:
    """Sums of the last whitened innovations, which are tested in each image.

    Args:
        spans: numbers of images.
    """

    def __init__(self, spans: tuple[int, ...]) -> None:
        self.spans = spans
        self._last: deque[NDArray[np.float64]] = deque(maxlen=max(spans))

    def add(self, w: NDArray[np.float64], dt: float, rate: float) -> NDArray[np.float64]:
        """Add (..., n) innovations; return the largest statistic of the sums that end with them.

        Args:
            w: whitened innovations.
            dt: time since the last ones [s].
            rate: false alarms per second for each span.

        Returns:
            (...,) in units of the thresholds.
        """
        self._last.appendleft(w)
        limit = threshold(rate * min(dt, SHORTEST), w.shape[-1])
        largest, total = np.zeros(w.shape[:-1]), np.zeros(w.shape)
        for k, one in enumerate(self._last, 1):
            total = total + one
            if k in self.spans:
                largest = np.maximum(largest, (total**2).sum(axis=-1) / (k * limit))
        return largest


class _Windows:
    """Sums of whitened innovations in windows of several lengths.

    Args:
        lengths: of the windows, ascending [s].
        batch: shape of the leading axes of the innovations.
        n: number of innovations in a cycle.
    """

    def __init__(self, lengths: NDArray[np.float64], batch: tuple[int, ...], n: int) -> None:
        self.lengths, self.n = lengths, n
        self._time = 0.0
        self._sums = np.zeros((len(lengths), *batch, n))
        self._counts = np.zeros(len(lengths))
        self._durations = np.zeros(len(lengths))

    def add(self, w: NDArray[np.float64], dt: float, rate: float) -> NDArray[np.float64]:
        """Add (..., n) innovations; return the largest statistic of the windows that end.

        Args:
            w: whitened innovations.
            dt: time since the last ones [s].
            rate: false alarms per second for each length.

        Returns:
            (...,) in units of the thresholds; 0 if no window ends.
        """
        dt = min(dt, SHORTEST)  # no test is done in a gap
        before = np.floor(self._time / self.lengths + 1e-9)
        self._time += dt
        self._sums += w
        self._counts += 1
        self._durations += dt
        largest = np.zeros(w.shape[:-1])
        for i in np.flatnonzero(np.floor(self._time / self.lengths + 1e-9) > before):
            limit = threshold(rate * self._durations[i], self.n)
            square = (self._sums[i] ** 2).sum(axis=-1) / (self._counts[i] * limit)
            largest = np.maximum(largest, square)
            self._sums[i] = self._counts[i] = self._durations[i] = 0.0
        return largest


class _Lasting:
    """Likelihood ratios of errors across and of the heading that are constant since the beginning.

    Args:
        batch: shape of the leading axes of the innovations.
    """

    def __init__(self, batch: tuple[int, ...]) -> None:
        self._time, self._tested, self._next = 0.0, 0.0, SHORTEST
        self._products = np.zeros((*batch, 2))
        self._squares = np.full(2, 1e-300)

    def add(
        self, w: NDArray[np.float64], response: NDArray[np.float64], dt: float, rate: float
    ) -> NDArray[np.float64]:
        """Add (..., n) innovations; return the largest statistic.

        Args:
            w: whitened innovations.
            response: (2, n) what errors of 1 m and 1 rad add to them.
            dt: time since the last ones [s].
            rate: false alarms per second.

        Returns:
            (...,) in units of the threshold; 0 where nothing is tested.
        """
        self._time += min(dt, SHORTEST)
        self._products += w @ response.T
        self._squares += (response**2).sum(axis=1)
        if self._time < self._next - 1e-9:
            return np.zeros(w.shape[:-1])
        limit = threshold(rate * (self._time - self._tested) / 2, 1)
        self._tested, self._next = self._time, 2 * self._next
        return np.asarray((self._products**2 / self._squares).max(axis=-1) / limit)


def window_lengths(correlation_time: float) -> NDArray[np.float64]:
    """Return the lengths of the windows of ``ConsistencyTest`` [s].

    They do not depend on small changes of the time, after which the sums would begin anew.

    >>> window_lengths(1.0)
    array([ 0.125,  0.5  ,  2.   ,  8.   , 32.   ])
    """
    longest = max(CORRELATION_TIMES * min(correlation_time, MAX_TIME), SLOW)
    most = round(math.log(longest / SHORTEST, RATIO))
    return SHORTEST * RATIO ** np.arange(most + 1.0)
