"""The panels of a plot, for any renderer: bands, dots and strips."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle, pairwise

import numpy as np
from numpy.typing import NDArray

from ...values.line import PARAMETERS, Slot, Status, lateral
from ..line_tables import LEFT_OUT_NAMES, UPPER_TRIANGLE, left_out_column, position
from .recording import OLDEST, Recording, recorded

__all__ = [
    "Band",
    "Dots",
    "Panel",
    "Recording",
    "Strip",
    "above",
    "distinct",
    "panels_of",
    "recorded",
]

Array = NDArray[np.float64]
#: The members of a ``Band`` after its colour and its dash.
Points = tuple[Array, Array, Array, Array]

#: Okabe and Ito's colours, by slot.
COLOURS = dict(
    zip(
        Slot,
        ("#0072B2", "#D55E00", "#56B4E9", "#E69F00", "#009E73", "#666666", "#000000", "#CC79A7"),
        strict=True,
    )
)
#: Colours of the states, and whether a line may be used.
STATES = {"VALID": "#009E73", "INIT": "#F0E442", "INVALID": "#D55E00", "NODATA": "#BBBBBB"}
NOT_USED = "#F0A0A0"
#: Most points of a band. More are joined: each then stands for all within some time.
MOST_POINTS = 2000
#: Lines that are farther apart are not joined [s].
GAP = 0.5


@dataclass(frozen=True, eq=False)
class Band:
    """A value with its bands of 1, 2 and 3 standard deviations.

    Args:
        label: for the legend.
        colour: of the line and of its bands.
        dash: whether the line is dashed.
        x: (n,) times [s] or distances [m]; the values are nan at a gap.
        y: (n,) values.
        low: (3, n) lower ends of the bands; nan where there is none.
        high: (3, n) upper ends.
    """

    label: str
    colour: str
    dash: bool
    x: Array
    y: Array
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Dots:
    """Single points: the truth, or frames that were dropped."""

    label: str
    colour: str
    x: Array
    y: Array


@dataclass(frozen=True)
class Strip:
    """A state during a time, in a row."""

    row: int
    begin: float
    end: float
    colour: str
    label: str


@dataclass(frozen=True, eq=False)
class Panel:
    """A diagram.

    Args:
        title: of the panel.
        x_label: of the horizontal axis.
        y_label: of the vertical axis; empty if it has rows.
        bands: values with their bands.
        dots: single points.
        strips: states, in rows.
        rows: names of the rows, from below.
        note: what the reader has to know.
    """

    title: str
    x_label: str
    y_label: str
    bands: Sequence[Band] = ()
    dots: Sequence[Dots] = ()
    strips: Sequence[Strip] = ()
    rows: Sequence[str] = ()
    note: str = field(default="")

    @property
    def limits(self) -> tuple[float, float] | None:
        """Lower and upper end of values and bands, with a margin; None without any."""
        drawn = [one.ravel() for band in self.bands for one in (band.y, band.low, band.high)]
        known = np.concatenate([*drawn, np.empty(0)])
        known = known[np.isfinite(known)]
        if not len(known):
            return None
        margin = 0.05 * np.ptp(known) or 1.0
        return float(known.min() - margin), float(known.max() + margin)


def panels_of(recordings: Sequence[Recording], at: Sequence[float]) -> list[Panel]:
    """Return the panels of recordings over each other: positions, width, age, states and rejects.

    Args:
        recordings: one or more; the second and later ones are dashed.
        at: distances ahead of the car [m].
    """
    recordings = distinct(recordings)
    found = []
    for x in at:
        bands, dots, width, bare = [], [], 0.0, set[str]()
        for number, recording in enumerate(recordings):
            for label, rows in recording.lines.items():
                is_bare = rows["status"] == Status.UNKNOWN
                sigma = np.where(is_bare, np.nan, rows[f"sigma{x:g}"])
                one, bin_width = thinned(rows["t"], rows[f"y{x:g}"], sigma)
                width = max(width, bin_width)
                name = _label(recordings, number, label)
                bands.append(Band(name, _colour(label), number > 0, *one))
                bare |= {name} if is_bare.any() else set()
            dots += [*_truth(recording, x)] if number == 0 else []
        title = f"lateral position at {x:g} m, with 1, 2 and 3 sigma"
        note = "; ".join(filter(None, [_bin_note(width), _bare_note(sorted(bare))]))
        found.append(Panel(title, "time [s]", "y [m]", bands, dots, note=note))
    if any(len(recording.scenes.get("t", ())) for recording in recordings):
        found += [*_lane_panels(recordings, at)]
    found.append(_age_panel(recordings))
    found.append(_state_panel(recordings))
    return found


def above(recordings: Sequence[Recording], time: float) -> Panel:
    """Return the newest lines at a time from above, none of them older than 1 s.

    Args:
        recordings: one or more.
        time: from the first line on [s].
    """
    recordings = distinct(recordings)
    bands, bare = [], []
    for number, recording in enumerate(recordings):
        for label, rows in recording.lines.items():
            past = np.flatnonzero((rows["t"] <= time) & (rows["t"] > time - OLDEST))
            if not len(past) or np.isnan(rows["y_off"][past[-1]]):
                continue
            k = past[-1]
            mean = np.array([rows[name][k] for name in PARAMETERS])
            cov = np.empty((4, 4))
            for i, j in UPPER_TRIANGLE:
                value = rows[f"cov_{PARAMETERS[i]}_{PARAMETERS[j]}"][k]
                cov[i, j] = cov[j, i] = value
            x = np.linspace(rows["x_min"][k], rows["x_max"][k], 101)
            sigma = np.array([position(mean[None], cov[None], one)[1][0] for one in x])
            if rows["status"][k] == Status.UNKNOWN:
                sigma[:] = np.nan
                bare.append(_label(recordings, number, label))
            y = lateral(mean, x)
            shift = np.arange(1, 4)[:, None] * sigma
            text = f"{label}, {time - rows['t'][k]:.2f} s old"
            text += "" if rows["usable"][k] else ", not usable"
            name = _label(recordings, number, text)
            bands.append(Band(name, _colour(label), number > 0, x, y, y - shift, y + shift))
    title = f"lines at {time:g} s, with 1, 2 and 3 sigma"
    return Panel(
        title, "x, ahead of the car [m]", "y, to the left [m]", bands, note=_bare_note(bare)
    )


def distinct(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings with names that differ: logs in two folders may have the same one."""
    names = [recording.name for recording in recordings]
    return [
        recording
        if names.count(recording.name) == 1
        else replace(recording, name=f"{recording.name} ({number})")
        for number, recording in enumerate(recordings, 1)
    ]


