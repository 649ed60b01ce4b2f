"""A restbus on virtual time: cycle times, values, protection, faults and commands."""

from __future__ import annotations

import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from e2e import p01, p02, p04, p05, p06, p07, p11
from hypothesis import given, settings
from hypothesis import strategies as st
from support.xodr_files import document, geometry, lane, road, section

from maplines_can import Codec, Slot
from maplines_can.bus.clock import RealClock, VirtualClock
from maplines_can.bus.virtual_time import VirtualNetwork, VirtualTimeBus
from maplines_can.restbus import Config, Restbus
from maplines_can.restbus.config import EXAMPLE
from maplines_can.values.errors import DriveFileError, RestbusError
from maplines_can.wire import Reason

CAR: Any = cantools.database.load_file(EXAMPLE.with_name("example-car.dbc"))


def run(
    values: dict[str, Any], seconds: float, folder: Path = Path(), **settings: Any
) -> list[can.Message]:
    """Run a configuration on virtual time and return what another node receives."""
    clock = VirtualClock()
    network = VirtualNetwork(clock, **settings)
    with VirtualTimeBus(network) as bus, VirtualTimeBus(network) as other:
        restbus = Restbus(Config.from_dict(values, folder), bus, clock)
        restbus.start()
        clock.run_for(seconds)
        restbus.stop()
        return list(iter(lambda: other.recv(0), None))


def message(name: str = "Motion", **rest: Any) -> dict[str, Any]:
    return {"name": name, "dbc": "example-car.dbc", **rest}


def motion(**signals: Any) -> dict[str, Any]:
    return {"message": [message(signals=signals)]}


def microseconds(messages: list[can.Message], can_id: int) -> list[int]:
    return [round(m.timestamp * 1e6) for m in messages if m.arbitration_id == can_id]


def big_dbc(folder: Path, messages: int) -> None:
    """Write a DBC of many messages with a counter each."""
    rows = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_: A", ""]
    for n in range(messages):
        rows += [f"BO_ {1024 + n} M{n}: 8 A", ' SG_ C : 0|8@1+ (1,0) [0|255] "" A', ""]
    (folder / "big.dbc").write_text("\n".join(rows))


@pytest.mark.parametrize("seconds", [5.0])
def test_30_messages_and_8_lines_are_exact_to_the_microsecond(
    tmp_path: Path, seconds: float
) -> None:
    """The cycles are of odd lengths, so that a rounded period would show."""
    big_dbc(tmp_path, 30)
    cycles = {n: 10.0 + n * 7.001 for n in range(30)}
    values = {
        "dbc": "big.dbc",
        "message": [
            {"name": f"M{n}", "cycle_ms": cycle, "start_ms": n, "signals": {"C": {"count": [0, 9]}}}
            for n, cycle in cycles.items()
        ],
        "lines": {"scenario": "production", "lines": 8, "moves": False},
    }
    received = run(values, seconds, tmp_path)
    for n, cycle in cycles.items():
        expected = [1000 * n + round(1000 * cycle) * k for k in range(10**5)]
        expected = [t for t in expected if t <= seconds * 1e6]
        assert microseconds(received, 1024 + n) == expected
        counts = [m.data[0] for m in received if m.arbitration_id == 1024 + n]
        assert counts == [k % 10 for k in range(len(expected))]
    lines = {m.arbitration_id for m in received} - {1024 + n for n in cycles}
    assert len(lines) == 8
    for can_id in lines:
        starts = sorted(set(microseconds(received, can_id)))
        assert {b - a for a, b in pairwise(starts)} == {50_000}


@settings(max_examples=25, deadline=None)
@given(
    cycle_us=st.integers(1000, 50_000),
    start_us=st.integers(0, 20_000),
    count=st.integers(1, 5),
    share=st.floats(0.0, 0.99),
)
def test_the_schedule_of_bursts(cycle_us: int, start_us: int, count: int, share: float) -> None:
    gap_us = int(share * cycle_us / max(count - 1, 1))
    burst: dict[str, Any] = {"count": count, "gap_ms": gap_us / 1000} if count > 1 else {}
    entry = message(cycle_ms=cycle_us / 1000, start_ms=start_us / 1000, **burst)
    times = microseconds(run({"message": [entry]}, 0.2), 257)
    expected = [start_us + k * cycle_us + n * gap_us for k in range(201) for n in range(count)]
    assert times == [t for t in expected if t <= 200_000]


