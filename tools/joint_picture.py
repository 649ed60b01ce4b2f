#!/usr/bin/env python3
"""Draw the picture of docs/joint.md: lane centre and width, with the joint and without it.

    joint_picture.py docs/joint.png

Run it in the environment of the project: python3 tools/run.py python tools/joint_picture.py
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from reporting import parser_of

from maplines_can import Codec, Decoder, MapError, Scene, Slot, map_scene, scenario
from maplines_can.study.figures.panels import Z99
from maplines_can.study.figures.picture import COLOURS
from maplines_can.wire import default_dbc_path

LEFT, RIGHT = Slot.EGO_LEFT, Slot.EGO_RIGHT
MAP_ERROR = MapError(point_sigma=0.05, offset_sigma=0.05, heading_sigma=0.001)
X = np.linspace(0, 60, 121)
TITLE: dict[str, Any] = {"loc": "left", "fontsize": 10}


def received_scene() -> Scene:
    """Return the scene of the production car as received."""
    shipped = scenario("production")
    lines = {slot: shipped.lines[slot] for slot in (LEFT, RIGHT)}
    scene = map_scene(lines, shipped.ego, window=shipped.window, map_error=MAP_ERROR)
    codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
    decoder: Decoder = codec.decoder()
    frames = [frame for own in codec.encode_scene(scene).values() for frame in own]
    for i, frame in enumerate(frames):
        decoder.feed(frame.can_id, frame.data, 250_000 * i)
    received = decoder.scene()
    if received is None:
        raise RuntimeError("the scene was not received")
    return received.scene


def sigma_if_independent(scene: Scene, weights: dict[Slot, float]) -> Any:
    """Return the standard deviation of a weighted sum of lines that are taken as independent."""
    parts = [weight * scene.lateral({slot: 1.0}, X).sigma for slot, weight in weights.items()]
    return np.hypot(*parts)


def draw(scene: Scene, path: Path) -> None:
    """Draw the bands of the lines and of the centre, and the standard deviation of the width."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    bands, sigmas = figure.subplots(1, 2, width_ratios=[1.25, 1])
    for slot, colour in ((LEFT, COLOURS[0]), (RIGHT, COLOURS[1])):
        line = scene.lateral({slot: 1.0}, X)
        bands.plot(X, line.value, color=colour, lw=1.6)
        name = slot.name.replace("_", " ").lower()
        band(bands, line.value, line.sigma, color=colour, label=f"{name}, 99 %")
    centre = scene.centre(X)
    band(bands, centre.value, centre.sigma, color="0.45", label="lane centre, joint")
    apart = Z99 * sigma_if_independent(scene, {LEFT: 0.5, RIGHT: 0.5})
    for side in (-apart, apart):
        bands.plot(X, centre.value + side, color="black", ls=":", lw=1.3)
    bands.plot(
        [], [], color="black", ls=":", lw=1.3, label="lane centre, if independent: too narrow"
    )
    bands.set(xlabel="x, ahead of the car [m]", ylabel="y, to the left [m]")
    bands.set_title("The lines share one error: the centre is as uncertain as they are", **TITLE)
    bands.set_ylim(-3.5, 7.5)
    bands.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)
    for name, weights, of, colour in (
        ("width", {LEFT: 1.0, RIGHT: -1.0}, scene.width(X), COLOURS[2]),
        ("centre", {LEFT: 0.5, RIGHT: 0.5}, centre, "0.45"),
    ):
        sigmas.plot(X, of.sigma, color=colour, lw=2, label=f"{name}, joint")
        alone = sigma_if_independent(scene, weights)
        sigmas.plot(X, alone, color=colour, ls=":", lw=1.6, label=f"{name}, if independent")
    sigmas.set(xlabel="x, ahead of the car [m]", ylabel="standard deviation [m]", ylim=(0, None))
    sigmas.set_title("Width and centre of the lane", **TITLE)
    sigmas.legend(frameon=False, fontsize=8)
    for axes in (bands, sigmas):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def band(axes: Any, value: Any, sigma: Any, **style: Any) -> None:
    """Draw the 99 % band of a quantity over x."""
    axes.fill_between(X, value - Z99 * sigma, value + Z99 * sigma, alpha=0.3, lw=0, **style)


def main() -> int:
    """Run the command and return its exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("path", type=Path, help="file of the picture; its suffix is the format")
    draw(received_scene(), parser.parse_args().path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
