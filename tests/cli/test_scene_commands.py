"""The commands with scenes: lines that are sent with the error of their pose."""

import json
import math
import re
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from answers import lines_of, one
from support.dbcs import DBC
from support.drive_files import run, town
from support.fake_bus import message_of
from support.fixtures import Capture, Patch
from support.sender_pairs import Sender, merged

from maplines_can import Codec, MapError, MapLine, Slot, map_scene, read_log
from maplines_can.cli import main
from maplines_can.cli.options import codec_from
from maplines_can.cli.output import LANE_X
from maplines_can.simulation import scenario
from maplines_can.values.elementary import exp2
from maplines_can.wire import POSE, SHIPPED, default_dbc_path

CONDITIONAL = "maplines-pose.dbc"
NAMES = ["maplines.dbc", CONDITIONAL]
#: Options that send scenes, by DBC.
SENDING = {"maplines.dbc": ["--pose-error"], CONDITIONAL: ["--dbc", CONDITIONAL]}
#: Options that receive them.
RECEIVING: dict[str, list[str]] = {"maplines.dbc": [], CONDITIONAL: ["--dbc", CONDITIONAL]}
CYCLES = 5


@pytest.fixture
def patient(monkeypatch: Patch) -> None:
    """Let nothing time out, in transfers and in scenes: a busy machine is no fault."""
    decoder = Codec.decoder
    hour = 3_600_000
    monkeypatch.setattr(
        Codec, "decoder", lambda codec, **_: decoder(codec, timeout_ms=hour, cycle_ms=hour)
    )


def scene_of(name: Any = "production", lines: int = 4, **settings: Any) -> Any:
    """Return the scene of the first lines of a scenario, with a map error of 5 cm."""
    found = scenario(name)
    first = dict(list(found.lines.items())[:lines])
    error = MapError(0.05, 0.05, math.radians(0.05))
    return map_scene(first, found.ego, window=found.window, map_error=error, **settings)


def transfers_of(codec: Codec, cycles: int = CYCLES, **settings: Any) -> list[Any]:
    """Return (time stamp [s], owner, frames) of the transfers of some cycles, 50 ms each."""
    encoder = codec.encoder()
    prepared = encoder.prepare_scene(scene_of(correlation_time=4.0), **settings)
    return [
        (1000.0 + 0.05 * cycle + 0.004 * place, owner, frames)
        for cycle in range(cycles)
        for place, (owner, frames) in enumerate(
            encoder.encode_scene(prepared, age=0.008, **settings).items()
        )
    ]


def write_log(path: Path, transfers: list[Any], *channels: str) -> list[str]:
    """Write transfers into a log of candump, and return the options that decode it."""
    with can.Logger(path) as writer:
        for stamp, _, frames in transfers:
            for frame, channel in ((f, c) for f in frames for c in channels):
                writer(message_of(frame, timestamp=stamp, channel=channel))
    return ["decode", str(path)]


def decoded(codec: Codec, transfers: list[Any]) -> tuple[list[MapLine], list[Any]]:
    """Return the lines of transfers, and the last state of each scene."""
    decoder, lines, scenes = codec.decoder(), list[MapLine](), dict[int, Any]()
    for stamp, _, frames in transfers:
        for frame in frames:
            lines += lines_of(decoder.feed(frame.can_id, frame.data, round(stamp * 1e9)))
        if received := decoder.scene():
            scenes[received.counter] = received
    assert decoder.lost == 0
    return lines, list(scenes.values())


def rows_of(text: str) -> tuple[list[Any], list[Any]]:
    """Return the rows of lines and those of scenes."""
    rows = [json.loads(row) for row in text.splitlines()]
    return [row for row in rows if "slot" in row], [row for row in rows if "scene" in row]


