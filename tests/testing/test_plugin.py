"""Tests of the plugin of pytest: tests in projects of their own that pass or fail as they must."""

import subprocess
import sys
from textwrap import dedent

import pytest

from maplines_can.dbc_files.parser import default_dbc_path

pytest_plugins = ["pytester"]

LINE = """
    import pytest
    from maplines_can import MapLine, Slot
    LINE = MapLine.with_sigma(Slot.EGO_LEFT, [1.75, 0, 0, 0], [0.1, 0.01, 1e-3, 1e-5])
    """


def run(pytester: pytest.Pytester, test: str, *options: str) -> pytest.RunResult:
    """Run a test file in a project of its own."""
    pytester.makepyfile(dedent(LINE) + dedent(test))
    return pytester.runpytest("-p", "no:cacheprovider", *options)


PASSING = """
def test_line(maplines_bus, maplines_sender, maplines_receiver):
    maplines_sender.publish(LINE)
    line = maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.5)
    assert line.y(0.0) == pytest.approx(1.75, abs=0.01)
    maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.5)
    maplines_receiver.assert_no_stale(Slot.EGO_LEFT, during=0.15)
"""


@pytest.mark.parametrize(
    "options", [(), ("--maplines-interface=virtual",), ("--maplines-time=real",)]
)
def test_a_line_arrives_in_virtual_and_in_real_time(
    pytester: pytest.Pytester, options: tuple[str, ...]
) -> None:
    """The test is the same; in real time the period is long enough for a busy machine."""
    test = PASSING.replace("during=0.15", "during=0.15, stale_cycles=1000")
    run(pytester, test.replace("within=0.5", "within=60"), *options).assert_outcomes(passed=1)


def test_time_delays_bit_rates_and_can_fd(pytester: pytest.Pytester) -> None:
    """A minute takes no time: lines come to the microsecond; frames take theirs on the wire."""
    test = """
    def test_minute(maplines_bus, maplines_sender, maplines_receiver):
        maplines_sender.publish(LINE, period=0.05)
        for _ in range(1200):
            maplines_sender.publish(LINE)
            maplines_bus.run_for(0.05)
        times = [t for t, _ in maplines_receiver.arrivals]
        assert maplines_bus.now == pytest.approx(60, abs=1e-6)
        assert all(b - a <= 0.050001 for a, b in zip(times, times[1:]))
        assert maplines_bus.is_virtual

    @pytest.mark.maplines(faults="delay=0.03")
    def test_delay(maplines_bus, maplines_sender, maplines_receiver):
        maplines_sender.send(LINE)
        maplines_bus.run_for(0.02)
        assert not maplines_receiver.arrivals
        maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.02)
        assert maplines_receiver.arrivals[0].t == pytest.approx(0.03, abs=1e-6)

    @pytest.mark.maplines(bitrate=500_000)
    def test_frames(maplines_bus, maplines_sender):
        bus = maplines_bus.open()
        maplines_sender.send(LINE)
        stamps = [message.timestamp for message in iter(lambda: bus.recv(0.1), None)]
        assert len(stamps) == 4
        assert stamps[-1] - stamps[0] == pytest.approx(3 * (stamps[1] - stamps[0]), abs=1e-9)
        assert 200e-6 < stamps[1] - stamps[0] < 280e-6

    @pytest.mark.maplines(fd=True)
    def test_fd(maplines_bus, maplines_sender, maplines_receiver):
        bus = maplines_bus.open()
        maplines_sender.send(LINE)
        maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.1)
        assert bus.recv(0.0).is_fd
        assert bus.recv(0.0) is None
    """
    run(pytester, test).assert_outcomes(passed=4)


def test_a_line_that_is_published_ages(pytester: pytest.Pytester) -> None:
    """Until the DBC cannot state its age: then it is of no use, and the assertion says so."""
    test = """
    def test_old(maplines_bus, maplines_sender, maplines_receiver):
        maplines_sender.publish(LINE)
        maplines_bus.run_for(0.12)
        assert maplines_receiver.latest(Slot.EGO_LEFT).age == pytest.approx(0.12, abs=0.011)
        maplines_receiver.assert_no_stale(during=1.0)
    """
    result = run(pytester, test)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*the line EGO_LEFT is too old at 0.25* s", "*its age is inf s*"])


def test_missing_lines_are_described(pytester: pytest.Pytester) -> None:
    test = """
    def test_missing(maplines_bus, maplines_sender, maplines_receiver):
        maplines_sender.publish(LINE)
        maplines_bus.run_for(1.0)
        maplines_receiver.assert_received(Slot.ROUTE, within=0.2)
    """
    result = run(pytester, test)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "*no line ROUTE arrived within 0.2 s, from 1 to 1.2 s",
            "*before that: none",
            "*meanwhile: EGO_LEFT",
            "*look at: whether the sender publishes this slot*",
            "*maplines*",
            "time: 1.2 s, virtual",
            "sender: * lines; faults: none",
            "receiver: * lines of * frames, 0 lost",
        ]
    )


