"""A running FMU: its variables by name, its clocks, and the channels of its bus terminals.

fmpy loads the library and passes the calls on; what a clock means is here. Times are whole
nanoseconds, so that ticks which the FMU asks for come exactly then.
"""

from __future__ import annotations

import math
import shutil
import tempfile
import zipfile
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from ctypes import c_double, c_int, c_uint, c_uint64
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..values.errors import FmuError, missing_extra
from .bus_operations import Operation, decode, encode
from .checks import TIME_BASED, notifications
from .fmu_description import Description, Terminal, Variable

Value = float | int | bool | str
#: What an FMU reports as fmi3IntervalChanged.
_CHANGED = 2
#: Types of variables whose values are numbers, truth values or texts.
PLAIN_TYPES = {
    *(f"Float{bits}" for bits in (32, 64)),
    *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)),
    *("Boolean", "String", "Enumeration"),
}
#: Messages of an FMU that are kept for an error.
_KEPT_MESSAGES = 3


@dataclass
class Clock:
    """Time-based clock of an FMU."""

    variable: Variable
    due_ns: int | None = None  #: when it ticks next
    period_ns: int | None = None

    @property
    def is_periodic(self) -> bool:
        """Whether it goes on with the same period until the FMU changes it."""
        return self.variable.interval_variability in ("constant", "fixed", "tunable")


class Channel:
    """Bus terminal of a running FMU."""

    def __init__(self, node: Node, terminal: Terminal) -> None:
        self.node, self.name = node, terminal.name
        names = {name: terminal.variable(name) for name in ("Tx_Data", "Tx_Clock")}
        names |= {name: terminal.variable(name) for name in ("Rx_Data", "Rx_Clock")}
        missing = [name for name, variable in names.items() if variable not in node.variables]
        if missing:
            raise FmuError(f"{node.name}: terminal {terminal.name} has no {', '.join(missing)}")
        found = [node.variables[variable] for variable in names.values()]
        self.tx_data, self.tx_clock, self.rx_data, self.rx_clock = found
        self.notifications = notifications(node.description, terminal)

    @property
    def label(self) -> str:
        """Name for messages."""
        return f"{self.node.name}.{self.name}"

    @property
    def wants_notifications(self) -> bool:
        """Whether the node awaits confirmations and notifications of the bus."""
        return self.notifications is not None and bool(
            self.node.get_values(self.notifications.name)[0]
        )