# ---- demo


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("fd", [False, True])
def test_demo_compares_lines_and_the_ego_lane(capsys: Capture, name: str, fd: bool) -> None:
    """Lines and lane are covered; taken as independent, the lane would be far off."""
    options = ["--seconds", "0.3", "--map-error", "0.05", "--json", *["--fd"] * fd]
    assert main(["demo", *options, *SENDING[name]]) == 0
    result = json.loads(capsys.readouterr().out)
    sent, scene = result["sent"], result["scene"]
    assert result["received"]["pose_errors"] == sent["pose_errors"] > 0
    assert (result["lines_lost"], result["frames_lost"]) == (0, 0)
    for line in result["lines"]:
        assert 0 <= line["kl_covered"] < 0.02
        assert 1 <= line["y_sigma"] / line["true_y_sigma"] < 1.1
    lane = scene["lane"]
    assert [(row["quantity"], row["x"]) for row in lane] == [
        (quantity, x) for quantity in ("width", "centre") for x in LANE_X
    ]
    true = scene_of()
    for row in lane:
        expected = getattr(true, row["quantity"])(row["x"])
        assert row["true_value"] == pytest.approx(expected.value)
        assert row["true_sigma"] == pytest.approx(expected.sigma)
        assert row["value"] == pytest.approx(row["true_value"], abs=0.01)
        assert row["sigma_ratio"] == row["sigma"] / row["true_sigma"] > 1 - 1e-6
        if row["quantity"] == "centre":
            assert row["independent_sigma"] < row["true_sigma"]
        else:
            assert row["independent_sigma"] > 1.5 * row["true_sigma"]
    assert scene["unsent"] == []
    codec = Codec.from_dbc(default_dbc_path(name))
    encoder = codec.encoder()
    frames = {
        owner if isinstance(owner, str) else owner.name: len(each)
        for owner, each in encoder.encode_scene(scene_of(), fd=fd).items()
    }
    assert scene["frames"] == frames
    assert scene["frames_per_cycle"] == sum(frames.values())
    assert scene["frames_of_full_records"] == 4 * (1 if fd else 4)
    line_frames = sum(frames.values()) - frames[POSE]
    assert sent["frames"] == sent["pose_errors"] * frames[POSE] + sent["lines"] * line_frames / 4


@pytest.mark.usefixtures("patient")
def test_demo_shows_the_lane_where_its_lines_are_valid(capsys: Capture) -> None:
    """In a turn they end before 20 m; a scene of one line has no lane."""
    demo = ["demo", "--seconds", "0.1", "--json", *SENDING[CONDITIONAL]]
    assert main([*demo, "--scenario", "street-turn"]) == 0
    result = json.loads(capsys.readouterr().out)
    low, high = scene_of("street-turn").x_range([Slot.EGO_LEFT, Slot.EGO_RIGHT])
    assert low < 0 < high < 20
    assert [(row["quantity"], row["x"]) for row in result["scene"]["lane"]] == [
        ("width", 0),
        ("centre", 0),
    ]
    assert main([*demo, "--lines", "1"]) == 0
    assert json.loads(capsys.readouterr().out)["scene"]["lane"] == []


# ---- send


@pytest.mark.parametrize("name", NAMES)
def test_send_counts_pose_errors(capsys: Capture, channel: str, name: str) -> None:
    """One CAN FD frame each; the note says what is sent, and so do text and JSON at the end."""
    bus = ["--interface", "virtual", "--channel", channel, "--fd", "--count", "3"]
    send = ["send", *bus, "--map-error", "0.05", "--correlation-time", "3", *SENDING[name]]
    assert main([*send, "--json"]) == 0
    stats = json.loads(capsys.readouterr().out)
    assert stats["frames"] == stats["lines"] + stats["pose_errors"]
    assert 0 < stats["pose_errors"] <= 3
    assert stats["lines"] <= 4 * stats["pose_errors"]
    assert main(send) == 0
    out, err = capsys.readouterr()
    assert "4 lines of production and their pose error on" in err
    assert re.search(r"sent \d+ lines and \d+ pose errors in \d+ frames", out)


# ---- receive