def test_signals_over_time(tmp_path: Path) -> None:
    (tmp_path / "signals.py").write_text("def speed(t):\n    return 10 * t\n")
    values = {
        "message": [
            message(signals={"Speed": {"script": "signals.py:speed"}, "YawRate": 0.5}),
            message(
                "Steering",
                cycle_ms=100,
                signals={
                    "SteeringAngle": {"ramp": [-90, 90], "period_s": 1.0},
                    "SteeringState": "Active",
                },
            ),
        ]
    }
    received = run(values, 1.0, tmp_path)
    decoded = [
        (m.timestamp, CAR.decode_message(m.arbitration_id, m.data, decode_choices=False))
        for m in received
    ]
    speeds = [(t, v) for t, v in decoded if "Speed" in v]
    assert len(speeds) == 51
    assert all(v["Speed"] == pytest.approx(10 * t, abs=0.0051) for t, v in speeds)
    assert all(v["YawRate"] == pytest.approx(0.5) for _, v in speeds)
    angles = [v["SteeringAngle"] for _, v in decoded if "SteeringAngle" in v]
    assert angles == pytest.approx([*range(-90, 90, 18), -90], abs=0.051)
    assert {v["SteeringState"] for _, v in decoded if "SteeringAngle" in v} == {2}


def protected(folder: Path, crc: str, counter: str, e2e: dict[str, Any], length: int) -> Any:
    """Return the payloads of a protected message."""
    names = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A\n\n'
    rest = "".join(
        f' SG_ B{n} : {8 * n}|8@1+ (1,0) [0|255] "" A\n' for n in range(length) if n >= 12
    )
    text = (
        f'{names}BO_ 100 P: {length} A\n SG_ Crc : {crc} (1,0) [0|0] "" A\n'
        f' SG_ Counter : {counter} (1,0) [0|0] "" A\n{rest}'
    )
    if length > 8:
        text += '\nBA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","StandardCAN_FD";\n'
        text += 'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";\nBA_ "VFrameFormat" BO_ 100 2;\n'
    (folder / "p.dbc").write_text(text)
    entry = {"name": "P", "dbc": "p.dbc", "cycle_ms": 1}
    entry["e2e"] = {"crc": "Crc", "counter": "Counter", **e2e}
    received = run({"message": [entry]}, 0.04, folder)
    assert len(received) == 41
    return [bytearray(m.data) for m in received]


def test_profiles_are_those_of_another_implementation(tmp_path: Path) -> None:
    """The package autosar-e2e accepts each frame, and no frame with another data ID."""
    modes = {
        "both": p01.E2E_P01_DATAID_BOTH, "low": p01.E2E_P01_DATAID_LOW,
        "alternating": p01.E2E_P01_DATAID_ALT, "nibble": p01.E2E_P01_DATAID_NIBBLE,
    }  # fmt: skip
    for mode, number in modes.items():
        data_id = 0x0034 if mode == "nibble" else 0x1234  # the nibble is a signal, 0 here
        table = {"profile": 1, "data_id": data_id, "data_id_mode": mode}
        payloads = protected(tmp_path, "0|8@1+", "8|4@1+", table, 8)
        assert all(p01.e2e_p01_check(p, data_id, data_id_mode=number) for p in payloads)
        assert not any(p01.e2e_p01_check(p, 0x0043, data_id_mode=number) for p in payloads)
        assert [p[1] & 15 for p in payloads] == [n % 15 for n in range(41)]
    ids = list(range(10, 26))
    payloads = protected(tmp_path, "0|8@1+", "8|4@1+", {"profile": 2, "data_id": ids}, 8)
    assert all(p02.e2e_p02_check(p, bytes(ids)) for p in payloads)
    assert not any(p02.e2e_p02_check(p, bytes(range(16))) for p in payloads)
    payloads = protected(tmp_path, "0|16@1+", "16|8@1+", {"profile": 5, "data_id": 0x1234}, 8)
    assert all(p05.e2e_p05_check(p, 0x1234) for p in payloads)
    assert not any(p05.e2e_p05_check(p, 0x1235) for p in payloads)
    payloads = protected(tmp_path, "0|8@1+", "8|4@1+", {"profile": 11, "data_id": 0x1234}, 8)
    assert all(p11.e2e_p11_check(p, 0x1234) for p in payloads)