def _lane_panels(recordings: Sequence[Recording], at: Sequence[float]) -> Iterator[Panel]:
    for name, what in (("width", "width of the ego lane"), ("centre", "centre of the ego lane")):
        bands, width = [], 0.0
        for number, recording in enumerate(recordings):
            if not len(recording.scenes.get("t", ())):
                continue
            for x, colour in zip(at, cycle(COLOURS.values()), strict=False):
                value, sigma = (recording.scenes[f"{n}{x:g}"] for n in (name, f"sigma_{name}"))
                one, bin_width = thinned(recording.scenes["t"], value, sigma)
                width = max(width, bin_width)
                label = _label(recordings, number, f"at {x:g} m")
                bands.append(Band(label, colour, number > 0, *one))
        title = f"{what}, with 1, 2 and 3 sigma of the joint covariance"
        yield Panel(title, "time [s]", f"{name} [m]", bands, note=_bin_note(width))


def _age_panel(recordings: Sequence[Recording]) -> Panel:
    bands = []
    for number, recording in enumerate(recordings):
        for label, rows in recording.lines.items():
            one, _ = thinned(rows["t"], 1e3 * rows["age"], np.zeros(len(rows["t"])))
            name = _label(recordings, number, label)
            bands.append(Band(name, _colour(label), number > 0, *one))
    return Panel("age of the lines when they were sent", "time [s]", "age [ms]", bands)


