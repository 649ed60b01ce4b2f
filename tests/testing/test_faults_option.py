"""The commands inject the faults of --faults and report what was done."""

import json
import re

import pytest
from support.fault_streams import MIX

from maplines_can.cli import main


def test_demo_reports_the_faults(capsys: pytest.CaptureFixture[str]) -> None:
    """As text and as JSON; the sums are right."""
    command = ["demo", "--seconds", "0.5", "--rate", "50", "--faults", f"{MIX},seed=3"]
    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    done = result["faults"]
    assert done["frames"] == result["sent"]["frames"]
    assert (
        result["received"]["frames"]
        == done["frames"] + done["duplicated"] - done["lost"] - (done["held"])
    )
    assert result["frames_lost"] == done["lost"] + done["held"] > 0
    assert result["lines_lost"] > 0
    assert main(command) == 0
    text = capsys.readouterr().out
    (sent,) = re.findall(r"^sent .* (\d+) frames$", text, re.MULTILINE)
    (lost,) = re.findall(r"^lost .*? (\d+) frames\b", text, re.MULTILINE)
    (line,) = re.findall(r"^faults    .*", text, re.MULTILINE)
    done = {name: int(n) for n, name in re.findall(r"(\d+) (\w+)", line)}
    assert done["frames"] == int(sent)
    assert done["lost"] + done["held"] == int(lost)
    assert done["frames"] + done["duplicated"] == done["passed"] + done["lost"] + done["held"]


def test_send_and_receive_report_the_faults(capsys: pytest.CaptureFixture[str]) -> None:
    bus = ["--interface", "virtual", "--channel", "faults-option"]
    send = ["send", *bus, "--rate", "200", "--count", "5", "--faults", "dup=1"]
    assert main([*send, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["faults"]["duplicated"] == result["frames"]
    assert main(send) == 0
    assert "duplicated" in capsys.readouterr().out
    flood = ["--faults", "flood=1000,flood_ids=0x340"]
    assert main(["receive", *bus, *flood, "--count", "1", "--timeout", "1"]) == 1
    assert "flooded" in capsys.readouterr().err