@pytest.mark.parametrize(
    ("profile", "crc", "counter", "length"),
    [
        ("4", "71|32@0+", "23|16@0+", 16),
        ("6", "7|16@0+", "39|8@0+", 8),
        ("7", "7|64@0+", "103|32@0+", 24),
    ],
)
def test_checksums_of_profiles_whose_header_has_signals(
    tmp_path: Path, profile: str, crc: str, counter: str, length: int
) -> None:
    """Their length and data ID are signals of the user, so the checksum is compared alone."""
    module = {"4": p04.e2e_p04_protect, "6": p06.e2e_p06_protect, "7": p07.e2e_p07_protect}[profile]
    first = {"4": 8, "6": 0, "7": 0}[profile]
    size = {"4": 4, "6": 2, "7": 8}[profile]
    from maplines_can.restbus.e2e_protection import checksum

    payloads = protected(tmp_path, crc, counter, {"profile": int(profile), "data_id": 0x12}, length)
    numbers = [int.from_bytes(p[4:5], "big") for p in payloads] if profile == "6" else None
    assert numbers is None or numbers == [n % 256 for n in range(41)]
    for payload in payloads:
        reference = bytearray(payload)
        module(reference, 0x12, increment_counter=False)  # fills length and data ID
        rest = bytes(reference[:first] + reference[first + size :])
        own = checksum(profile, rest, 0x12, "both", 0).to_bytes(size, "big")
        assert own == bytes(reference[first : first + size])


@pytest.mark.parametrize("dbc", ["maplines.dbc", "maplines-pose.dbc", "maplines-scene.dbc"])
def test_scenes_are_sent_and_stopped(dbc: str) -> None:
    values = {
        "lines": {"scenario": "production", "dbc": dbc, "pose_error": True},
        "event": [{"at_s": 0.5, "command": "stop lines"}, {"at_s": 0.8, "command": "start lines"}],
    }
    received = run(values, 1.0)
    decoder = Codec.from_dbc(Path("dbc") / dbc if Path("dbc").exists() else None).decoder()
    for m in received:
        decoder.feed(m.arbitration_id, bytes(m.data), round(m.timestamp * 1e9))
    assert decoder.scene() is not None
    assert not [m for m in received if 0.5 <= m.timestamp < 0.8]
    assert [m for m in received if m.timestamp >= 0.8]


def test_lines_of_a_script_a_log_and_a_drive(tmp_path: Path) -> None:
    (tmp_path / "lines.py").write_text(
        "from maplines_can import MapLine, Slot\n"
        "def lines(t):\n"
        "    return [MapLine.with_sigma(Slot.EGO_LEFT, [1 + t, 0, 0, 0], [.1, .01, .001, 1e-4])]\n"
    )
    received = run({"lines": {"script": "lines.py"}}, 1.0, tmp_path)
    offsets = decoded_offsets(received)
    assert offsets == pytest.approx([1 + 0.05 * k for k in range(len(offsets))], abs=0.01)
    with can.Logger(tmp_path / "lines.log") as log:
        for m in received:
            log(m)
    again = run({"lines": {"log": "lines.log", "start_ms": 60}}, 1.0, tmp_path)
    repeated = decoded_offsets(again)
    assert len(repeated) >= 18
    assert all(min(abs(y - known) for known in offsets) < 0.01 for y in repeated)
    assert decoded_offsets(run({"lines": {"drive": "tour"}, "seed": 3}, 0.3, tmp_path))


def test_a_part_of_a_log(tmp_path: Path) -> None:
    """A channel, and a time; the lines before it are decoded, and the first one is sent at once."""
    script = (
        "from maplines_can import MapLine, Slot\n"
        "def lines(t):\n"
        "    mean = [{} + t, 0, 0, 0]\n"
        "    return [MapLine.with_sigma(Slot.EGO_LEFT, mean, [.1, .01, .001, 1e-4])]\n"
    )
    rows = []
    for channel, offset in (("a", 1), ("b", 4)):
        (tmp_path / "lines.py").write_text(script.format(offset))
        for m in run({"lines": {"script": "lines.py"}}, 1.0, tmp_path):
            data = bytes(m.data).hex()
            rows.append(f"({m.timestamp:.6f}) {channel} {m.arbitration_id:03X}#{data}\n")
    (tmp_path / "two.log").write_text("".join(sorted(rows)))
    part = {"log": "two.log", "log_channel": "b", "log_time": "0.4..0.7"}
    sent = decoded_offsets(run({"lines": part}, 1.0, tmp_path))
    assert min(sent) == pytest.approx(4.4, abs=0.06)
    assert max(sent) == pytest.approx(4.7, abs=0.06)
    for changed, error in [
        ({"log_channel": "c"}, r"has no frame of channel 'c'; there are 'a', 'b'"),
        ({"log_time": "50..60"}, "log: two.log: has no frame in this time"),
        ({"log_time": "5"}, r"log_time must be FROM\.\.TO in seconds"),
    ]:
        with pytest.raises(RestbusError, match=error):
            run({"lines": part | changed}, 0.1, tmp_path)


