"""Whole scenes in one frame: what of the lines goes, how wide, and where the tails come from.

Scenes of the lines around a random pose on a map (the first four slots), or of four lines of a
random road of each shape, are seen from a pose like that of a production car and from a poor one,
with an exact map, errors of its points, and drift, too. They pass the encoder and a decoder of
maplines-scene.dbc.

lines       given to the encoder
left out    share of the lines, and counts of the reasons
wider       share of the lines with a sigma of y that is 5 % larger than computed somewhere
y, width, centre
            sigma, decoded over computed, see maplines_can/study/scenes/sigma_ratios.py
own         the ratios of y by what the line has of its own there, that is, not by the pose error:
            sigma of it [m]
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from typing import Any

import numpy as np

from maplines_can import Codec, Scene
from maplines_can import maps as map_model
from maplines_can.study.scenes.map_scenes import MAPS, POSES, seen
from maplines_can.study.scenes.sigma_ratios import Ratios, places_of
from maplines_can.values.line import lateral_jacobian
from maplines_can.wire import default_dbc_path

from .figures import Share, quantiles
from .harness import evidence, progress
from .roads import SHAPES, Draw, maps_of, on_map, on_roads

#: Ends of classes of the standard deviation of y that a line has of its own [m].
OWN = (0.02, 0.1, 0.3, np.inf)


class Figures:
    """Ratios, and those of y by what lines have of their own."""

    def __init__(self) -> None:
        self.ratios = Ratios()
        self.own: dict[float, list[float]] = {end: [] for end in OWN}

    def add(self, codec: Codec, scene: Scene) -> None:
        """Send a scene, and add what is received."""
        decoded = self.ratios.add_scene(codec, scene)
        if decoded is None:
            return
        true = scene.subset([line.slot for line in decoded.lines])
        if true.specific_covs is None:
            raise ValueError("the scene must know what its lines have of their own")
        for i, (mean, fit_range) in enumerate(zip(decoded.means, decoded.fit_ranges, strict=True)):
            J, block = lateral_jacobian(mean, places_of(*fit_range)[1]), np.s_[4 * i : 4 * i + 4]
            parts = (decoded.cov[block, block], true.cov[block, block], true.specific_covs[i])
            variances, computed, own = (np.einsum("ki,ij,kj->k", J, S, J) for S in parts)
            classes = np.searchsorted(OWN, np.sqrt(own))
            for k, ratio in zip(classes.tolist(), np.sqrt(variances / computed), strict=True):
                self.own[OWN[k]].append(float(ratio))

    @classmethod
    def sum(cls, several: Iterable[Figures]) -> Figures:
        """Return the figures of several."""
        found = cls()
        for one in several:
            found.ratios.add(one.ratios)
            for end, ratios in one.own.items():
                found.own[end] += ratios
        return found

    def shown(self) -> dict[str, Any]:
        """Return the figures by name."""
        found = self.ratios
        return {
            "lines": found.lines,
            "left out": Share(found.left_out_share, found.lines),
            "reasons": dict(found.left_out),
            "wider": Share(found.wider_share, found.lines),
            **{
                f"{what} at {x:g} m": quantiles(values, 0.5, 0.99)
                for (what, x), values in sorted(found.ratios.items())
            },
            "own": {
                f"up to {end:g} m": {"places": len(values), **quantiles(values, 0.5, 0.99)}
                for end, values in self.own.items()
            },
        }


@evidence(n=6, shapes=("motorway", "rural", "city"))
def whole_scenes(
    n: int = 300,
    maps: tuple[str, ...] = (),
    shapes: tuple[str, ...] = tuple(SHAPES),
    seed: int = 1,
) -> dict[str, Any]:
    """Send n scenes of each map and each shape of random roads, in turn with each kind of errors.

    Args:
        n: number of scenes.
        maps: folders and files of maps; the town of the package without one.
        shapes: of the random roads.
        seed: of the scenes.
    """
    codec = Codec.from_dbc(default_dbc_path("maplines-scene.dbc"))
    found = maps_of(maps or (str(map_model.town_path()),))
    sources: dict[str, Draw] = {f"map {name}": on_map(one) for name, one in found.items()}
    sources |= {f"road {shape}": on_roads((shape,), lines=4) for shape in shapes}
    kinds = list(product(POSES, MAPS))
    every = {key: Figures() for key in product(sources, kinds)}
    for name, draw in progress(sources.items(), "sources", len(sources)):
        for number in range(n):
            rng = np.random.default_rng([seed, number])
            kind = kinds[number % len(kinds)]
            every[name, kind].add(codec, seen(*draw(number, rng), *kind, rng))

    def of(name: str) -> dict[str, Any]:
        """Return the figures of a source, of all maps or roads, or of an error."""
        chosen = (
            one
            for (source, kind), one in every.items()
            if name in (source, source.split()[0], *kind)
        )
        return Figures.sum(chosen).shown()

    return {
        "all maps": of("map"),
        "all roads": of("road"),
        "of": {name: of(name) for name in (*sources, *POSES, *MAPS)},
    }