class Node:
    """Running FMU; `close` frees it.

    Args:
        description: of the FMU.
        name: of the node.

    Raises:
        MissingExtraError: fmpy is not installed.
        FmuError: the FMU cannot be loaded.
    """

    def __init__(self, description: Description, name: str) -> None:
        if find_spec("fmpy") is None:
            raise missing_extra("running FMUs needs fmpy", "fmi")
        from fmpy import platform_tuple
        from fmpy.fmi3 import FMU3Slave

        self.description, self.name = description, name
        self.variables = description.variables
        self.now_ns = 0
        self.warnings = 0  #: of the FMU
        self.wants_end = False  #: the FMU asked to end the simulation
        self.needs_events = False
        self._in_event_mode = True  # that is where an FMU is after its initialization
        self._next_event_ns: int | None = None
        self._messages: deque[str] = deque(maxlen=_KEPT_MESSAGES)
        if platform_tuple not in description.platforms:
            there = ", ".join(description.platforms) or "none"
            raise FmuError(
                f"{description.path}: has no binary for {platform_tuple} (binaries: {there}); "
                "compile its sources, such as with 'fmpy compile'"
            )
        self._folder = Path(tempfile.mkdtemp(prefix="maplines-fmu-"))
        try:
            with zipfile.ZipFile(description.path) as fmu:
                fmu.extractall(self._folder)
            self._slave: Any = FMU3Slave(
                guid=description.token,
                unzipDirectory=str(self._folder),
                modelIdentifier=(description.co_simulation or {})["modelIdentifier"],
                instanceName=name,
            )
            self._slave.instantiate(
                loggingOn=True, eventModeUsed=True, earlyReturnAllowed=False, logMessage=self._log
            )
        except Exception as error:  # fmpy raises no class of its own
            shutil.rmtree(self._folder, ignore_errors=True)
            messages = f" ({'; '.join(self._messages)})" if self._messages else ""
            raise FmuError(f"{name}: cannot be loaded: {error}{messages}") from error
        self.clocks = [
            Clock(one)
            for one in self.variables.values()
            if one.type == "Clock"
            and one.causality == "input"
            and one.interval_variability in TIME_BASED
        ]
        self.channels = [Channel(self, terminal) for terminal in description.bus_terminals]
        self.has_variable_step = description.is_true("canHandleVariableCommunicationStepSize")

    @property
    def last_message(self) -> str:
        """What the FMU said last of a warning or an error; empty if it said nothing."""
        return self._messages[-1] if self._messages else ""

    # ---- variables -----------------------------------------------------------------

    def variable(self, name: str) -> Variable:
        """Return a variable with a plain value.

        Raises:
            FmuError: there is none of this name.
        """
        found = self.variables.get(name)
        if found is None or found.type not in PLAIN_TYPES:
            raise FmuError(f"{self.name} has no variable {name!r} that can be read or set")
        return found

    def size(self, variable: Variable) -> int:
        """Return the number of elements of a variable."""
        by_reference = {str(one.reference): one for one in self.variables.values()}
        sizes = [
            int(self.get_values(by_reference[text[1:]].name)[0])
            if text.startswith("#")
            else int(text)
            for text in variable.dimensions
        ]
        return math.prod(sizes)

    def get_values(self, name: str, size: int = 1) -> list[Value]:
        """Return the elements of a variable."""
        variable = self.variable(name)
        kind = "Int64" if variable.type == "Enumeration" else variable.type
        return list(self._call(f"get{kind}", [variable.reference], size))

    def get_all(self, names: Sequence[str], sizes: Sequence[int]) -> list[Value]:
        """Return the elements of variables, one after the other; one call for each type."""
        by_type: dict[str, list[int]] = {}
        for index, name in enumerate(names):
            by_type.setdefault(self.variable(name).type, []).append(index)
        found: list[list[Value]] = [[]] * len(names)
        for kind, indices in by_type.items():
            references = [self.variables[names[index]].reference for index in indices]
            get = "getInt64" if kind == "Enumeration" else f"get{kind}"
            values = iter(self._call(get, references, sum(sizes[index] for index in indices)))
            for index in indices:
                found[index] = [next(values) for _ in range(sizes[index])]
        return [value for elements in found for value in elements]

    def set_values(self, name: str, values: Iterable[Value]) -> None:
        """Set the elements of a variable."""
        variable = self.variable(name)
        kind = "Int64" if variable.type == "Enumeration" else variable.type
        self._call(f"set{kind}", [variable.reference], list(values))

    def parsed(self, name: str, text: str) -> list[Value]:
        """Return the values of a variable from a text; those of an array have spaces between.

        Raises:
            FmuError: there is no such variable, or it is not of this type.
        """
        kind = self.variable(name).type
        try:
            if kind == "String":
                return [text]
            return [_parsed(kind, word) for word in text.split()]
        except ValueError:
            raise FmuError(f"{self.name}.{name} is a {kind}, got {text!r}") from None

    # ---- life ----------------------------------------------------------------------

    def initialize(self, values: Mapping[str, list[Value]], until_ns: int | None) -> None:
        """Set values and go through the initialization; then the FMU is in event mode."""
        structural = {name for name in values if self._is_structural(name)}
        if structural:
            self._call("enterConfigurationMode")
            for name in structural:
                self.set_values(name, values[name])
            self._call("exitConfigurationMode")
        for name in values.keys() - structural:
            self.set_values(name, values[name])
        stop = None if until_ns is None else until_ns / 1e9
        self._call("enterInitializationMode", startTime=0.0, stopTime=stop)
        for clock in self.clocks:
            if clock.is_periodic:
                clock.period_ns = self._interval(clock) or self._declared(clock, "interval")
            if clock.variable.interval_variability != "countdown":
                clock.due_ns = self._declared(clock, "shift") or 0
        self._call("exitInitializationMode")
        self._update_intervals()
        self.needs_events = True

    def close(self) -> None:
        """Free the FMU and its files; any number of times."""
        slave, self._slave = self._slave, None
        if slave is not None:
            try:
                slave.terminate()
                slave.freeInstance()
            except Exception as error:  # noqa: BLE001 - the results count, not the end
                self._messages.append(f"{error}")
            shutil.rmtree(self._folder, ignore_errors=True)

    def step_to(self, time_ns: int) -> None:
        """Advance to a time."""
        if time_ns == self.now_ns:
            return
        start, step = self.now_ns / 1e9, (time_ns - self.now_ns) / 1e9
        needs_events, wants_end, early, _ = self._call("doStep", start, step)
        if early:
            raise FmuError(
                f"{self.name} returned early from its step at {start:g} s; bus nodes must not "
                "(FMI-LS-BUS, Triggered Tx Clocks)"
            )
        self.now_ns = time_ns
        self.needs_events |= needs_events
        self.wants_end |= wants_end

    # ---- events --------------------------------------------------------------------

    @property
    def next_ns(self) -> int | None:
        """Time of the next tick or event that is known; None without one."""
        times = [clock.due_ns for clock in self.clocks if clock.due_ns is not None]
        if self._next_event_ns is not None:
            times.append(self._next_event_ns)
        return min(times, default=None)

    def enter_event_mode(self) -> None:
        """Enter event mode, unless it is in it."""
        if not self._in_event_mode:
            self._call("enterEventMode")
            self._in_event_mode = True

    def enter_step_mode(self) -> None:
        """Leave event mode."""
        if self._in_event_mode:
            self._call("enterStepMode")
            self._in_event_mode = False

    def receive(self, channel: Channel, operations: Iterable[Operation]) -> None:
        """Set what a channel receives, and let its clock tick; in event mode."""
        self._call("setClock", [channel.rx_clock.reference], [True])
        self._call("setBinary", [channel.rx_data.reference], [encode(operations)])

    def tick(self) -> set[int]:
        """Let the clocks that are due tick, and return their references; in event mode."""
        due = [one for one in self.clocks if one.due_ns is not None and one.due_ns <= self.now_ns]
        references = [clock.variable.reference for clock in due]
        if due:
            self._call("setClock", references, [True] * len(due))
        for clock in due:
            clock.due_ns = None
            if clock.is_periodic and clock.period_ns:
                clock.due_ns = self.now_ns + clock.period_ns
        return set(references)

    def transmissions(self, ticking: set[int]) -> list[tuple[Channel, list[Operation]]]:
        """Return what the channels send in this instant; in event mode.

        Args:
            ticking: references of the clocks that were made to tick.
        """
        sent = []
        for channel in self.channels:
            clock = channel.tx_clock
            if clock.causality == "output":
                ticks = self._call("getClock", [clock.reference])[0]
            else:
                ticks = clock.reference in ticking
            if ticks:
                data = self._call("getBinary", [channel.tx_data.reference])[0]
                if data:
                    sent.append((channel, decode(data)))
        return sent

    def update(self, ticked: set[int]) -> bool:
        """End the instant, and return whether the FMU needs another one; in event mode."""
        more, ends, _, _, has_next, next_event = self._call("updateDiscreteStates")
        self.wants_end |= ends
        self._next_event_ns = math.ceil(next_event * 1e9) if has_next else None
        self._update_intervals(ticked)
        self.needs_events = False
        return bool(more)

    # ---- clocks --------------------------------------------------------------------

    def _update_intervals(self, ticked: set[int] | None = None) -> None:
        """Ask for the intervals that may have changed in this event mode."""
        for clock in self.clocks:
            kind = clock.variable.interval_variability
            has_ticked = clock.variable.reference in (ticked or ())
            if kind == "countdown" or (kind == "changing" and has_ticked):
                interval = self._interval(clock)
                if interval is not None:
                    clock.due_ns = self.now_ns + interval
            elif kind == "tunable":
                clock.period_ns = self._interval(clock) or clock.period_ns

    def _interval(self, clock: Clock) -> int | None:
        """Return the interval that the FMU gives [ns]; None if it has none or has not changed it.

        Raises:
            FmuError: the interval is no time.
        """
        variable, one = clock.variable, (c_uint * 1)(clock.variable.reference)
        if variable.interval_variability == "constant" or (
            clock.is_periodic and self._declared(clock, "interval")
        ):
            return None
        qualifiers, changing = (c_int * 1)(), variable.interval_variability == "countdown"
        if variable.attributes.get("supportsFraction") in ("true", "1"):
            counters, resolutions = (c_uint64 * 1)(), (c_uint64 * 1)()
            self._call("getIntervalFraction", one, counters, resolutions, qualifiers)
            counter, resolution = counters[0], resolutions[0]
            interval = Fraction(counter, resolution) if resolution else math.nan
        else:
            intervals = (c_double * 1)()
            self._call("getIntervalDecimal", one, intervals, qualifiers)
            interval = intervals[0]
        if qualifiers[0] == 0 or (changing and qualifiers[0] != _CHANGED):
            return None
        if not 0 <= interval < math.inf:
            raise FmuError(
                f"{self.name}: the clock {variable.name} is to tick in {float(interval)} s; have "
                "all nodes given their bit rate?"
            )
        return round(interval * 10**9)

    def _declared(self, clock: Clock, what: str) -> int | None:
        """Return the interval or the shift of a clock in the model description [ns]."""
        attributes = clock.variable.attributes
        if f"{what}Decimal" in attributes:
            return round(float(attributes[f"{what}Decimal"]) * 1e9)
        if f"{what}Counter" in attributes:
            ticks = Fraction(int(attributes[f"{what}Counter"]), int(attributes["resolution"]))
            return round(ticks * 10**9)
        return None

    # ---- calls ---------------------------------------------------------------------

    def _is_structural(self, name: str) -> bool:
        return self.variable(name).causality == "structuralParameter"

    def _call(self, name: str, *arguments: Any, **named: Any) -> Any:
        """Call a function of the FMU.

        Raises:
            FmuError: it fails.
        """
        try:
            return getattr(self._slave, name)(*arguments, **named)
        except Exception as error:  # fmpy raises no class of its own
            said = f": {'; '.join(self._messages)}" if self._messages else ""
            text = f"{name} failed at {self.now_ns / 1e9:g} s{said or f': {error}'}"
            raise FmuError(f"{self.name}: {text}") from error

    def _log(self, _: object, status: int, category: bytes | None, message: bytes | None) -> None:
        """Keep what an FMU says of warnings and errors."""
        if status > 0:
            self.warnings += 1
            self._messages.append((message or category or b"").decode(errors="replace"))


def _parsed(kind: str, word: str) -> Value:
    """Return a value of a type; ValueError if the word is none."""
    if kind == "Boolean":
        if word.lower() not in ("true", "false", "0", "1"):
            raise ValueError(word)
        return word.lower() in ("true", "1")
    return float(word) if kind.startswith("Float") else int(word, 0)