@pytest.mark.parametrize("as_marker", [True, False])
def test_faults_begin_and_end_at_their_times(pytester: pytest.Pytester, as_marker: bool) -> None:
    """An outage from 2 to 2.6 s: lines are stale three cycles later, and come again."""
    marker = '@pytest.mark.maplines(faults="loss=1@2.0-2.6")' if as_marker else ""
    setting = "" if as_marker else 'maplines_sender.faults = "loss=1@2.0-2.6"'
    test = f"""
    {marker}
    def test_outage(maplines_bus, maplines_sender, maplines_receiver):
        {setting}
        for cycle in range(80):
            maplines_sender.send(LINE)
            maplines_bus.run_for(0.05)
        times = [t for t, _ in maplines_receiver.arrivals]
        gap = [(a, b) for a, b in zip(times, times[1:]) if b - a > 0.051]
        assert gap == [(pytest.approx(1.95), pytest.approx(2.6))]
        assert maplines_sender.fault_counts == {{"loss": 48}}

    {marker}
    def test_stale(maplines_bus, maplines_sender, maplines_receiver):
        {setting}
        for cycle in range(80):
            maplines_sender.send(LINE)
            maplines_receiver.assert_no_stale(Slot.EGO_LEFT, during=0.05)
    """
    result = run(pytester, test)
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(
        [
            "*the line EGO_LEFT is stale at 2.1*5 s",
            "*the last one came at 1.95 s, 0.15* s before that*",
            "sender: 43 lines; faults: 12 loss",
        ]
    )


def test_a_line_of_before_is_not_received(pytester: pytest.Pytester) -> None:
    """Neither one that came before the time passed, nor one that was returned."""
    test = """
    def test_lost(maplines_bus, maplines_sender, maplines_receiver):
        maplines_sender.publish(LINE)
        maplines_bus.run_for(0.12)
        maplines_sender.faults = "loss=1"
        assert len(maplines_receiver.arrivals) == 3
        maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.2)
    def test_once(maplines_bus, maplines_sender, maplines_receiver):
        maplines_sender.send(LINE)
        maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.2)
        maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.2)
    """
    result = run(pytester, test)
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(
        ["*within 0.2 s, from 0.12 to 0.32 s", "*before that: the last one at 0.1 s"]
    )


@pytest.mark.parametrize("wait", [0.0, 0.05])
def test_a_line_that_came_already_is_received_in_real_time(
    pytester: pytest.Pytester, wait: float
) -> None:
    """The thread of python-can may be before the assertion; what came before a wait is old."""
    test = f"""
    @pytest.mark.maplines(interface="virtual")
    def test_line(maplines_bus, maplines_sender, maplines_receiver):
        maplines_sender.send(LINE)
        while not maplines_receiver.arrivals:
            pass
        if {wait}:
            maplines_bus.run_for({wait})
        maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.02)
    """
    run(pytester, test).assert_outcomes(**{"failed" if wait else "passed": 1})


def test_damage_is_counted_in_the_message(pytester: pytest.Pytester) -> None:
    test = """
    @pytest.mark.maplines(faults="flip=1,seed=3")
    def test_flip(maplines_sender, maplines_receiver):
        maplines_sender.publish(LINE)
        maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.2)
    """
    result = run(pytester, test)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*frames: * (*8 CRC)", "sender: 5 lines; faults: 20 flip"])


@pytest.mark.parametrize("dbc", ["maplines-pose.dbc", "maplines-scene.dbc"])
def test_scenes(pytester: pytest.Pytester, dbc: str) -> None:
    """They are sent as they are, and age; without CAN FD a DBC of whole scenes says so."""
    test = """
    from maplines_can import map_scene, simulation

    def scene():
        own = simulation.scenario("production")
        lines = {slot: own.lines[slot] for slot in (Slot.EGO_LEFT, Slot.EGO_RIGHT)}
        return map_scene(lines, own.ego)

    @pytest.mark.maplines(fd=True)
    def test_fd(maplines_bus, maplines_sender, maplines_receiver):
        for _ in range(8):
            maplines_sender.send(scene(), age=0.02)
            maplines_bus.run_for(0.05)
        view = maplines_receiver.latest_scene()
        assert view.usable and len(view.scene.lines) == 2
        assert 0.07 <= view.age <= 0.08
        maplines_sender.publish(scene())
        maplines_bus.run_for(0.49)
        assert maplines_sender.sent == 2 * (8 + 10)
        maplines_receiver.assert_received(Slot.EGO_RIGHT, within=0.1)
        assert maplines_receiver.latest_scene().age == float("inf")

    def test_classic(maplines_sender):
        maplines_sender.send(scene())
    """
    path = default_dbc_path(dbc)
    result = run(pytester, test, f"--maplines-dbc={path}")
    if dbc == "maplines-pose.dbc":
        result.assert_outcomes(passed=2)
        return
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*its scenes are CAN FD frames of 64 bytes*send with fd=True*"])


