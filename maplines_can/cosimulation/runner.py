"""Co-simulation of FMUs on a CAN bus: steps from one tick or frame to the next.

At each communication point all nodes step to it; those with an event, a clock that is due, an
input or something received enter event mode. An instant has as many rounds as it needs:

    receive and tick  ->  read what ticking channels send  ->  update  ->  pass on to the link

When no node has anything left, the bus arbitrates, and the nodes leave event mode.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from ..values.errors import FmuError
from .bus_operations import Operation, Transmit
from .checks import check
from .connections import BusLink, Link, Record, SentFrame, SimulatedBusLink
from .fmu_description import Description, read_description
from .node import Channel, Node, Value

if TYPE_CHECKING:
    from ..testing import FaultInjector

#: Values by node and variable; a text is read as the type of the variable, an array has spaces.
Values = Mapping[tuple[str, str], "str | Value | Sequence[Value]"]
#: Step between communication points if no FMU has one in its default experiment [s].
DEFAULT_STEP = 0.01
#: Most rounds of events in one instant.
MAX_ROUNDS = 1000


class CoSimulation:
    """Co-simulation of FMUs that are connected by a CAN bus.

    If one of them is a bus simulation, it connects the others, otherwise the bus of this package
    does. A node has the name of its file, and a number if one before it has the same.

    Args:
        fmus: paths of the FMUs.
        values: start values, by node and variable.
        step: longest time between communication points [s]; None for that of the FMUs.
        bitrate: of the bus [bit/s]; 0 as the nodes configure it; None for a bus without delay.
        injector: injects faults into the frames that the nodes send; its intervals start at 0.
        record: called with each frame that the bus delivers, and its time [s].
        inputs: values to be set at times [s], which follow each other, by node and variable.
        until: end that the FMUs are told [s]; None for none.
        ignore_findings: run FMUs that break the standard, too.

    Raises:
        FmuError: an FMU breaks FMI-LS-BUS, cannot be loaded, or refuses a value.
        MissingExtraError: fmpy is not installed.

    >>> with CoSimulation(["sender.fmu", "receiver.fmu"]) as simulation:  # doctest: +SKIP
    ...     simulation.run(10.0)
    ...     simulation.get("receiver", "received")
    """

    def __init__(
        self,
        fmus: Sequence[str | PathLike[str]],
        *,
        values: Values | None = None,
        step: float | None = None,
        bitrate: int | None = None,
        injector: FaultInjector[SentFrame] | None = None,
        record: Record | None = None,
        inputs: Sequence[tuple[float, Values]] = (),
        until: float | None = None,
        ignore_findings: bool = False,
    ) -> None:
        descriptions = {name: read_description(path) for name, path in node_names(fmus).items()}
        if not ignore_findings:
            for description in descriptions.values():
                refuse_errors(description)
        simulations = [name for name, one in descriptions.items() if one.is_bus_simulation]
        if len(simulations) > 1:
            raise FmuError(f"{' and '.join(simulations)} simulate the bus; use one of them")
        if simulations and bitrate is not None:
            raise FmuError(f"{simulations[0]} simulates the bus; leave out the bit rate")
        self.now_ns = 0
        self.ended_by: str | None = None  #: node that asked to end the simulation
        self.points = 0  #: communication points so far
        self._step_ns = _step_ns(step, descriptions.values())
        self._mail: dict[int, list[Operation]] = {}
        self._set_now: set[str] = set()
        self._inputs = deque((round(time * 1e9), row) for time, row in inputs)
        with ExitStack() as stack:
            self.nodes: dict[str, Node] = {}
            for name, description in descriptions.items():
                self.nodes[name] = Node(description, name)
                stack.callback(self.nodes[name].close)
            self._channels = {
                id(channel): channel for node in self.nodes.values() for channel in node.channels
            }
            nodes = [node for name, node in self.nodes.items() if name not in simulations]
            to_record = record or _no_record
            self.link: Link
            if simulations:
                simulation = self.nodes[simulations[0]]
                self.link = SimulatedBusLink(nodes, simulation, injector, to_record)
            else:
                self.link = BusLink(nodes, bitrate, injector, to_record)
            self._initialize(values or {}, None if until is None else round(until * 1e9))
            self._stack = stack.pop_all()

    @property
    def now(self) -> float:
        """Time of the simulation [s]."""
        return self.now_ns / 1e9

    @property
    def step(self) -> float:
        """Longest time between communication points [s]."""
        return self._step_ns / 1e9

    def node(self, name: str) -> Node:
        """Return a node.

        Raises:
            FmuError: there is none of this name.
        """
        if name not in self.nodes:
            raise FmuError(f"there is no node {name!r}; there are {', '.join(self.nodes)}")
        return self.nodes[name]

    def get(self, node: str, variable: str) -> Any:
        """Return the value of a variable, that of an array as a list."""
        owner = self.node(node)
        found = owner.variable(variable)
        if not found.dimensions:
            return owner.get_values(variable)[0]
        return owner.get_values(variable, owner.size(found))

    def set(self, node: str, variable: str, value: str | Value | Sequence[Value]) -> None:
        """Set an input or a tunable parameter at the present time."""
        owner = self.node(node)
        owner.enter_event_mode()  # a discrete variable can be set in event mode only
        owner.set_values(variable, _values(owner, variable, value))
        self._set_now.add(node)

    def run(self, until: float, each_step: Callable[[], None] | None = None) -> None:
        """Simulate to a time [s], or until an FMU asks to end.

        Args:
            until: end of the simulation [s].
            each_step: called at the start, after each step of `step`, and at the end, such as to
                set inputs.
        """
        end_ns = round(until * 1e9)
        if each_step is not None and self.now_ns == 0:
            each_step()
        while self.now_ns < end_ns and self.ended_by is None:
            self.advance(end_ns)
            is_last = self.now_ns >= end_ns or self.ended_by is not None
            if each_step is not None and (is_last or self.now_ns % self._step_ns == 0):
                each_step()
        if self._set_now:
            self._settle()

    def advance(self, end_ns: int) -> None:
        """Go to the next communication point, the end [ns] at the latest."""
        self._settle()
        times = [end_ns, (self.now_ns // self._step_ns + 1) * self._step_ns]
        times += [node.next_ns for node in self.nodes.values() if node.next_ns is not None]
        if self.link.next_ns is not None:
            times.append(self.link.next_ns)
        if self._inputs:
            times.append(self._inputs[0][0])
        self.now_ns = max(self.now_ns, min(times))
        self.points += 1
        is_step = self.now_ns % self._step_ns == 0
        for name, node in self.nodes.items():
            if node.has_variable_step or is_step:
                node.step_to(self.now_ns)
            if node.wants_end and self.ended_by is None:
                self.ended_by = name
        self._set_inputs()
        self._settle()

    def close(self) -> None:
        """Free all FMUs; any number of times."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # ---- one instant ---------------------------------------------------------------

    def _initialize(self, values: Values, until_ns: int | None) -> None:
        for owner, _ in values:
            self.node(owner)
        for name, node in self.nodes.items():
            own = {
                variable: _values(node, variable, value)
                for (owner, variable), value in values.items()
                if owner == name
            }
            node.initialize(own, until_ns)
        self._set_inputs()
        self._settle()

    def _set_inputs(self) -> None:
        while self._inputs and self._inputs[0][0] <= self.now_ns:
            for (node, variable), value in self._inputs.popleft()[1].items():
                self.set(node, variable, value)

    def _settle(self) -> None:
        """Handle all events of this instant."""
        for _ in range(MAX_ROUNDS):
            self._collect()
            active = [node for node in self.nodes.values() if self._has_events(node)]
            if not active:
                self.link.rest(self.now_ns)
                if not self._collect():
                    break
                continue
            self._set_now.clear()
            self._round(active)
        else:
            busy = ", ".join(node.name for node in active)
            raise FmuError(
                f"{busy}: events at {self.now:g} s do not end after {MAX_ROUNDS} rounds; is there "
                "a clock with the interval 0?"
            )
        for node in self.nodes.values():
            node.enter_step_mode()

    def _has_events(self, node: Node) -> bool:
        if node.now_ns != self.now_ns:  # one of fixed steps is behind
            return False
        is_due = node.next_ns is not None and node.next_ns <= self.now_ns
        has_mail = any(id(channel) in self._mail for channel in node.channels)
        return node.needs_events or is_due or has_mail or node.name in self._set_now

    def _collect(self) -> bool:
        """Take from the link what is to be received, and return whether there was anything."""
        deliveries = self.link.take(self.now_ns)
        for channel, operations in deliveries:
            self._mail.setdefault(id(channel), []).extend(operations)
        return bool(deliveries)

    def _round(self, active: Sequence[Node]) -> None:
        """Do one round of an instant."""
        ticked: dict[str, set[int]] = {}
        for node in active:
            node.enter_event_mode()
            for channel in node.channels:
                operations = self._mail.pop(id(channel), None)
                if operations:
                    node.receive(channel, operations)
            ticked[node.name] = node.tick()
        sent: list[tuple[Channel, list[Operation]]] = []
        for node in active:
            sent += node.transmissions(ticked[node.name])
        for node in active:
            node.needs_events = node.update(ticked[node.name])
            if node.wants_end and self.ended_by is None:
                self.ended_by = node.name
        for channel, operations in sent:
            self.link.accept(channel, operations, self.now_ns)


