"""Calls that a car makes in each cycle, as a sender and as a receiver, with scenes of eight lines.

``bench_threads.py`` measures them, and a test watches the threads of BLAS while they run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from itertools import chain, count
from typing import Any

import numpy as np

from maplines_can import (
    Codec,
    Gaussian,
    Linear,
    MapError,
    MapLine,
    Mixture,
    Motion,
    Polyline,
    Quadrature,
    Refit,
    Scene,
    Slot,
    map_lines,
    map_scene,
    maps,
    predict_to,
    scene_mixture,
)
from maplines_can.consumers import LaneFusion, scene_view
from maplines_can.consumers.integrity import protection_level
from maplines_can.consumers.plausibility import PlausibilityCheck
from maplines_can.consumers.steering import LaneSteering
from maplines_can.localisation import (
    CameraLines,
    GnssFix,
    Localisation,
    LocalisationLayer,
    Odometry,
    PoseFix,
    SeenLandmarks,
)
from maplines_can.localisation.scan_matching import (
    ScanReference,
    match_icp,
    match_ndt,
    simulated_scan,
)
from maplines_can.maps.line_source import LineSource
from maplines_can.propagation.nonlinearity import nonlinearity
from maplines_can.simulation import PoseSource
from maplines_can.simulation.scenarios import parallel, scenario
from maplines_can.wire import default_dbc_path

Call = Callable[[], Any]

#: Lateral offsets of the lines of a car with all lines, one for each slot [m].
OFFSETS = (3.5, 0.0, 7.0, -3.5, 1.75, 10.5, -7.0, -1.75)
#: Window of the lines [m].
WINDOW = (-20.0, 80.0)
#: DBCs whose records of lines are conditional on the pose error, and complete.
CONDITIONAL, COMPLETE = "maplines-pose.dbc", "maplines.dbc"
PERIOD_NS, FRAME_NS = 50_000_000, 250_000
#: Standard deviations of the pose: along, across [m], heading [rad].
SIGMA = (0.1, 0.2, math.radians(0.2))
EGO_COV = np.diag(np.square(SIGMA))
MAP_ERROR = MapError(point_sigma=0.05, offset_sigma=0.05, heading_sigma=0.001)


def highway_lines() -> list[Polyline]:
    """Return eight parallel lines, longer than the window at both ends."""
    inner = scenario("highway").lines[Slot.EGO_RIGHT].points
    beyond = np.arange(1, 6)[:, None]
    before = inner[0] + (inner[0] - inner[1]) * beyond[::-1]
    after = inner[-1] + (inner[-1] - inner[-2]) * beyond
    points = np.concatenate([before, inner, after])
    return [Polyline(parallel(points, offset)) for offset in OFFSETS]


def city_lines() -> list[Polyline]:
    """Return eight parallel lines that turn left 20 m ahead, with radii of 1.5 to 19 m."""
    angle = np.linspace(0, np.pi / 2, 14)[1:]
    ahead, arc = np.arange(-60, 20.5), np.array([np.sin(angle), 1 - np.cos(angle)]).T
    lines = []
    for offset in OFFSETS:
        radius = 12.0 - offset
        straight = np.column_stack([ahead, np.full(len(ahead), offset)])
        turn = [20.0, offset] + radius * arc
        left = turn[-1] + np.column_stack([np.zeros(60), np.arange(1, 61)])
        lines.append(Polyline(np.concatenate([straight, turn, left])))
    return lines


ROADS = {"highway": highway_lines, "city": city_lines}
ERRORS = {"": None, ", map error": MAP_ERROR}


def calls() -> dict[str, Call]:
    """Return the calls by name. Each may be made any number of times."""
    parts = (_lines_of_maps, _cycle_of_a_drive, _messages, _consumers, _localisation, _scans)
    return {name: call for part in parts for name, call in part()}


def _lines_of_maps() -> Iterator[tuple[str, Call]]:
    """Yield what makes Gaussians of the lines of a map."""
    for road, lines in ROADS.items():
        slots = dict(zip(Slot, lines(), strict=True))
        for text, error in ERRORS.items():
            for function in (map_lines, map_scene):
                call = partial(function, slots, map_error=error)
                yield f"{function.__name__}, {road}{text}", partial(_from_ego, call)
    city = city_lines()
    mixtures = partial(map_lines, dict(zip(Slot, city, strict=True)), components=3)
    yield "map_lines, mixtures", partial(_from_ego, mixtures)
    refit = Refit(city, np.zeros(3), WINDOW)
    for transform in (Linear(), Quadrature(5), Mixture(3)):
        name = f"moments, {type(transform).__name__}"
        yield name, partial(_from_ego, partial(transform.moments, refit))
    yield "nonlinearity", partial(_from_ego, partial(nonlinearity, refit))


def _from_ego(call: Callable[[Gaussian], Any]) -> Any:
    """Make a call with a new Gaussian over the pose, which has nothing cached."""
    return call(Gaussian(np.zeros(3), EGO_COV))


def _cycle_of_a_drive() -> Iterator[tuple[str, Call]]:
    """Yield the lines around a car that drives to and fro on the tour through the town."""
    town = maps.load(maps.town_path())
    route = maps.town_tour(town)
    start, ahead, end = route.line.points[[10, 11, 60]]
    heading = math.atan2(*(ahead - start)[::-1])
    source = LineSource(
        town, PoseSource(SIGMA).pose, tuple(Slot), route, map_error=MAP_ERROR, correlation_time=4.0
    )
    cycles = count(1)

    def cycle() -> Any:
        t = 0.05 * next(cycles)
        return source.cycle(t, np.array([*(start + t % 5.0 / 5.0 * (end - start)), heading]))

    yield "LineSource.cycle", cycle


def _scene(lines: list[Polyline], error: MapError | None = MAP_ERROR) -> Scene:
    ego = Gaussian(np.zeros(3), EGO_COV)
    return map_scene(
        dict(zip(Slot, lines, strict=True)), ego, correlation_time=4.0, map_error=error
    )


def _messages() -> Iterator[tuple[str, Call]]:
    """Yield encoding and decoding of lines, mixtures and scenes."""
    ego, codec = Gaussian(np.zeros(3), EGO_COV), Codec.from_dbc(default_dbc_path(COMPLETE))
    for name, lines, components in (("lines", highway_lines(), 1), ("mixtures", city_lines(), 3)):
        found = map_lines(dict(zip(Slot, lines, strict=True)), ego, components=components)
        yield from _round_trip(name, codec, partial(codec.encoder().encode_lines, found))
    for dbc in (CONDITIONAL, COMPLETE):
        codec = Codec.from_dbc(default_dbc_path(dbc))
        for road, of_road in ROADS.items():
            for text, error in ERRORS.items():
                scene = _scene(of_road(), error)
                name = f"scene of {dbc}, {road}{text}"
                yield from _round_trip(name, codec, partial(codec.encoder().encode_scene, scene))


def _round_trip(name: str, codec: Codec, encode: Call) -> Iterator[tuple[str, Call]]:
    """Yield the call that encodes, and that which decodes the frames of four calls in turn."""
    yield f"encode, {name}", encode
    decoder, rounds, counters = codec.decoder(), [_flat(encode()) for _ in "1234"], count()

    def decode() -> Any:
        i = next(counters)
        t_ns = i * 10**9  # late enough for any counter
        for frame in rounds[i % len(rounds)]:
            decoder.feed(frame.can_id, frame.data, t_ns)
            t_ns += FRAME_NS
        return decoder.latest_scene(t_ns)

    yield f"decode, {name}", decode


def _flat(frames: Any) -> list[Any]:
    """Return the frames of the owners of a scene, or of lines, as one list."""
    return [*chain.from_iterable(frames.values() if isinstance(frames, dict) else frames)]


class _Reception:
    """Reception of the same scene in each cycle, from when it is usable on."""

    def __init__(self, lines: list[Polyline]) -> None:
        self._codec = Codec.from_dbc(default_dbc_path(CONDITIONAL))
        self._encoder = self._codec.encoder()
        self._prepared = self._encoder.prepare_scene(_scene(lines))
        self.decoder, self.t_ns = self._codec.decoder(), 0
        while not self.decoder.latest_scene(self.t_ns).usable:
            self.receive()

    def receive(self) -> None:
        """Receive the scene of the next cycle."""
        self.t_ns += PERIOD_NS - self.t_ns % PERIOD_NS
        for frame in _flat(self._encoder.encode_scene(self._prepared)):
            self.decoder.feed(frame.can_id, frame.data, self.t_ns)
            self.t_ns += FRAME_NS

    @property
    def scene(self) -> Scene:
        """The last one."""
        scene = self.decoder.latest_scene(self.t_ns).scene
        if scene is None or len(scene.lines) < len(Slot):
            raise RuntimeError(f"not all lines have been received, but {scene}")
        return scene


def _consumers() -> Iterator[tuple[str, Call]]:
    """Yield what a receiver does with its lines."""
    reception = _Reception(highway_lines())
    scene, motion = reception.scene, Motion.with_sigma(20.0, 0.01, (0.2, 0.01))
    line = scene.line(Slot.EGO_LEFT)
    later_ns = reception.t_ns + 60_000_000
    yield "predict_to", lambda: predict_to(line, later_ns, motion)
    yield "scene_mixture", lambda: scene_mixture(scene, Slot.EGO_LEFT)
    gaussian, seen = line.gaussian, Gaussian(line.gaussian.mean + 1e-4, 2 * line.gaussian.cov)
    yield "Gaussian.kl and mahalanobis", lambda: (gaussian.kl(seen), seen.mahalanobis(np.zeros(4)))
    x = np.linspace(0.0, 60.0, 61)
    yield "Scene.centre and width", lambda: (scene.centre(x).sigma, scene.width(x).sigma)
    sigma, times = scene.centre(x).sigma, count()
    # The multiplier of a correlation time is kept, so each call takes another time.
    yield "protection_level", lambda: protection_level(sigma, 1e-5, 4.0 + 1e-6 * next(times))
    camera = {
        one.slot: MapLine.with_sigma(one.slot, one.gaussian.mean, [0.05, 0.005, 5e-4, 2e-5])
        for one in scene.lines
    }
    lane = [camera[Slot.EGO_LEFT], camera[Slot.EGO_RIGHT]]
    fusion, decoder = LaneFusion(), reception.decoder

    def fuse() -> Any:
        reception.receive()
        t_ns = reception.t_ns
        return fusion.step(t_ns, decoder.latest_scene(t_ns), motion, lane)

    yield "reception and LaneFusion.step", fuse
    check, images, view = PlausibilityCheck(), count(1), scene_view(scene, 0.02)
    yield (
        "PlausibilityCheck.step",
        lambda: check.step(50_000_000 * next(images), view, motion, camera.values()),
    )
    steering, periods = LaneSteering(set_speed=20.0), count(1)

    def steer() -> Any:
        i = next(periods)
        moving = Motion.with_sigma(10.0 + 0.5 * (i % 40), 0.0, (0.2, 0.01))  # new gains
        return steering.step(50_000_000 * i, view, moving)

    yield "LaneSteering.step", steer


def _localisation() -> Iterator[tuple[str, Call]]:
    """Yield the steps of the localisation of a car that stands, with each measurement."""
    town = maps.load(maps.town_path())
    layer, route = LocalisationLayer(town), maps.town_tour(town)
    start, ahead = route.line.points[[10, 11]]
    pose = np.array([[*start, math.atan2(*(ahead - start)[::-1])]])
    localisation = Localisation(Gaussian(pose[0], EGO_COV), layer=layer)
    steps, beside = count(1), layer.lines_beside(pose)
    offset, heading = (np.resize(one, (1, 4)) + 0.0 for one in (beside.offset, beside.heading))
    kind = np.resize(beside.kind, (1, 4)).astype(np.intp)
    landmarks = np.resize(layer.positions - start, (1, 8, 2)) + 0.0

    def drive() -> float:
        localisation.add(Odometry(0.02 * next(steps), np.zeros(1), np.zeros(1)))
        return localisation.t - 0.05

    observations: dict[str, Callable[[float], Any]] = {
        "GNSS": lambda t: GnssFix(t, pose[:, :2], np.eye(2)),
        "camera": lambda t: CameraLines(t, offset, heading, kind, np.diag([2.5e-3, 2.5e-5])),
        "landmarks": lambda t: SeenLandmarks(t, landmarks, 0.04 * np.eye(2)),
        "scan": lambda t: PoseFix(t, pose, 0.01 * np.eye(3), EGO_COV),
    }

    def observe(observation: Callable[[float], Any]) -> Any:
        localisation.add(observation(drive()))
        return localisation.pose_error()

    yield "Localisation, odometry", drive
    for name, observation in observations.items():
        yield f"Localisation, {name}", partial(observe, observation)


def _scans() -> Iterator[tuple[str, Call]]:
    """Yield the matching of a scan with a street of houses."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) / 2 * [12.0, 8.0]
    places = [np.array([x, y]) for x in range(-40, 61, 20) for y in (-12, 13)]
    houses = tuple(Polyline(place + corners) for place in places)
    reference, pose = ScanReference(maps.Map({}, {}, buildings=houses)), np.array([3.0, 1.0, 0.2])
    scan = simulated_scan(reference, pose, np.random.default_rng(1))
    start = pose + np.array([0.2, -0.1, 0.01])
    yield "match_ndt", lambda: match_ndt(reference, scan, start)
    if find_spec("small_gicp") is not None:
        yield "match_icp", lambda: match_icp(reference, scan, start)