@pytest.mark.parametrize("name", NAMES)
def test_receive_prints_the_ego_lane_once_a_cycle(
    replay: Any, channel: str, capsys: Capture, name: str
) -> None:
    """Between the lines; the E2E state of the pose error is shown like that of a slot."""
    codec = Codec.from_dbc(default_dbc_path(name))
    transfers = transfers_of(codec, 8)
    _, scenes = decoded(codec, transfers)
    replay([(stamp, frames) for stamp, _, frames in transfers])
    bus = ["--interface", "virtual", "--channel", channel]
    assert main(["receive", *bus, "--count", "32", *RECEIVING[name]]) == 0
    out, err = capsys.readouterr()
    lane = [row for row in out.splitlines() if "ego lane" in row]
    assert len(out.splitlines()) == 32 + len(lane)
    assert 1 <= len(lane) <= 8
    width, centre = scenes[-1].scene.width(20.0), scenes[-1].scene.centre(20.0)
    assert lane[-1].startswith(f"{scenes[-1].t_ns / 1e9:.3f}  ego lane    at 0/20/40 m: width ")
    assert f", {width.value:.3f} ± {width.sigma:.3f}, " in lane[-1]
    assert f", {centre.value:+.3f} ± {centre.sigma:.3f}, " in lane[-1]
    assert "32 lines and 8 pose errors from" in err
    assert "pose error: VALID; 8 ok, 0 lost" in err.splitlines()[-1]
    assert re.search(r"pose error: (INIT|VALID); \d ok", err)


def check_row(row: Any, received: Any) -> None:
    """Check a row of a scene against the scene that a decoder returns."""
    scene = received.scene
    assert row["t"] == received.t_ns / 1e9
    assert row["age"] == received.age
    assert row["scene"] == ["EGO_LEFT", "EGO_RIGHT", "NEXT_LEFT", "NEXT_RIGHT"]
    assert np.array_equal(row["joint"]["cov"], scene.cov)
    assert np.array_equal(row["joint"]["mean"], scene.means.ravel())
    assert np.array_equal(row["pose_error"]["cov"], scene.pose_error.cov)
    assert row["pose_error"]["correlation_time"] == 4.0
    for quantity in ("width", "centre"):
        for each, x in zip(row[quantity], LANE_X, strict=True):
            value, sigma = getattr(scene, quantity)(x)
            assert each == {"x": x, "value": value, "sigma": sigma}