DBC = """
def test_dbc(maplines_codec, maplines_sender, maplines_receiver):
    assert 0x100 in maplines_codec.can_ids
    maplines_sender.send(LINE)
    maplines_receiver.assert_received(Slot.EGO_LEFT, within=0.1)
"""


@pytest.mark.parametrize("way", ["option", "ini", "marker", "conftest"])
def test_another_dbc(pytester: pytest.Pytester, way: str) -> None:
    """As an option, in the ini file beside it, of one test, or as a fixture of the project."""
    text = default_dbc_path().read_text(encoding="utf-8")
    first = int(text.partition("\nBO_ ")[2].partition(" ")[0])
    (pytester.path / "own.dbc").write_text(text.replace(f" {first} ", " 256 "), encoding="utf-8")
    test = DBC
    options: tuple[str, ...] = ()
    if way == "option":
        options = (f"--maplines-dbc={pytester.path / 'own.dbc'}",)
    elif way == "ini":
        pytester.makeini("[pytest]\nmaplines_dbc = own.dbc\n")
    elif way == "marker":
        test = f"\n@pytest.mark.maplines(dbc={str(pytester.path / 'own.dbc')!r})" + DBC
    else:
        pytester.makeconftest(
            """
            import pytest
            from maplines_can import Codec

            @pytest.fixture
            def maplines_codec():
                return Codec.from_dbc("own.dbc")
            """
        )
    run(pytester, test, *options).assert_outcomes(passed=1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--maplines-time=virtual", "--maplines-channel=vcan0"), "*an interface has no virtual*"),
        (("--maplines-time=fast",), "*invalid choice: 'fast'*"),
    ],
)
def test_wrong_options(pytester: pytest.Pytester, options: tuple[str, ...], message: str) -> None:
    result = run(pytester, PASSING, *options)

    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([message])


def test_wrong_markers(pytester: pytest.Pytester) -> None:
    markers = ("fault='loss=1'", "'real'", "time='fast'", "faults='los=1'")
    tests = (
        f"\n@pytest.mark.maplines({marker})" + PASSING.replace("_line(", f"_{n}(")
        for n, marker in enumerate(markers)
    )
    result = run(pytester, "".join(tests))

    result.assert_outcomes(errors=4)
    result.stdout.fnmatch_lines(
        [
            "*the marker maplines takes time,*by keyword, got ?'fault'?*",
            "*the marker maplines takes*got ?'real'?*",
            "*maplines: time must be virtual or real, got 'fast'*",
            "*los*unknown*",
        ]
    )


@pytest.mark.parametrize("name", ["bus", "sender", "receiver"])
def test_a_fixture_of_the_project_in_place_of_one_of_ours(
    pytester: pytest.Pytester, name: str
) -> None:
    """The report of a test that fails says what is known, and the session goes on."""
    pytester.makeconftest(
        f"""
        import can, pytest
        @pytest.fixture
        def maplines_{name}():
            with can.Bus(interface="virtual", channel="own") as bus:
                yield bus
        """
    )
    others = {"bus": "", "sender": "maplines_receiver", "receiver": "maplines_sender"}[name]
    test = f"""
        def test_fails(maplines_{name}, {others}): assert 1 == 2
        def test_other(): pass
        """
    result = run(pytester, test)
    result.assert_outcomes(failed=1, passed=1)
    assert ("time: 0 s, virtual" in result.stdout.str()) == (name != "bus")


def test_a_node_of_ours_on_a_bus_of_the_project_is_refused_by_name(
    pytester: pytest.Pytester,
) -> None:
    pytester.makeconftest(
        """
        import can, pytest
        @pytest.fixture
        def maplines_bus():
            with can.Bus(interface="virtual", channel="own") as bus:
                yield bus
        """
    )
    result = run(pytester, PASSING)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*TypeError: the bench of a node must be a Bench, *VirtualBus*"])


def test_the_marker_is_registered(pytester: pytest.Pytester) -> None:
    run(pytester, "\n@pytest.mark.maplines(time='virtual')" + PASSING, "--strict-markers")

    result = pytester.runpytest("--markers")
    result.stdout.fnmatch_lines(["@pytest.mark.maplines(time, interface, channel, dbc, faults*"])


def test_the_plugin_loads_nothing_that_is_heavy() -> None:
    """pytest loads it in each project: neither NumPy nor python-can, nor a parser of DBCs."""
    code = (
        "import sys, maplines_can.testing.plugin; "
        "print(sorted({'numpy', 'scipy', 'can', 'cantools'} & set(sys.modules)))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )

    assert loaded.stdout == "[]\n"