def _state_panel(recordings: Sequence[Recording]) -> Panel:
    """Return the states of the slots, and below them the dropped frames."""
    rows: list[str] = []
    strips, dots = [], []
    for number, recording in enumerate(recordings):
        for reason, times in recording.rejects.items():
            label = _label(recordings, number, reason.lower())
            some = times[:: len(times) // MOST_POINTS + 1]
            dots.append(Dots(label, "#444444", some, np.full(len(some), float(len(rows)))))
            rows.append(f"{label} ({len(times)})")
        for label, lines in recording.lines.items():
            strips += [*_strips(lines["t"], lines["state"], lines["usable"], len(rows))]
            rows.append(_label(recordings, number, label))
        for label, reasons in _left_out(recording):
            runs = _strips(recording.scenes["t"], reasons, np.ones(len(reasons), bool), len(rows))
            strips += [run for run in runs if run.label]
            rows.append(_label(recordings, number, f"{label}: left out"))
    title = "E2E state of the slots, and dropped frames"
    note = "yellow: INIT, red: INVALID, pale: VALID, but not to be used; or left out by the sender"
    return Panel(title, "time [s]", "", dots=dots, strips=strips, rows=rows, note=note)


def _left_out(recording: Recording) -> Iterator[tuple[str, NDArray[np.str_]]]:
    """Yield the slots of which whole scenes have said that the line is left out, and why, or ""."""
    for slot in Slot:
        numbers = recording.scenes.get(left_out_column(slot), np.empty(0, np.uint8))
        if numbers.any():
            yield slot.name.replace("_", " ").lower(), np.array(LEFT_OUT_NAMES)[numbers]


def _strips(t: Array, state: NDArray[np.str_], usable: NDArray[np.bool_], row: int) -> list[Strip]:
    """Return the runs of a state; a time without lines is one of its own."""
    if not len(t):
        return []
    changes = (state[1:] != state[:-1]) | (usable[1:] != usable[:-1])
    is_gap = np.diff(t) > GAP
    begins = np.flatnonzero(np.concatenate([[True], changes | is_gap]))
    ends = [*begins[1:].tolist(), len(t)]
    found = []
    for begin, end in zip(begins.tolist(), ends, strict=True):
        last = t[end] if end < len(t) and not is_gap[end - 1] else t[end - 1]
        name = str(state[begin])
        is_used = name != "VALID" or usable[begin]
        colour = STATES.get(name, NOT_USED) if is_used else NOT_USED
        found.append(Strip(row, float(t[begin]), float(last), colour, name))
    step = len(found) // MOST_POINTS + 1  # a slot that flickers has a strip for each
    return found[::step]


def thinned(t: Array, y: Array, sigma: Array) -> tuple[Points, float]:
    """Return (t, y, low, high) of a band, with gaps, and the time that a point stands for.

    A point of many stands for all of a time: the median, and the outermost ends of each band.
    """
    order = np.argsort(t, kind="stable")
    t, y, sigma = t[order], y[order], sigma[order]
    shift = np.arange(1, 4)[:, None] * sigma
    low, high = y - shift, y + shift
    width = 0.0
    if len(t) > 2 * MOST_POINTS:
        width = float(t[-1] - t[0]) / MOST_POINTS
        known = np.isfinite(y)
        t, y, low, high = t[known], y[known], low[:, known], high[:, known]
        place = ((t - t[0]) / width).astype(int) if len(t) else np.empty(0, int)
        begins = np.flatnonzero(np.diff(place, prepend=-1))
        middle = [np.median(y[a:b]) for a, b in pairwise([*begins.tolist(), len(y)])]
        low = np.fmin.reduceat(low, begins, axis=1) if len(t) else low
        high = np.fmax.reduceat(high, begins, axis=1) if len(t) else high
        t, y = t[begins], np.array(middle)
    gaps = np.flatnonzero(np.diff(t) > max(GAP, 2.5 * width)) + 1
    t = np.insert(t, gaps, (t[gaps - 1] + t[gaps]) / 2)
    y, low, high = (np.insert(one, gaps, np.nan, axis=-1) for one in (y, low, high))
    return (t, y, low, high), width


def _truth(recording: Recording, x: float) -> Iterator[Dots]:
    if x % 10 or not 0 <= x <= 80:
        return
    for slot, (t, y) in recording.truth.items():
        label = slot.name.replace("_", " ").lower()
        if label in recording.lines:
            step = len(t) // MOST_POINTS + 1
            yield Dots(f"{label}, truth", "black", t[::step], y[::step, int(x // 10)])


def _label(recordings: Sequence[Recording], number: int, label: str) -> str:
    return f"{recordings[number].name}: {label}" if len(recordings) > 1 else label


def _colour(label: str) -> str:
    return next(
        colour for slot, colour in COLOURS.items() if slot.name.replace("_", " ").lower() in label
    )


def _bare_note(labels: Sequence[str]) -> str:
    return f"without a covariance, so without a band: {', '.join(labels)}" if labels else ""


def _bin_note(width: float) -> str:
    return f"each point is the median, and the widest band, of {width:.2g} s" if width else ""
