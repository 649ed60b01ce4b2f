"""The command ``maplines demo``, for people and for machines."""

import json
import re
from dataclasses import replace
from functools import partialmethod
from pathlib import Path
from typing import Any

import pytest
from support.dbcs import edited
from support.fake_bus import LONG
from support.fixtures import Capture, Patch
from support.lines import lines_timed_out, scenario_lines

from maplines_can import Codec, Link, Polyline, Slot, Transmitter
from maplines_can.cli import main
from maplines_can.cli.sending import components_text
from maplines_can.simulation import scenario
from maplines_can.simulation.bus_share import BusShare, choose_components
from maplines_can.simulation.round_trip import _Arrivals
from maplines_can.simulation.scenarios import SCENARIOS


@pytest.fixture(autouse=True)
def no_timeout(monkeypatch: Patch) -> None:
    """Wait for all lines, and let no transfer time out: a machine that is busy is no fault."""
    decoder = partialmethod(Codec.decoder, timeout_ms=3_600_000)
    monkeypatch.setattr(Codec, "decoder", decoder)
    wait_for = _Arrivals.wait_for
    monkeypatch.setattr(
        _Arrivals, "wait_for", lambda self, lines, timeout: wait_for(self, lines, LONG + timeout)
    )


@pytest.mark.parametrize("fd", [False, True])
def test_json(capsys: Capture, fd: bool) -> None:
    """All lines are received, and each has its figures."""
    arguments = ["demo", "--seconds", "0.3", "--rate", "50", "--json", *(["--fd"] if fd else [])]
    assert main([*arguments, "--scenario", "production", "--lines", "8"]) == 0
    result = json.loads(capsys.readouterr().out)
    received = result["received"]
    lost = lines_timed_out(received["counts"], received["pending"], 1 if fd else 4)
    assert (result["lines_lost"], result["frames_lost"]) == (lost, 0)
    lines = result["sent"]["lines"]
    assert lines == received["lines"] + lost > 0
    assert lines + result["sent"]["overruns"] == 15 * 8  # a busy machine may skip periods
    assert result["sent"]["frames"] == lines * (1 if fd else 4)
    assert [line["slot"] for line in result["lines"]] == [slot.name for slot in Slot]
    for line in result["lines"]:
        assert line["kl_covered"] < 0.02
        assert line["x"] == 76  # XMax is a multiple of 4 m, and the lines end before 80 m
        assert abs(line["y"] - line["true_y"]) < 0.005
        assert 1 <= line["y_sigma"] / line["true_y_sigma"] < 1.06


