"""Frames of the covariance codes for comparison: what a line is besides its covariance."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.scene_streams import road_scene

from maplines_can import Gaussian, GaussianMixture, MapLine, Slot, Status
from maplines_can.cli import main
from maplines_can.generation.dbc.record_spec import DEFAULT
from maplines_can.recordings.read_lines import read_lines
from maplines_can.study.code_dbcs import dbc_writer_for
from maplines_can.study.comparison import ComparisonCodec, codec_for
from maplines_can.values.errors import EncodeError, LayoutError
from maplines_can.values.line import Kind
from maplines_can.wire import POSE, Codec, Layout, Reason

MEAN = np.array([1.75, 0.01, 1e-3, 1e-6])
COV = np.diag([0.1, 0.01, 1e-4, 1e-5]) ** 2
MS = 1_000_000


@cache
def codec_of(code: str) -> ComparisonCodec:
    codec = codec_for(Layout.from_text(dbc_writer_for(code).dbc(), code))
    assert isinstance(codec, ComparisonCodec)
    return codec


def sent(line: MapLine, code: str = "Linear", *, fd: bool = False) -> MapLine:
    """Return the line that a receiver gets, with the last frame."""
    decoder = codec_of(code).decoder()
    frames = codec_of(code).encoder().encode(line, fd=fd)
    *before, answer = [decoder.feed(frame.can_id, frame.data, 0) for frame in frames]
    assert before == [Reason.PENDING] * (len(frames) - 1)
    assert not isinstance(answer, Reason)
    return answer[0]


@pytest.mark.parametrize("fd", [False, True])
def test_all_of_a_line_arrives(fd: bool) -> None:
    """Range and age are rounded to the cautious side."""
    line = MapLine(
        Slot.NEXT_LEFT, Gaussian(MEAN, COV), kind=Kind.DOUBLE, x_min=-9.0, x_max=61.0, age=0.0405
    )
    got = sent(line, fd=fd)
    assert (got.slot, got.kind, got.status) == (Slot.NEXT_LEFT, Kind.DOUBLE, Status.FULL)
    assert (got.x_min, got.x_max) == (-8.0, 60.0)
    assert 0.0405 <= got.age < 0.06
    assert np.linalg.eigvalsh(got.gaussian.cov - COV)[0] > 0
    assert math.isinf(sent(replace(line, age=math.inf)).age)


@pytest.mark.parametrize(
    ("code", "changed", "status"),
    [
        pytest.param("Linear", {"status": Status.DIAGONAL}, Status.DIAGONAL, id="requested"),
        pytest.param("Linear", {"status": Status.REPAIRED}, Status.REPAIRED, id="repaired"),
        pytest.param("Linear", {"status": Status.UNKNOWN}, Status.UNKNOWN, id="no-covariance"),
        pytest.param("Sigmas", {}, Status.DIAGONAL, id="the-best-of-sigmas"),
        pytest.param("MeanOnly", {}, Status.UNKNOWN, id="the-best-of-the-mean"),
        pytest.param("Linear", {"x_min": 50.0, "x_max": 51.0}, Status.OUT_OF_RANGE, id="range"),
        pytest.param("Sigmas", {"gaussian": Gaussian([40, 0, 0, 0], COV)}, Status.DIAGONAL, id="y"),
        pytest.param(
            "LogCholesky", {"gaussian": Gaussian([40, 0, 0, 0], COV)}, Status.SATURATED, id="y-full"
        ),
        pytest.param(
            "MeanOnly", {"gaussian": Gaussian([40, 0, 0, 0], COV)}, Status.OUT_OF_RANGE, id="y-mean"
        ),
        pytest.param(
            "Linear", {"gaussian": Gaussian(MEAN, 1e6 * COV)}, Status.OUT_OF_RANGE, id="too-wide"
        ),
    ],
)
def test_the_status_says_what_a_covariance_is_worth(
    code: str, changed: dict[str, Any], status: Status
) -> None:
    """A code supports some only, and what does not fit is never clipped silently."""
    line = MapLine(Slot.EGO_LEFT, Gaussian(MEAN, COV), x_min=0.0, x_max=0.0)
    assert sent(replace(line, **changed), code).status is status


def test_a_mixture_is_sent_component_by_component() -> None:
    """Its decoded weights add up to 1, and each component covers its own covariance."""
    components = [Gaussian(MEAN, COV), Gaussian(MEAN + np.eye(4)[0], COV)]
    line = MapLine.of_mixture(Slot.EGO_RIGHT, GaussianMixture([0.3, 0.7], components))
    got = sent(line)
    assert got.mixture is not None
    assert got.mixture.weights.tolist() == [10 / 32, 22 / 32]
    assert got.mixture.means[:, 0] == pytest.approx([1.75, 2.75], abs=1e-3)
    for cov in got.mixture.covs:
        assert np.linalg.eigvalsh(cov - COV)[0] > 0


def test_counters_go_on_and_wrap() -> None:
    """A receiver sees each record once, and in sequence."""
    encoder, decoder = codec_of("Sigmas").encoder(), codec_of("Sigmas").decoder()
    line = MapLine(Slot.EGO_LEFT, Gaussian(MEAN, COV))
    for cycle in range(260):
        for frame in encoder.encode(line):
            decoder.feed(frame.can_id, frame.data, cycle * 50 * MS)
    assert (decoder.lines, decoder.lost) == (260, 0)
    assert not decoder.counts


def test_a_message_of_the_pose_error_is_left_out() -> None:
    """Its frames are foreign; no code for comparison sends scenes."""
    codec = codec_for(Layout.from_text(replace(DEFAULT, covariance_code="LogCholesky").dbc()))
    assert POSE not in codec.layout.messages_of
    with pytest.raises(EncodeError, match="no message of the pose error"):
        codec.encoder().encode_scene(road_scene())


def test_the_core_has_its_own_codes_only() -> None:
    """Each of both names the other's, or all there are."""
    layout = Layout.from_text(dbc_writer_for("Float16").dbc(), "half.dbc")
    with pytest.raises(LayoutError, match=r"half.dbc: .*'Float16' is none of the core.*codec_for"):
        Codec(layout)
    assert isinstance(codec_for(Layout.from_dbc()), Codec)
    with pytest.raises(LayoutError, match="'Zip' is not known; there are Cholesky, LogCholesky"):
        codec_for(replace(layout, covariance_code="Zip"))


