"""Figures of matplotlib, and what several pictures draw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..values.errors import missing_extra
from ..values.gaussian import Gaussian
from ..values.output_files import whole_file

Array = NDArray[np.float64]

#: Okabe and Ito's colours, which colour-blind readers can distinguish.
COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7"),
    *("#56B4E9", "#E69F00", "#444444", "#8A7500"),
)
#: Half the width of an interval that holds 99 % of a Gaussian, in standard deviations.
Z99 = 2.5758
#: Radius of the ellipse that holds 99 % of a Gaussian in the plane, in standard deviations.
RADIUS99 = float(np.sqrt(-2 * np.log(0.01)))


def new_figure(width: float, height: float) -> Any:
    """Return an empty ``matplotlib.figure.Figure`` of a size [inch].

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("a picture needs matplotlib", "plot") from error
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Any, path: str | Path, dpi: int, **options: Any) -> None:
    """Write a figure as a whole or not at all; the suffix of the path is the format."""
    with whole_file(path) as part:
        figure.savefig(part, dpi=dpi, format=Path(path).suffix[1:], **options)


def ellipse(gaussian: Gaussian) -> Array:
    """Return (2, 120) points of the ellipse that holds 99 % of a Gaussian in the plane."""
    t = np.linspace(0, 2 * np.pi, 120)
    circle = RADIUS99 * np.array([np.cos(t), np.sin(t)])
    return np.asarray(gaussian.mean[:, None] + gaussian.root @ circle)