def test_text_and_picture(capsys: Capture, tmp_path: Path) -> None:
    """The table names each line, and the picture is drawn."""
    pytest.importorskip("matplotlib")
    picture = tmp_path / "demo.png"
    assert main(["demo", "--seconds", "0.2", "--map-error", "0.1", "--plot", str(picture)]) == 0
    text = capsys.readouterr().out
    for words in ("ego left", "next right", "KL", "at 76 m", "bus load  8.6 % at 500 kbit/s"):
        assert words in text
    assert re.search(r"lost +\d+ lines, 0 frames", text)
    (row,) = {*re.findall(r"KL [\d.]+ nat from the (.*), [\d.]+ nat from the (.*)", text)}
    assert row == ("covered target", "sent Gaussian")
    assert "KL: Kullback-Leibler divergence" in text
    assert "nonlinearity" not in text  # it says little about a single Gaussian
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_mixture_is_received_as_one_line(capsys: Capture, channel: str) -> None:
    """A mixture of three components is three transfers, and one line at the receiver."""
    assert main(["demo", "--seconds", "0.2", "--components", "3", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["sent"]["frames"] == 3 * 4 * result["sent"]["lines"]
    assert result["frames_lost"] == 0
    assert (result["lines_lost"] == 0) == ("TIMEOUT" not in result["received"]["counts"])
    with (
        Link(interface="virtual", channel=channel) as link,
        Transmitter(link, Codec.from_dbc(), period=0.05) as transmitter,
    ):
        transmitter.publish(scenario_lines(scenario("street-turn"), 2, components=3))
        bus = ["--interface", "virtual", "--channel", channel]
        assert main(["receive", *bus, "--count", "2", "--json"]) == 0
    row = json.loads(capsys.readouterr().out.splitlines()[0])
    assert row["components"] == 3
    assert sum(row["mixture"]["weights"]) == 1


def test_components_auto(capsys: Capture) -> None:
    """One for an accurate pose; in a turn as many as needed, or as the bus load allows."""

    def demo(name: Any, *more: Any) -> Any:
        command = ["demo", "--components", "auto", "--seconds", "0.1", "--rate", "50", "--json"]
        assert main([*command, "--scenario", name, *more]) == 0
        result = json.loads(capsys.readouterr().out)
        return result["bus_load"], result["components"]

    assert [line["components"] for line in demo("production")[1]] == [1] * 4
    load, lines = demo("street-turn-10deg", "--max-load", "0.5")
    assert load == pytest.approx(sum(line["components"] for line in lines) * 4 * 135 * 50 / 500_000)
    assert 0.5 - 4 * 135 * 50 / 500_000 < load <= 0.5
    for line in demo("street-turn-10deg", "--fd")[1]:
        assert line["remaining_nonlinearity"] <= 0.3 < line["nonlinearity"]


def test_the_number_of_components_is_printed(capsys: Capture, channel: str) -> None:
    """By demo under each line, by send before it starts, and in the JSON of both."""
    turn = ["--components", "auto", "--scenario", "street-turn-10deg", "--lines", "2", "--fd"]
    assert main(["demo", "--seconds", "0.1", *turn]) == 0
    send = ["send", "--interface", "virtual", "--channel", channel, "--rate", "50", "--count", "2"]
    assert main([*send, *turn]) == 0
    out, err = capsys.readouterr()
    chosen = choose_components(
        scenario("street-turn-10deg"), Codec.from_dbc(), 2, bus=BusShare(fd=True)
    )
    for line in chosen.values():
        assert line.components > 1
        assert components_text(line) in out
        assert components_text(line) in err
    assert main([*send, *turn, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    counts = [line.components for line in chosen.values()]
    assert [line["components"] for line in result["components"]] == counts
    assert min(counts) <= result["frames"] / result["lines"] <= max(counts)  # one frame for each


def test_item_12_lines_left_out_are_printed_with_their_reasons(
    capsys: Capture, channel: str, monkeypatch: Patch
) -> None:
    """By demo below the table, by send before it starts and in the end, and in the JSON of both."""
    scene = scenario("production")
    across = Polyline([[20.0, -9.0], [20.0, 9.0]])
    with_across = replace(scene, lines={**scene.lines, Slot.EGO_RIGHT: across})
    monkeypatch.setitem(SCENARIOS, "production", with_across)
    demo = ["demo", "--seconds", "0.1"]
    send = ["send", "--interface", "virtual", "--channel", channel, "--rate", "50", "--count", "2"]
    text = "left out: ego right (the line is across the car's x axis)"
    assert main(demo) == main(send) == 0
    out, err = capsys.readouterr()
    assert text in out
    assert text in err
    assert re.search(r"left out of those published: \d+ times, the line is across", out)
    assert main([*demo, "--json"]) == main([*send, "--json"]) == 0
    out = capsys.readouterr().out
    result, end = json.JSONDecoder().raw_decode(out)
    assert result["left_out"] == {"EGO_RIGHT": "ACROSS"}
    assert [line["slot"] for line in result["lines"]] == ["EGO_LEFT", "NEXT_LEFT", "NEXT_RIGHT"]
    assert json.loads(out[end:])["left_out"]["ACROSS"] >= 1
    monkeypatch.setitem(SCENARIOS, "production", replace(scene, lines={Slot.CENTRE: across}))
    for command in (demo, send):
        assert main(command) == 1
        assert "no line of the scenario 'production' can be sent; left out: centre" in (
            capsys.readouterr().err
        )


def test_item_11_lines_are_compared_within_their_valid_range(capsys: Capture) -> None:
    """At the end of the range where it is before 80 m."""
    arguments = ["demo", "--seconds", "0.1", "--scenario", "street-turn"]
    assert main([*arguments, "--json"]) == 0
    lines = json.loads(capsys.readouterr().out)["lines"]
    sent = {line.slot.name: line for line in scenario_lines(scenario("street-turn"))}
    for line in lines:
        true = sent[line["slot"]]
        assert 0 < line["x"] <= true.x_max < 30
        assert line["true_y"] == true.y(line["x"])
        assert line["true_y_sigma"] == true.y_sigma(line["x"])
        assert abs(line["y"] - line["true_y"]) < 0.005
        assert line["y_sigma"] < 10
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert " 80 m" not in text
    assert f"± {lines[0]['y_sigma']:.3f} at {lines[0]['x']:g} m" in text


def test_item_1_a_line_out_of_range_is_not_printed(capsys: Capture, tmp_path: Path) -> None:
    """It has no values that could be compared."""
    dbc = edited(tmp_path, (r"(SG_ XMin\b.*?)\(4,-20\) \[-20\|8\]", r"\1(8,-160) [-160|-104]"))
    assert main(["demo", "--dbc", str(dbc), "--seconds", "0.1", "--lines", "1"]) == 0
    text = capsys.readouterr().out
    assert "received  out of range: not usable" in text
    assert "nat from" not in text