def test_a_drive_that_is_not_on_the_map_is_refused(tmp_path: Path) -> None:
    """Otherwise no line would be sent."""
    (tmp_path / "far.csv").write_text("time,x,y,heading\n0,1e6,0,0\n9,1e6,9,0\n")
    with pytest.raises(DriveFileError, match=r"far\.csv: no position is on the map"):
        run({"lines": {"drive": "far.csv"}}, 0.3, tmp_path)


def test_a_tour_that_no_car_can_drive_is_refused(tmp_path: Path) -> None:
    """The error advises to change what a configuration has."""
    text = document(road(section(lane(-1)), plan=geometry(length=0.5), length=0.5))
    (tmp_path / "short.xodr").write_text(text)
    with pytest.raises(RestbusError, match=r"short\.xodr cannot be driven: .* 0\.5 m, .* seed, or"):
        run({"lines": {"drive": "tour", "map": "short.xodr"}}, 0.3, tmp_path)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        pytest.param("", "a.log: has no frame", id="empty"),
        pytest.param("(1.0) can0 100#00\n", "no DBC of this package fits", id="foreign"),
    ],
)
def test_a_log_without_a_line_is_refused_at_the_start(
    tmp_path: Path, text: str, error: str
) -> None:
    """It would send nothing."""
    (tmp_path / "a.log").write_text(text)
    with pytest.raises(RestbusError, match=f"lines: log: .*{error}"):
        run({"lines": {"log": "a.log"}}, 0.1, tmp_path)
    with pytest.raises(RestbusError, match="log_times must be auto, absolute, zero or delta"):
        run({"lines": {"log": "a.log", "log_times": "relative"}}, 0.1, tmp_path)


def decoded_offsets(messages: list[can.Message]) -> list[float]:
    decoder, offsets = Codec.from_dbc().decoder(), []
    for m in messages:
        answer = decoder.feed(m.arbitration_id, bytes(m.data), round(m.timestamp * 1e9))
        if not isinstance(answer, Reason):
            offsets += [line.gaussian.mean[0] for line in answer if line.slot == Slot.EGO_LEFT]
    return offsets


def test_faults_and_signals_are_switched_at_their_times() -> None:
    values = motion(Speed=1.0) | {
        "event": [
            {"at_s": 0.1, "command": "set Motion.Speed 2"},
            {"at_s": 0.2, "command": "fault drop 1"},
            {"at_s": 0.4, "command": "fault off"},
            {"at_s": 0.6, "command": "stop Motion"},
            {"at_s": 0.805, "command": "start Motion"},
            {"at_s": 0.9, "command": "reset Motion.Speed"},
        ]
    }
    seen = [(round(m.timestamp * 1e3), m) for m in run(values, 1.0)]
    assert [t for t, _ in seen] == [
        *range(0, 200, 20), *range(400, 600, 20), *range(805, 1001, 20),
    ]  # fmt: skip
    speeds = {t: CAR.decode_message(257, m.data)["Speed"] for t, m in seen}
    assert {t for t, speed in speeds.items() if speed == 1.0} == {
        *range(0, 100, 20), *range(905, 1001, 20),
    }  # fmt: skip


def test_delays_and_floods_use_the_virtual_clock() -> None:
    values = motion() | {"faults": "delay=0.005,flood=1000,flood_ids=0x700"}
    received = run(values, 0.5)
    assert microseconds(received, 257) == [5000 + 20_000 * k for k in range(25)] + [500_000]
    assert microseconds(received, 0x700)[:499] == [1000 * k for k in range(1, 500)]


def test_the_same_seed_gives_the_same_frames() -> None:
    values = motion() | {"faults": "loss=0.3,flip=0.1", "seed": 5}
    first, second, other = run(values, 2.0), run(values, 2.0), run(values | {"seed": 6}, 2.0)
    assert [bytes(m.data) for m in first] == [bytes(m.data) for m in second]
    assert [m.timestamp for m in first] != [m.timestamp for m in other]


