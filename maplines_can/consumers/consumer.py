"""What all consumers of received scenes have in common: one step, and its inputs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Protocol, TypeVar

from ..propagation.motion import Motion
from ..propagation.prediction import pose_time_ns
from ..values.line import MapLine
from ..values.scene import Scene
from ..wire import E2EState, SceneView

Result = TypeVar("Result", covariant=True)


class Consumer(Protocol[Result]):
    """Consumer of received scenes, in the cycle of a controller.

    It has neither a thread nor a clock of its own.
    """

    def step(
        self,
        now_ns: int,
        view: SceneView | None,
        motion: Motion,
        camera: Iterable[MapLine] = (),
    ) -> Result:
        """Take what is known now, and return the result.

        Args:
            now_ns: time, later than that of the last step; ``LaneFusion`` takes the same, too [ns].
            view: newest scene of a ``Receiver``, ``LineListener`` or ``Decoder``, or of
                ``scene_view``; one that is not usable is not used. None: there is no receiver.
            motion: of the car since the last step.
            camera: lines that a camera has seen, in the ego frame of their time: that of
                ``now_ns`` less their age, or, if they have a time ``t_ns``, that less their age.

        Raises:
            ValueError: the time is not later than that of the last step.
        """


def scene_view(scene: Scene | None, age: float = 0.0) -> SceneView:
    """Return the view of a scene that was not received, such as a fused lane, as a usable one.

    Args:
        scene: the scene; None for a view that is not usable.
        age: time since the pose of the scene [s].
    """
    return SceneView(scene, age, scene is None, E2EState.VALID, None)


def age_of(line: MapLine, now_ns: int) -> float:
    """Return the age of a camera line at a time [s]; see ``Consumer.step``."""
    return line.age if line.t_ns is None else (now_ns - pose_time_ns(line)) / 1e9


class StepTimes:
    """Times of the steps of a consumer, which increase."""

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._last_ns: float = -math.inf

    def next(self, now_ns: int) -> float:
        """Return the time of the next step since the first one [s].

        Raises:
            ValueError: it is not later than that of the last step.
        """
        if not self._last_ns < now_ns < math.inf:
            raise ValueError(
                f"now_ns must be finite and later than {self._last_ns:.0f} ns, got {now_ns!r}"
            )
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        self._last_ns = now_ns
        return (now_ns - self._first_ns) / 1e9
