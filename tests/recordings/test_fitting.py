"""What fits frames is known by whole records; chance is excluded."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import pytest

from maplines_can import Codec, MapLine, Slot
from maplines_can.bus import LogFrame
from maplines_can.logs import first_frames
from maplines_can.logs.first_frames import FirstFrames
from maplines_can.recordings import fitting
from maplines_can.recordings.blocks import read_blocks
from maplines_can.recordings.fitting import Fit, best_fit, check_fit, fits, misfit
from maplines_can.values.errors import LogError
from maplines_can.wire import default_dbc_path

POSE = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
LINE = MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0])


@pytest.mark.parametrize(
    ("chance", "is_sure"),
    [
        pytest.param(0.0, False, id="none"),
        pytest.param(-2.999, False, id="just-above"),
        pytest.param(-3.0, True, id="at-the-bound"),
        pytest.param(-3.78, True, id="one-record-of-four-frames"),
    ],
)
def test_a_fit_is_sure_below_a_chance(chance: float, is_sure: bool) -> None:
    """Of 1e-3."""
    assert Fit(Codec.from_dbc(), 4, 4, 1, 1, chance).is_sure == is_sure


def written(path: Path, frames: int, foreign: int = 0) -> Path:
    """Write the first frames of one record of maplines.dbc, after random ones with its CAN ID."""
    rows = [f"({1 + k / 1000:.6f}) can0 341#00{k:04X}0000000000\n" for k in range(foreign)]
    own = Codec.from_dbc().encoder().encode(LINE)[:frames]
    rows += [f"(9.{k:06d}) can0 {one.can_id:03X}#{one.data.hex()}\n" for k, one in enumerate(own)]
    path.write_text("".join(rows))
    return path


def test_one_whole_record_fits_a_short_log(tmp_path: Path) -> None:
    """The bound on its chance is 4 e 2^-16; a record that is not whole does not fit."""
    found = fits(written(tmp_path / "a.log", 4))
    assert found[0].records == 1
    assert found[0].chance == pytest.approx(math.log10(4 * math.e / 2**16))
    assert best_fit(found, tmp_path / "a.log").name == "maplines.dbc"
    log = written(tmp_path / "b.log", 3)
    with pytest.raises(LogError, match=r"b\.log: no DBC fits: .* no DBC of this package fits"):
        best_fit(fits(log), log)


def test_one_whole_record_among_many_frames_may_be_chance(tmp_path: Path) -> None:
    """A probability of less than 1e-3 is asked for."""
    found = fits(written(tmp_path / "a.log", 4, foreign=100))
    assert (found[0].records, found[0].frames) == (1, 104)
    with pytest.raises(LogError, match="no DBC fits"):
        best_fit(found, tmp_path / "a.log")


def test_a_log_is_read_until_a_line(tmp_path: Path) -> None:
    """One record is enough; without it the reason is that of `misfit`."""
    check_fit(written(tmp_path / "a.log", 4), Codec.from_dbc())
    with pytest.raises(LogError, match=r"take --dbc maplines\.dbc"):
        check_fit(tmp_path / "a.log", POSE)


@pytest.mark.parametrize(("most", "text"), [(8, "; 2 records"), (7, "; at least 1 record ")])
def test_records_of_which_frames_are_not_kept(
    most: int, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There are at least those of the frames that are kept."""
    monkeypatch.setattr(first_frames, "MAX_EACH", most)
    first, encoder = FirstFrames(), Codec.from_dbc().encoder()
    for k, one in enumerate(encoder.encode(LINE) + encoder.encode(LINE)):
        first.add(LogFrame(one.can_id, bytes(one.data), k * 10**6, False, "", has_time=True))
    assert text in misfit(first, [POSE]).text


@pytest.mark.parametrize(("frames", "text"), [(4, "1 record of maplines.dbc"), (3, "no DBC of")])
def test_a_single_record_names_its_dbc(frames: int, text: str) -> None:
    """If it is whole."""
    first = FirstFrames()
    for k, one in enumerate(Codec.from_dbc().encoder().encode(LINE)[:frames]):
        first.add(LogFrame(one.can_id, bytes(one.data), k * 10**6, False, "", has_time=True))
    assert text in misfit(first, [POSE]).text


@pytest.mark.parametrize(
    ("most", "foreign", "records"),
    [
        pytest.param(8, 40, 1, id="on-to-the-first-fit"),
        pytest.param(1000, 40, 2, id="on-to-the-most-frames"),
    ],
)
def test_a_log_is_read_until_a_dbc_fits(
    most: int, foreign: int, records: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sender that starts late is found, and after so many frames nothing more is read."""
    monkeypatch.setattr(fitting, "MOST_FRAMES", most)
    monkeypatch.setattr(fitting, "read_blocks", partial(read_blocks, block_frames=4))
    encoder = Codec.from_dbc().encoder()
    own = encoder.encode(LINE) + encoder.encode(LINE)
    rows = [f"({1 + k / 1000:.6f}) can0 100#00\n" for k in range(foreign)]
    rows += [f"(9.{k:06d}) can0 {one.can_id:03X}#{one.data.hex()}\n" for k, one in enumerate(own)]
    (tmp_path / "a.log").write_text("".join(rows))
    assert fits(tmp_path / "a.log")[0].records == records