def test_commands_of_another_thread_in_real_time() -> None:
    errors: list[str] = []
    network = VirtualNetwork(VirtualClock())
    with VirtualTimeBus(network) as bus, VirtualTimeBus(network) as other:
        clock = RealClock()
        restbus = Restbus(Config.from_dict(motion()), bus, clock, on_error=errors.append)
        restbus.start()

        def operator() -> None:
            restbus.command("set Motion.Speed 42")
            restbus.command("set Motion.Spede 42")

        thread = threading.Thread(target=operator)
        thread.start()
        clock.run_for(0.2)
        thread.join()
        restbus.stop()
        speeds = [
            CAR.decode_message(257, m.data)["Speed"] for m in iter(lambda: other.recv(0), None)
        ]
    assert speeds[-1] == 42.0
    assert errors == ["Motion.Spede: Motion has no signal 'Spede'; did you mean 'Speed'?"]
    assert restbus.as_dict()["commands"] == 1


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"secnds": 3}, "unknown key 'secnds'; did you mean 'seconds'?"),
        ({"seconds": 0}, r"seconds must be a number in \[0.001, 10000000\] s, got 0"),
        ({"message": [{"name": "Motion"}]}, 'message Motion: dbc is missing; set dbc = "..."'),
        ({"message": [message("Motoin")]}, "no such message; did you mean 'Motion'"),
        ({"message": [message(), message()]}, "message Motion: stands twice"),
        ({"message": [message(cycle=3)]}, "message Motion: unknown key 'cycle'; did you mean"),
        ({"message": [message(cycle_ms=-1)]}, r"cycle_ms must be a number in \[0.1, .*\] ms"),
        ({"message": [message("Horn")]}, "message Horn: cycle_ms is missing"),
        ({"message": [message(count=3)]}, "gap_ms is missing"),
        ({"message": [message(count=3, gap_ms=10)]}, "gap_ms must be less than 10 ms"),
        (motion(Sped=1), "Motion has no signal 'Sped'; did you mean 'Speed'"),
        (motion(Speed=200), r"Speed must be a number in \[0, 100\] m/s, got 200"),
        (motion(Speed="fast"), "must be a number or a named value, got 'fast'"),
        (motion(Speed={"ramp": [0, 1]}), "period_s is missing"),
        (motion(Speed={"ramp": [0, 101], "period_s": 1}), r"ramp must be a number in \[0, 100\]"),
        (motion(Speed={"rmp": [0, 1]}), "unknown key 'rmp'; did you mean 'ramp'"),
        (motion(Speed={"script": "nowhere.py:f"}), "there is no file nowhere.py"),
        (motion() | {"lines": {}}, "must say where the lines come from, got none"),
        ({"lines": {"scenario": "produktion"}}, "did you mean 'production'"),
        (motion() | {"event": [{"at_s": 1, "command": "sett M.S 1"}]}, "unknown command 'sett'"),
        (motion() | {"event": [{"at_s": 1, "command": "fault los=1"}]}, "event at 1 s: faults: "),
        (motion() | {"event": [{"at_s": 1, "command": "stop Motoin"}]}, "did you mean 'Motion'"),
        (motion() | {"faults": "loss=2"}, "loss must be in"),
        ({}, r"there is nothing to send; add \[lines\] or"),
        (
            {"message": [message(e2e={"profile": 3})]},
            "profile must be one of 1, 2, 4, 5, 6, 7, 11, got '3'",
        ),
        (
            {"message": [message(e2e={
                "profile": 5, "data_id": 1, "counter": "MotionCounter", "crc": "MotionCrc"})]},
            "counter of profile 5 has 8 bits, MotionCounter has 4",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_cure(change: dict[str, Any], text: str) -> None:
    with pytest.raises(RestbusError, match=text) as caught:
        run(change, 0.01)
    assert "\n" not in str(caught.value)


def test_a_script_that_fails_names_the_time(tmp_path: Path) -> None:
    (tmp_path / "s.py").write_text("def f(t):\n    return 1 / (0.04 - round(t, 6))\n")
    with pytest.raises(RestbusError, match=r"s.py:f fails at 0.04 s: ZeroDivisionError"):
        run(motion(Speed={"script": "s.py:f"}), 0.1, tmp_path)
