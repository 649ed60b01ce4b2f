"""Plots: what is drawn is what the table has, and the command writes it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can import Codec, Gaussian, MapLine, Slot
from maplines_can.bus import LogWriter
from maplines_can.cli import main
from maplines_can.logs.log_summary import LogSummary
from maplines_can.recordings.plots import write_page
from maplines_can.recordings.plots.log_panels import Panel, above, panels_of
from maplines_can.recordings.plots.recording import Recording, recorded
from maplines_can.recordings.read_lines import read_lines
from maplines_can.values.errors import LogError
from maplines_can.wire import default_dbc_path

POSE = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))


def test_bands_are_those_of_the_table(scene_log: Path) -> None:
    """Positions and the width, with 1, 2 and 3 of their sigmas."""
    recording, damage = recorded(scene_log, POSE, [20.0])
    assert recording.name == scene_log.name
    table = read_lines(scene_log, dbc=POSE, at=[20.0], scenes=True)
    panels = panels_of([recording], [20.0])
    assert not damage
    assert [panel.title.split(",")[0] for panel in panels] == [
        "lateral position at 20 m",
        "width of the ego lane",
        "centre of the ego lane",
        "age of the lines when they were sent",
        "E2E state of the slots",
    ]
    left = table.where(table["slot"] == "EGO_LEFT")
    scenes = table.scenes
    drawn = {band.label: band for band in panels[0].bands}["ego left"], panels[1].bands[0]
    expected = (left["t"], left["y20"], left["sigma20"]), (
        scenes["t"], scenes["width20"], scenes["sigma_width20"],
    )  # fmt: skip
    for band, (t, y, sigma) in zip(drawn, expected, strict=True):
        known, there = np.isfinite(band.y), np.isfinite(y)
        assert np.allclose(band.x[known] + recording.begin, t[there], rtol=0, atol=1e-6)
        assert np.array_equal(band.y[known], y[there])
        for k in range(3):
            assert np.allclose((band.high - band.y)[k, known], (k + 1) * sigma[there])
            assert np.allclose((band.y - band.low)[k, known], (k + 1) * sigma[there])


def test_many_points_are_joined(scene_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No band is narrower than that of any line within, and no median is outside of its band."""
    recording, _ = recorded(scene_log, POSE, [20.0])
    whole = {band.label: band for band in panels_of([recording], [20.0])[0].bands}
    monkeypatch.setattr("maplines_can.recordings.plots.log_panels.MOST_POINTS", 20)
    panel = panels_of([recording], [20.0])[0]
    assert "each point is the median" in panel.note
    for band in panel.bands:
        every, known = whole[band.label], np.isfinite(band.y)
        assert known.sum() <= 22
        assert (band.low[:, known] <= band.y[known]).all()
        assert (band.high[:, known] >= band.y[known]).all()
        assert np.nanmin(band.low) == np.nanmin(every.low)
        assert np.nanmax(band.high) == np.nanmax(every.high)


def test_states_and_rejects(faulty_log: Path) -> None:
    """A strip for each run of a state, and a row for each reason."""
    recording, _ = recorded(faulty_log, Codec.from_dbc(), [20.0])
    table = read_lines(faulty_log)
    panel = panels_of([recording], [20.0])[-1]
    names = {row.partition(" (")[0] for row in panel.rows}
    assert names >= {"ego left", "ego right", "crc", "length"}
    for dots in panel.dots:
        count = int((table.rejects["reason"] == dots.label.upper()).sum())
        assert len(dots.x) == count
        assert f"{dots.label} ({count})" in panel.rows
    row = panel.rows.index("ego left")
    own = table.where(table["slot"] == "EGO_LEFT")
    t = own["t"] - recording.begin
    for strip in (one for one in panel.strips if one.row == row):
        here = (t >= strip.begin) & (t < strip.end)
        assert {*own["state"][here]} <= {strip.label}


def scenes_of(name: str, width: float | None) -> Recording:
    """Return a recording whose lane has a width; with None, without scenes."""
    t = np.arange(5.0)
    given = {"width20": width, "centre20": 0.0}
    scenes = {"t": t} | {n: np.full(5, value) for n, value in given.items()}
    scenes |= {f"sigma_{n[:-2]}20": np.full(5, 0.1) for n in given}
    rows = {"t": t, "y20": t, "sigma20": t, "age": t, "status": np.zeros(5, int)}
    rows |= {"usable": np.ones(5, bool), "state": np.full(5, "VALID")}
    lines = {"ego left": rows}
    return Recording(name, 0.0, lines, scenes if width else {}, {"CRC": t}, LogSummary())


@pytest.mark.parametrize(
    ("names", "widths", "drawn"),
    [
        pytest.param(
            ("a.blf", "b.blf"), (3.0, 4.0), {"a.blf": (3.0, False), "b.blf": (4.0, True)}, id="both"
        ),
        pytest.param(("a.blf", "b.blf"), (None, 4.0), {"b.blf": (4.0, True)}, id="second-only"),
        pytest.param(("a.blf", "b.blf"), (3.0, None), {"a.blf": (3.0, False)}, id="first-only"),
        pytest.param(
            ("a.blf", "a.blf"),
            (3.0, 4.0),
            {"a.blf (1)": (3.0, False), "a.blf (2)": (4.0, True)},
            id="of-one-name",
        ),
    ],
)
def test_each_width_has_the_name_of_its_log(
    names: tuple[str, str], widths: Any, drawn: Any, tmp_path: Path
) -> None:
    """In the same colour, and dashed if it is not of the first log; so for each other panel."""
    panels = panels_of([*map(scenes_of, names, widths)], [20.0])
    position, width, _, age, state = panels
    found = {band.label.split(": ")[0]: (float(band.y[0]), band.dash) for band in width.bands}
    assert found == drawn
    assert len({band.colour for band in width.bands}) == 1
    for panel in (position, age):
        assert [band.dash for band in panel.bands] == [False, True]
        assert len({band.label for band in panel.bands}) == 2
    assert len(set(state.rows)) == 4
    if names[0] == names[1]:
        write_page(panels, "widths", tmp_path / "page.html")
        assert all(f"{name}: at 20 m" in (tmp_path / "page.html").read_text() for name in drawn)


