"""The command ``maplines selftest``: what it says, and its status."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from support.fixtures import Capture, Patch

from maplines_can.cli import main, selftest
from maplines_can.model import e2e
from maplines_can.testing import back_to_back
from maplines_can.wire import Layout, default_dbc_path
from maplines_can.wire.protection import key

SECURED = Layout.from_dbc(default_dbc_path("maplines-secoc.dbc"))
SHORT = ["selftest", "--seconds", "0.001"]


def test_core_and_model_are_equal(capsys: Capture) -> None:
    """One stream at least is compared, however short the time is."""
    assert main(SHORT) == 0
    receivers, senders, maps, logs = capsys.readouterr().out.splitlines()
    found = re.fullmatch(r"bit-identical on (\d+) records \(2000 frames in 1 streams\)", receivers)
    assert senders.startswith("bit-identical on ")
    assert maps == "bit-identical on 10 queries of maps"
    assert logs == "bit-identical on 50 damaged logs"
    assert found is not None
    assert int(found[1]) > 100


def test_other_dbcs_can_be_given(capsys: Capture, tmp_path: Path) -> None:
    """By a path, or by the name of one of the package; a missing one is an error."""
    path = tmp_path / "own.dbc"
    path.write_text(default_dbc_path("maplines-pose.dbc").read_text())
    assert main([*SHORT, "--dbc", str(path), "--seed", "3", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    keys = {"frames", "records", "streams", "difference", "senders", "maps", "logs"}
    assert result.keys() == keys
    assert result["difference"] is None
    assert result["maps"] == {"queries": 10, "difference": None}
    assert main([*SHORT, "--dbc", "none.dbc"]) == 1
    assert "none.dbc" in capsys.readouterr().err


def test_the_first_difference_ends_it_with_status_1(capsys: Capture, monkeypatch: Patch) -> None:
    """It says where: the stream, the frame and the value by both."""
    monkeypatch.setattr(e2e, "OKS", ())  # the first stream has a line, whose slot is never VALID
    assert main(SHORT) == 1
    text = capsys.readouterr().out
    assert text.startswith("core and model differ: ")
    assert "maplines.dbc" in text
    assert "by the core" in text


def test_without_cryptography_the_rest_is_compared(capsys: Capture, monkeypatch: Patch) -> None:
    """It says what is not compared, and which extra has it."""
    monkeypatch.setattr(back_to_back, "HAS_MAC", False)
    monkeypatch.setattr(selftest, "HAS_MAC", False)
    monkeypatch.setattr(key, "_primitives", lambda: pytest.fail("there is no cryptography"))
    assert not any(one.has_keys for one in back_to_back.profiles_of(SECURED))
    for profile in back_to_back.profiles_of(SECURED):
        back_to_back.Pair(SECURED, profile)
    assert main(SHORT) == 0
    captured = capsys.readouterr()
    assert captured.out.startswith("bit-identical on ")
    expected = 'maplines: authenticated frames are not compared; install the extra "secoc"'
    assert captured.err.startswith(expected)
