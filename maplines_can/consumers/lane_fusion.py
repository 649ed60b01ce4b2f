"""Fusion of received scenes with camera lines into the ego lane."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation import Motion
from ..values.gaussian import Gaussian
from ..values.linalg import block_diagonal, square_root
from ..values.line import MapLine, Slot
from ..values.scene import PoseError, Scene
from ..wire import SceneView
from .consumer import age_of, scene_view
from .lane_filter import BIAS_SIGMA, BIAS_TIME, Handling, LaneFilter, N, move_lines

Array = NDArray[np.float64]

#: Lines of the ego lane.
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Longest time between two steps, and greatest age of a measurement [s].
MAX_GAP, MAX_AGE = 2.0, 0.5
#: Standard deviation of the age of a measurement, which the message states in steps of 8 ms [s].
AGE_SIGMA = 0.004


class FusedLane(NamedTuple):
    """The ego lane at one time."""

    t_ns: int  #: time of the lane and of its ego frame [ns]
    #: both lines with their joint covariance, and what remains of the pose error; None if unknown
    scene: Scene | None
    pose_error: Gaussian | None  #: estimate of the pose error: along [m], across [m], heading [rad]
    map_age: float  #: time since the pose of the newest scene that was used [s]; infinite before
    used: tuple[Slot, ...]  #: camera lines that were used
    rejected: tuple[Slot, ...]  #: camera lines beyond the gate

    @property
    def view(self) -> SceneView:
        """The lane as a view for other consumers, such as ``LaneSteering``."""
        return scene_view(self.scene)


class LaneFusion:
    """Filter over the ego lane, from received scenes, camera lines and the motion of the car.

    The error of the pose is common to the lines of a scene *and* to scenes that are closer in time
    than its correlation time. It is a state of the filter (see ``LaneFilter``), so 20 scenes in a
    second are not taken for 20 independent measurements, and what a camera says of the pose error
    improves the map lines for as long as that error lasts. Scenes alone do not estimate it, but
    consider it (Schmidt filter): they would have to trust in a model of how it changes. If the
    sender does not know the correlation time (``inf``), it is considered at camera lines, too.

    A camera line is the line plus a bias that lasts, plus noise with the covariance of the line. A
    line beyond the gate, such as a crack of the road, is not used. A scene is always used: where it
    does not fit, the road or the lane has changed. The lane begins with the first scene.

    Args:
        handling: of the pose error at camera lines: ``"state"`` to estimate it, ``"consider"``, or
            None to choose by the correlation time.
        error_frame: frame in which the pose error lasts while the car turns: ``"map"`` for
            satellites, ``"ego"`` for sensors of the car.
        bias_sigma: standard deviations of the biases of the camera (offset [m], heading [rad],
            curvature [1/m]) and of the yaw rate [rad/s].
        bias_time: their correlation time [s].

    >>> import maplines_can as ml
    >>> fusion = LaneFusion()
    >>> seen = [ml.MapLine.with_sigma(slot, [y, 0, 0, 0], [0.05, 0.005, 5e-4, 2e-5], x_max=50)
    ...         for slot, y in ((Slot.EGO_LEFT, 1.7), (Slot.EGO_RIGHT, -1.8))]
    >>> for k in range(100):
    ...     lane = fusion.step(50_000_000 * k, None, ml.Motion(20.0, 0.0), seen)
    >>> lane.scene.width(0.0).value.round(3), lane.scene.centre(0.0).value.round(3)
    (np.float64(3.5), np.float64(-0.05))
    >>> bool(0.04 < lane.scene.centre(0.0).sigma < 0.06)  # the bias of the camera remains
    True
    """

    def __init__(
        self,
        *,
        handling: Handling | None = None,
        error_frame: Literal["map", "ego"] = "ego",
        bias_sigma: tuple[float, float, float, float] = BIAS_SIGMA,
        bias_time: float = BIAS_TIME,
    ) -> None:
        if error_frame not in ("map", "ego"):
            raise ValueError(f'error_frame must be "map" or "ego", got {error_frame!r}')
        if handling not in ("state", "consider", None):
            raise ValueError(f'handling must be "state", "consider" or None, got {handling!r}')
        sigmas = np.asarray(bias_sigma, dtype=float)
        if sigmas.shape != (4,) or not ((sigmas >= 0) & (sigmas < np.inf)).all():
            raise ValueError(
                "bias_sigma must be 4 numbers of 0 or more [m, rad, 1/m, rad/s], "
                f"got {bias_sigma!r}"
            )
        if not bias_time > 0:
            raise ValueError(f"bias_time must be more than 0 s, got {bias_time!r}")
        self._handling, self._frame = handling, error_frame
        self._biases = (*sigmas.tolist(),), bias_time
        self._t_ns: int | None = None
        self._restart()

    def _restart(self) -> None:
        self._filter = LaneFilter(bias_sigma=self._biases[0], bias_time=self._biases[1])
        self._fit: Array | None = None  # (2, 2) ranges of the cubics
        self._valid = np.zeros((2, 2))  # ranges in which the lines are valid
        self._pose_error: PoseError | None = None  # of the newest scene
        self._root = np.zeros((3, 3))
        self._turned = 0.0  # by the car since then [rad]
        self._done: tuple[tuple[int, int], frozenset[Slot]] | None = None  # scene and its lines
        self._map_ns: int | None = None

    def step(
        self,
        now_ns: int,
        view: SceneView | None,
        motion: Motion,
        camera: Iterable[MapLine] = (),
    ) -> FusedLane:
        """Advance the lane to a time, and fuse what is new; see ``Consumer.step``.

        Args:
            now_ns: time, not before that of the last step [ns].
            view: newest scene, as received; None for camera lines only.
            motion: of the car since the last step.
            camera: lines of the ego lane.

        Raises:
            ValueError: the time is before that of the last step, or a camera line is of a slot
                other than EGO_LEFT and EGO_RIGHT.
        """
        camera = [*camera]
        for line in camera:
            if line.slot not in LANE:
                raise ValueError(
                    f"camera lines must be of EGO_LEFT or EGO_RIGHT, got {line.slot.name}"
                )
        self._advance(now_ns, motion)
        if view is not None:
            self._fuse_scene(view, now_ns, motion)
        # The first camera line may be a false one, and no gate would find it.
        usable = camera if view is None or self._map_ns is not None else []
        outcomes = [(line.slot, self._fuse_camera(line, now_ns, motion)) for line in usable]
        return FusedLane(
            now_ns,
            self._scene(now_ns),
            self._estimate(),
            math.inf if self._map_ns is None else (now_ns - self._map_ns) / 1e9,
            tuple(slot for slot, is_used in outcomes if is_used),
            tuple(slot for slot, is_used in outcomes if is_used is False),
        )

    def _advance(self, now_ns: int, motion: Motion) -> None:
        last_ns, self._t_ns = self._t_ns, now_ns
        if last_ns is None or now_ns == last_ns:
            return
        if now_ns < last_ns:
            self._t_ns = last_ns
            raise ValueError(f"now_ns must be {last_ns} or later, got {now_ns}")
        dt = (now_ns - last_ns) / 1e9
        if dt > MAX_GAP:
            self._restart()
        if self._fit is None:
            return
        moved = motion.over(dt)
        time = math.inf if self._pose_error is None else self._pose_error.correlation_time
        self._filter.predict(moved.mean, moved.cov, dt, self._fit, time)
        self._fit = self._fit - moved.mean[0]
        self._valid = self._valid - moved.mean[0]
        self._turned += float(moved.mean[2])
        if not np.isfinite(self._filter.mean).all():  # a line is across the car's x axis
            self._restart()

    def _fuse_scene(self, view: SceneView, now_ns: int, motion: Motion) -> None:
        if not view.usable or view.scene is None or view.received is None or view.age > MAX_AGE:
            return
        scene, key = view.scene, (view.received.t_ns, view.received.counter)
        before = self._done[1] if self._done is not None and self._done[0] == key else frozenset()
        slots = [
            slot
            for slot in LANE
            if slot in scene.index and slot not in before and scene.line(slot).is_usable
        ]
        if not slots:
            return
        if not before:
            self._set_pose_error(scene.pose_error)
        self._done = key, before | frozenset(slots)
        self._map_ns = now_ns - round(1e9 * view.age)
        scene = scene.subset(slots)
        J, own = scene.conditional()
        moved = motion.over(view.age, AGE_SIGMA)
        lines, F, G = move_lines(scene.means, moved.mean, scene.fit_ranges)
        if np.isnan(lines).any():
            return
        F, G = block_diagonal(F), G.reshape(-1, 3)
        rows = np.concatenate([np.arange(4) + 4 * LANE.index(slot) for slot in slots])
        z, loading, cov = np.zeros(N), np.zeros((N, 3)), np.zeros((N, N))
        z[rows], loading[rows] = lines.ravel(), F @ J @ self._root
        cov[np.ix_(rows, rows)] = F @ own @ F.T + G @ moved.cov @ G.T
        used = np.isin(np.arange(N), rows)
        for slot, fit in zip(slots, scene.fit_ranges, strict=True):
            line = scene.line(slot)
            self._set_range(
                slot, fit - moved.mean[0], np.array([line.x_min, line.x_max]) - moved.mean[0]
            )
        self._filter.update_map(z, loading, cov, None, used)

    def _fuse_camera(self, line: MapLine, now_ns: int, motion: Motion) -> bool | None:
        """Return whether a camera line was used; None if it is too old."""
        if not line.is_usable:
            return None
        age = age_of(line, now_ns)
        if not 0 <= age <= MAX_AGE:
            return None
        i, fit = LANE.index(line.slot), np.array([[line.x_min, max(line.x_max, line.x_min + 1)]])
        moved = motion.over(age)
        mean, F, G = move_lines(line.gaussian.mean[None], moved.mean, fit)
        if np.isnan(mean).any():
            return None
        lines, cov = np.zeros((2, 4)), np.zeros((2, 4, 4))
        lines[i] = mean[0]
        cov[i] = F[0] @ line.gaussian.cov @ F[0].T + G[0] @ moved.cov @ G[0].T
        fit = fit[0] - moved.mean[0]
        if self._map_ns is None:
            self._set_range(line.slot, fit, fit)
        return bool(self._filter.update_camera(lines, cov, np.arange(2) == i)[i])

    def _set_range(self, slot: Slot, fit: Array, valid: Array) -> None:
        """Set the ranges of a line, and of the other one if it has none."""
        if self._fit is None:
            self._fit, self._valid = np.tile(fit, (2, 1)), np.tile(valid, (2, 1))
        self._fit, self._valid = self._fit.copy(), self._valid.copy()
        self._fit[LANE.index(slot)], self._valid[LANE.index(slot)] = fit, valid

    def _set_pose_error(self, pose_error: PoseError) -> None:
        """Take the pose error of a new scene: turn its estimate, and choose how to handle it."""
        root = square_root(pose_error.cov)
        if self._pose_error is not None:
            c, s = math.cos(self._turned), math.sin(self._turned)
            R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            U, _, Vt = np.linalg.svd(
                np.linalg.pinv(root) @ (R if self._frame == "map" else np.eye(3)) @ self._root
            )
            self._filter.turn_errors(U @ Vt)
        self._pose_error, self._root, self._turned = pose_error, root, 0.0
        is_known = math.isfinite(pose_error.correlation_time)
        self._filter.handle(self._handling or ("state" if is_known else "consider"))

    def _estimate(self) -> Gaussian | None:
        if self._pose_error is None:
            return None
        u, cov = self._filter.mean[self._filter.u], self._filter.cov[self._filter.u, self._filter.u]
        P = self._root @ cov @ self._root.T
        return Gaussian(self._root @ u, (P + P.T) / 2)

    def _scene(self, now_ns: int) -> Scene | None:
        """Return the lane as a scene; None if it is unknown or the car has left its range."""
        low, high = self._valid[:, 0], self._valid[:, 1]
        if self._fit is None or not (low < high).all() or not (high > 0).all():
            return None
        cov = self._filter.cov[:N, :N]
        means = self._filter.mean[:N].reshape(2, 4)
        lines = tuple(
            MapLine(slot, Gaussian(means[i], cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]),
                    x_min=low[i], x_max=high[i], t_ns=now_ns)
            for i, slot in enumerate(LANE)
        )  # fmt: skip
        time = math.inf if self._pose_error is None else self._pose_error.correlation_time
        rest = self._estimate()
        pose_error = PoseError(np.zeros((3, 3)) if rest is None else rest.cov, time)
        return Scene(lines, cov, pose_error, self._fit)
