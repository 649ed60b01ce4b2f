"""Plugin of pytest: a CAN bus in virtual or real time, and nodes that send and receive lines.

pytest loads this file in each project in whose environment the package is, so it imports nothing
but pytest; the fixtures import what they need.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING, Any, Literal

import pytest

if TYPE_CHECKING:
    from ..wire import Codec
    from .bench import Bench
    from .nodes import ReceivingNode, SendingNode

#: Options of the command line, of the ini file (with _), and of the marker (without maplines_).
_OPTIONS = {
    "time": "virtual, or real; by default virtual, or real if an interface is given",
    "interface": "interface of python-can for real time, such as socketcan; by default its virtual",
    "channel": "channel of the interface, such as vcan0",
    "dbc": "DBC of the lines; by default that of the package",
}
#: What the marker has beside them.
_MARKER_ONLY = ("faults", "bitrate", "fd")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options, and the same ones for the ini file."""
    group = parser.getgroup("maplines", "lines of a digital map on a CAN bus")
    for name, about in _OPTIONS.items():
        choices: dict[str, Any] = {"choices": ("virtual", "real")} if name == "time" else {}
        group.addoption(f"--maplines-{name}", help=about, default=None, **choices)
        kind: Literal["paths", "string"] = "paths" if name == "dbc" else "string"
        parser.addini(f"maplines_{name}", about, type=kind)


def pytest_configure(config: pytest.Config) -> None:
    """Describe the marker, and check the options."""
    names = ", ".join((*_OPTIONS, *_MARKER_ONLY))
    config.addinivalue_line(
        "markers", f"maplines({names}): settings of the CAN bus of this test, by keyword"
    )
    try:
        _timing({name: _setting(config, name) for name in _OPTIONS})
    except ValueError as error:
        raise pytest.UsageError(str(error)) from error


def _setting(config: pytest.Config, name: str) -> str | None:
    """Return an option of the command line, else of the ini file; None if there is none."""
    given = config.getoption(f"--maplines-{name}")
    if given is None:
        own = config.getini(f"maplines_{name}")
        given = own[0] if isinstance(own, list) and own else own
    return str(given) if given else None


def _timing(settings: dict[str, Any]) -> str | None:
    """Return the interface of settings; None for virtual time."""
    time, interface = settings.get("time"), settings.get("interface")
    if time not in (None, "virtual", "real"):
        raise ValueError(f"maplines: time must be virtual or real, got {time!r}")
    if time == "virtual" and (interface or settings.get("channel")):
        raise ValueError(
            f"maplines: an interface has no virtual time, got {interface or settings['channel']}; "
            "use time real, or leave out the interface and the channel"
        )
    if time == "real" or interface or settings.get("channel"):
        return interface or "virtual"
    return None


def _settings(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Return the settings of a test: those of its markers, else the options.

    A time, an interface or a channel of a marker takes the place of all three.
    """
    marked: dict[str, Any] = {}
    for marker in reversed(list(request.node.iter_markers("maplines"))):
        if wrong := [*marker.args, *(set(marker.kwargs) - {*_OPTIONS, *_MARKER_ONLY})]:
            names = ", ".join((*_OPTIONS, *_MARKER_ONLY))
            raise pytest.UsageError(f"the marker maplines takes {names}, by keyword, got {wrong}")
        marked |= marker.kwargs
    place = ("time", "interface", "channel")
    options = {name: _setting(request.config, name) for name in _OPTIONS}
    if any(name in marked for name in place):
        options |= dict.fromkeys(place)
    return options | marked


@pytest.fixture
def maplines_codec(request: pytest.FixtureRequest) -> Codec:
    """Codec of the DBC of ``--maplines-dbc``, for the nodes of the test; override it for another.

    The DBC of the package is the default.
    """
    from ..wire import Codec

    dbc = _settings(request)["dbc"]
    return Codec.from_dbc(dbc) if dbc else Codec.from_dbc()


@pytest.fixture
def maplines_bus(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """CAN bus in virtual or real time: ``open()`` joins it, ``run_for(s)`` lets the time pass."""
    from .bench import Bench

    settings = _settings(request)
    try:
        interface = _timing(settings)
        bench = Bench(
            interface,
            settings["channel"],
            bitrate=settings.get("bitrate"),
            fd=bool(settings.get("fd")),
        )
    except ValueError as error:
        raise pytest.UsageError(str(error)) from error
    with bench:
        yield bench


@pytest.fixture
def maplines_sender(
    request: pytest.FixtureRequest, maplines_bus: Bench, maplines_codec: Codec
) -> Iterator[SendingNode]:
    """Node that sends lines: ``send`` once, ``publish`` in each period; ``faults`` of its frames.

    The faults of the marker begin with the test.
    """
    from .nodes import SendingNode

    settings = _settings(request)
    node = SendingNode(maplines_bus, maplines_codec, fd=bool(settings.get("fd")))
    try:
        node.faults = settings.get("faults")
        yield node
    finally:
        node.close()


@pytest.fixture
def maplines_receiver(maplines_bus: Bench, maplines_codec: Codec) -> ReceivingNode:
    """Node that receives lines: ``latest(slot)``, ``assert_received``, ``assert_no_stale``."""
    from .nodes import ReceivingNode

    return ReceivingNode(maplines_bus, maplines_codec)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add what happened on the bus to the report of a test that failed."""
    report = yield
    fixtures = getattr(item, "funcargs", {})
    has_ours = any(name.startswith("maplines_") for name in fixtures)
    if call.when == "call" and report.failed and has_ours and (story := [*_story(fixtures)]):
        report.sections.append(("maplines", "\n".join(story)))
    return report


def _story(fixtures: dict[str, Any]) -> Iterator[str]:
    """Yield what happened at the fixtures that are ours; a project may have its own."""
    from ..values.arrays import count_text
    from .bench import Bench
    from .nodes import ReceivingNode, SendingNode

    bench, sender = fixtures.get("maplines_bus"), fixtures.get("maplines_sender")
    if isinstance(bench, Bench):
        kind = "virtual" if bench.is_virtual else f"real ({bench.interface} {bench.channel})"
        yield f"time: {bench.now:.4g} s, {kind}"
    if isinstance(sender, SendingNode):
        counts = ", ".join(f"{n} {kind}" for kind, n in sender.fault_counts.items())
        yield f"sender: {count_text(sender.sent, 'line')}; faults: {counts or 'none'}"
    if isinstance(receiver := fixtures.get("maplines_receiver"), ReceivingNode):
        stats = receiver.listener.stats()
        received = f"{count_text(stats.lines, 'line')} of {count_text(stats.frames, 'frame')}"
        yield f"receiver: {received}, {stats.lost} lost"