# ---- decode


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("fd", [False, True])
def test_decode_prints_each_scene_on_request(
    capsys: Capture, tmp_path: Path, name: str, fd: bool
) -> None:
    """One row a scene and channel, after its lines, which are the same with and without."""
    codec = Codec.from_dbc(default_dbc_path(name))
    transfers = transfers_of(codec, fd=fd)
    expected, scenes = decoded(codec, transfers)
    decode = write_log(tmp_path / "drive.log", transfers, "can0", "can1") + RECEIVING[name]
    assert main(decode) == 0
    lines, none = rows_of(capsys.readouterr().out)
    assert none == []
    assert len(lines) == 2 * len(expected) == 2 * 4 * CYCLES
    assert main([*decode, "--scenes"]) == 0
    out, err = capsys.readouterr()
    assert rows_of(out)[0] == lines
    for channel in ("can0", "can1"):
        rows = [row for row in rows_of(out)[1] if row["channel"] == channel]
        for row, scene in zip(rows, scenes, strict=True):
            check_row(row, scene)
            assert (row["usable"], row["two_senders"]) == (False, False)  # INIT
        assert f"{channel} pose error: INIT; {CYCLES} ok, 0 lost" in err
    assert f"{8 * CYCLES} lines and {2 * CYCLES} pose errors from" in err
    assert "dropped frames: none" in err
    assert main([*decode, "--csv"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(lines)


@pytest.mark.parametrize(("name", "every"), [(CONDITIONAL, 3), ("maplines.dbc", 10)])
def test_decode_says_which_scenes_are_usable(
    capsys: Capture, tmp_path: Path, name: str, every: int
) -> None:
    """None of two senders; before the second one, all after the state INIT."""
    end = 20 + 3 * every
    events = merged(name, [Sender(0), Sender(1, every, start=20.2, counters={POSE: 3})], end)
    transfers = [(100 + event.t_ns / 1e9, None, [event.frame]) for event in events]
    decode = write_log(tmp_path / "two.log", transfers, "can0") + RECEIVING[name]
    assert main([*decode, "--scenes"]) == 0
    _, rows = rows_of(capsys.readouterr().out)
    found = [(row["usable"], row["two_senders"]) for row in rows]
    assert found[:20] == [(False, False)] * 6 + [(True, False)] * 14
    assert {*found[20:]} == {(False, True)}


@pytest.mark.parametrize("name", NAMES)
def test_decode_without_time_stamps(capsys: Capture, tmp_path: Path, name: str) -> None:
    """The scenes are told apart by the counter of the pose error, even if they are equal."""
    codec = Codec.from_dbc(default_dbc_path(name))
    path = tmp_path / "plain.log"
    path.write_text(
        "".join(
            f"  can0  {frame.can_id:03X}   [8]  {frame.data.hex(' ').upper()}\n"
            for _, _, frames in transfers_of(codec)
            for frame in frames
        )
    )
    assert main(["decode", str(path), "--scenes", *RECEIVING[name]]) == 0
    lines, scenes = rows_of(capsys.readouterr().out)
    assert len(lines) == 4 * CYCLES
    assert [(row["t"], len(row["scene"])) for row in scenes] == [(None, 4)] * CYCLES


# ---- drive


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("fd", [False, True])
def test_drive_records_scenes(tmp_path: Path, capsys: Capture, name: str, fd: bool) -> None:
    """Every line of every cycle belongs to a scene, with its age and the correlation time."""
    log, seconds = tmp_path / "drive.log", ["--seconds", "2", "--map-error", "0.05"]
    fast = ["--as-fast-as-possible", "--route", "1:0:-2..1:0:-1", *seconds, *["--fd"] * fd]
    result = run(capsys, town(tmp_path), *fast, "--record", str(log), *SENDING[name])
    assert result["cycles"] == result["pose_errors"] == 40
    assert result["lines"] >= 2 * 40
    decoder = Codec.from_dbc(default_dbc_path(name)).decoder()
    lines, scenes = list[MapLine](), dict[int, Any]()
    for frame in read_log(log):
        answer = one(decoder.feed(frame.can_id, frame.data, frame.t_ns))
        if isinstance(answer, MapLine):
            lines.append(answer)
            received = decoder.scene()
            assert received is not None
            scenes[received.t_ns] = received
    assert not any(decoder.counts.values())
    assert decoder.lost == 0
    assert len(lines) == result["lines"]
    members = sum(len(each.scene.lines) for each in scenes.values())
    assert members == len(lines) if name == CONDITIONAL else 0.9 * len(lines) < members
    assert len(scenes) == 40
    assert max(each.age for each in scenes.values()) <= 0.008
    begun = {line.t_ns: each.t_ns for each in scenes.values() for line in each.scene.lines}
    for line in lines:
        assert line.t_ns is not None
        since = (line.t_ns - begun[line.t_ns]) / 1e9
        assert line.age == pytest.approx(since, abs=0.009)
    times = {each.scene.pose_error.correlation_time for each in scenes.values()}
    assert times == {float(exp2(3.5))}  # 10 s, in steps of half an octave
    assert result["bus_load"] < 0.2


# ---- options


@pytest.mark.parametrize("name", SHIPPED)
def test_the_name_of_a_dbc_of_this_package_is_enough(
    tmp_path: Path, monkeypatch: Patch, name: str
) -> None:
    """In any folder; a file of that name comes first."""
    monkeypatch.chdir(tmp_path)
    assert codec_from(name).layout.source == str(default_dbc_path(name))
    (tmp_path / name).write_text(DBC.read_text())
    assert codec_from(name).layout.source == name