def bare_log(path: Path, known: bool) -> Path:
    """Write a log of a route without a covariance, and if ``known`` of a line that has one."""
    codec = Codec.from_dbc()
    encoder, cov = codec.encoder(), np.diag([0.04, 1e-4, 1e-8, 1e-12])
    route = MapLine.mean_only(Slot.ROUTE, [0.2, 0, 0, 0], x_max=80.0, age=0.02)
    left = MapLine(Slot.EGO_LEFT, Gaussian([1.75, 0, 0, 0], cov), x_max=80.0, age=0.02)
    old = MapLine(Slot.EGO_RIGHT, Gaussian([-1.75, 0, 0, 0], cov), x_max=80.0, age=float("inf"))
    with LogWriter(path, start=100.0) as log:
        for k in range(20):
            for frame in (
                f for one in (route, left, old)[: 1 + 2 * known] for f in encoder.encode(one)
            ):
                log.write(frame, 100 + 0.05 * k)
    return path


@pytest.mark.parametrize(("known", "most"), [(True, 8.0), (False, 2.5)])
def test_a_line_without_a_covariance_has_no_band(
    known: bool, most: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The axis is that of the others; the title says which line it is."""
    recording, _ = recorded(bare_log(tmp_path / "bare.log", known), Codec.from_dbc(), [20.0])

    def check(panel: Panel) -> None:
        assert panel.limits is not None
        assert panel.limits[1] - panel.limits[0] < most
        assert "without a covariance, so without a band: route" in panel.note
        for band in panel.bands:
            assert (
                np.isfinite(band.low).any()
                == np.isfinite(band.high).any()
                == ("left" in band.label)
            )
            assert "route" not in band.label or np.nanmax(band.y) == pytest.approx(0.2, abs=1e-3)

    check(panels_of([recording], [20.0])[0])
    check(above([recording], 0.5))
    monkeypatch.setattr("maplines_can.recordings.plots.log_panels.MOST_POINTS", 4)
    check(panels_of([recording], [20.0])[0])
    for suffix in () if known else (".png", ".html"):
        out = tmp_path / f"plot{suffix}"
        assert main(["plot", str(tmp_path / "bare.log"), "-o", str(out)]) == 0
        assert out.stat().st_size > 10_000


def test_from_above(scene_log: Path) -> None:
    """The newest lines at a time; none at a time without lines."""
    recording, _ = recorded(scene_log, POSE, [20.0])
    table = read_lines(scene_log, dbc=POSE, at=[20.0])
    panel = above([recording], 5.0)
    for band in panel.bands:
        slot = band.label.partition(",")[0].upper().replace(" ", "_")
        own = table.where((table["slot"] == slot) & (table["t"] - recording.begin <= 5.0))
        at20 = np.interp(20.0, band.x, band.y), np.interp(20.0, band.x, band.high[0] - band.y)
        assert at20 == pytest.approx((own["y20"][-1], own["sigma20"][-1]), rel=1e-3)
    assert not above([recording], 1e6).bands


def test_the_command(
    scene_log: Path, faulty_log: Path, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    """A picture, and a page that loads nothing from elsewhere."""
    pytest.importorskip("matplotlib")
    pytest.importorskip("bokeh")
    monkeypatch.setattr("maplines_can.recordings.plots.log_panels.MOST_POINTS", 50)  # quicker
    plot = ["plot", str(scene_log), "--dbc", "auto", "--at", "20,40"]
    picture, page = tmp_path / "drive.png", tmp_path / "drive.html"
    assert main([*plot, "--time", "2..6", "-o", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main([*plot, "-o", str(page)]) == 0
    assert not re.search(r'<(script|link)[^>]*(src|href)="http', page.read_text())
    assert main([*plot, "--above", "5", "-o", str(picture)]) == 1  # it exists
    assert main([*plot, "--above", "5", "-o", str(picture), "--force"]) == 0
    truth = faulty_log.with_name("truth.csv")
    both = ["plot", str(faulty_log), str(faulty_log), "--truth", str(truth)]
    assert main([*both, "-o", str(tmp_path / "both.svg")]) == 0
    capsys.readouterr()
    assert main([*plot, "--above", "-99", "-o", str(tmp_path / "none.png")]) == 1
    assert "no line in the second before" in capsys.readouterr().err
    assert main([*plot, "-o", str(tmp_path / "a.gif")]) == 1


def test_what_cannot_be_drawn_raises(tmp_path: Path, scene_log: Path) -> None:
    path = tmp_path / "plain.log"
    path.write_text("can0  123   [1]  00\n")
    with pytest.raises(LogError, match=r"no record of maplines\.dbc is whole"):
        recorded(path, Codec.from_dbc(), [20.0])
    with pytest.raises(LogError, match="no line in this time"):
        recorded(scene_log, POSE, [20.0], time=(1e6, 2e6))