def node_names(fmus: Sequence[str | PathLike[str]]) -> dict[str, Path]:
    """Return the paths of FMUs by the names of their nodes.

    A number is added to the name of a file that another node has, up to a name that no file has.

    >>> list(node_names(["a/node.fmu", "node_2.fmu", "b/node.fmu"]))
    ['node', 'node_2', 'node_3']
    """
    paths = [Path(fmu) for fmu in fmus]
    stems = {path.stem for path in paths}
    names: dict[str, Path] = {}
    for path in paths:
        name, number = path.stem, 1
        while name in names or (number > 1 and name in stems):
            number += 1
            name = f"{path.stem}_{number}"
        names[name] = path
    return names


def refuse_errors(description: Description) -> None:
    """Check an FMU.

    Raises:
        FmuError: it breaks FMI-LS-BUS.
    """
    errors = [finding for finding in check(description) if finding.is_error]
    if errors:
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        first = f"{errors[0].where}: {errors[0].what}; {errors[0].rule}{more}"
        raise FmuError(
            f"{description.path}: is no CAN node of FMI-LS-BUS 1.0.0: {first}; "
            "'maplines fmu check' lists all findings, ignore_findings=True runs it all the same"
        )


def _values(node: Node, variable: str, value: str | Value | Sequence[Value]) -> list[Value]:
    if isinstance(value, str):
        return node.parsed(variable, value)
    return list(value) if isinstance(value, Iterable) else [value]


def _step_ns(step: float | None, descriptions: Iterable[Description]) -> int:
    own = [one.step for one in descriptions if one.step]
    chosen = step if step is not None else min(own, default=DEFAULT_STEP)
    if round(chosen * 1e9) < 1:
        raise FmuError(f"step must be at least a nanosecond, got {chosen!r} s")
    return round(chosen * 1e9)


def _no_record(frame: Transmit, time: float) -> None:
    """Record nothing."""