# ---- commands ----------------------------------------------------------------------------------


def test_commands_send_and_decode_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log with the frames of a code of the study is read with its DBC, and with no other."""
    monkeypatch.chdir(tmp_path)
    dbc = ["--dbc", "maplines-float16.dbc"]
    assert (
        main(["drive", "--as-fast-as-possible", "--seconds", "1", "--record", "d.log", *dbc]) == 0
    )
    capsys.readouterr()
    assert main(["decode", "d.log", *dbc]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert len(rows) == 60
    assert '"status": "REPAIRED"' in rows[0]  # float16 loses the variance of c1
    assert len(read_lines("d.log", dbc=codec_of("Float16"))) == 60
    assert main(["decode", "d.log"]) == 1
    assert "no record of maplines.dbc is whole" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        pytest.param(["claims"], "'Linear' is none of the core", id="claims"),
        pytest.param(["figures", "--out", "new"], "'Linear' is none of the core", id="figures"),
        pytest.param(["send", "--key-file", "key"], "'Linear' are not authenticated", id="key"),
        pytest.param(["send", "--pose-error"], "no message of the pose error", id="scenes"),
    ],
)
def test_commands_that_cannot_say_so(
    words: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One line, and a nonzero status."""
    monkeypatch.chdir(tmp_path)
    key = Path("key")
    key.touch(0o600)
    key.write_text("".join(f"{byte:02x}" for byte in range(16)))
    assert main([*words, "--dbc", "maplines-linear.dbc"]) == 1
    assert message in capsys.readouterr().err.splitlines()[-1]
