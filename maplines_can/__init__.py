"""Lines of a digital map on a CAN bus, with their uncertainty.

>>> import numpy as np, maplines_can as ml
>>> points = [[x, 1.75 + x**2 / 4000] for x in range(-30, 100, 2)]
>>> road = ml.Polyline(points, ml.Kind.DASHED)
>>> ego = ml.Gaussian([0, 0, 0], np.diag([0.3, 0.1, 0.01]) ** 2)
>>> (line,) = ml.map_lines({ml.Slot.EGO_LEFT: road}, ego)
>>> line.gaussian.mean.round(3)[0]  # Gaussian over (y_off, beta, c0, c1)
np.float64(1.75)
>>> frames = ml.Codec.from_dbc().encode(line)  # 4 frames of classic CAN
>>> decoder = ml.Codec.from_dbc().decoder()
>>> *_, received = [decoder.feed(frame.can_id, frame.data, t_ns=0) for frame in frames]
>>> received.slot.name, bool(abs(received.y(80.0) - line.y(80.0)) < 0.005)
('EGO_LEFT', True)

A name is imported from its module when it is first used, so that a program
loads only what it needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import maps
    from .bus import (
        LineListener,
        Link,
        Receiver,
        Transmitter,
        key_from_env,
        key_from_file,
        read_log,
        read_signals,
    )
    from .propagation import (
        Linear,
        MapError,
        Mixture,
        MonteCarlo,
        Motion,
        Quadrature,
        Refit,
        SigmaPoints,
        Transform,
        map_lines,
        map_scene,
        pose_time_ns,
        predict,
        predict_to,
        scene_mixture,
    )
    from .simulation.pose_source import PoseSource
    from .simulation.recorded import RecordedDrive
    from .simulation.scenarios import SCENARIOS, STREETS, Scenario, scenario
    from .simulation.trajectory import SimulatedDrive
    from .values.errors import (
        DriveFileError,
        EncodeError,
        IllPosedError,
        LayoutError,
        MapFileError,
        MaplinesError,
    )
    from .values.gaussian import Gaussian, nearest_covariance
    from .values.line import (
        Kind,
        LeftOut,
        MapLine,
        MapLineList,
        Slot,
        Status,
        lateral,
        lateral_jacobian,
        transform_line,
    )
    from .values.mixture import GaussianMixture
    from .values.polyline import Polyline
    from .values.scene import Estimate, PoseError, Scene
    from .wire import (
        Authenticator,
        Batch,
        Codec,
        Decoder,
        E2EConfig,
        E2EState,
        Frame,
        Key,
        Monitor,
        ProfileStatus,
        Reason,
        SceneView,
        SlotView,
    )

__all__ = [
    "SCENARIOS",
    "STREETS",
    "Authenticator",
    "Batch",
    "Codec",
    "Decoder",
    "DriveFileError",
    "E2EConfig",
    "E2EState",
    "EncodeError",
    "Estimate",
    "Frame",
    "Gaussian",
    "GaussianMixture",
    "IllPosedError",
    "Key",
    "Kind",
    "LayoutError",
    "LeftOut",
    "LineListener",
    "Linear",
    "Link",
    "MapError",
    "MapFileError",
    "MapLine",
    "MapLineList",
    "MaplinesError",
    "Mixture",
    "Monitor",
    "MonteCarlo",
    "Motion",
    "Polyline",
    "PoseError",
    "PoseSource",
    "ProfileStatus",
    "Quadrature",
    "Reason",
    "Receiver",
    "RecordedDrive",
    "Refit",
    "Scenario",
    "Scene",
    "SceneView",
    "SigmaPoints",
    "SimulatedDrive",
    "Slot",
    "SlotView",
    "Status",
    "Transform",
    "Transmitter",
    "key_from_env",
    "key_from_file",
    "lateral",
    "lateral_jacobian",
    "map_lines",
    "map_scene",
    "maps",
    "nearest_covariance",
    "pose_time_ns",
    "predict",
    "predict_to",
    "read_log",
    "read_signals",
    "scenario",
    "scene_mixture",
    "transform_line",
]

__version__ = "0.1.0"

#: Names by the module that defines them.
_EXPORTS = {
    "bus": "LineListener Link Receiver Transmitter key_from_env key_from_file read_log "
    "read_signals",
    "propagation": "Linear MapError Mixture MonteCarlo Motion Quadrature Refit SigmaPoints "
    "Transform map_lines map_scene pose_time_ns predict predict_to "
    "scene_mixture",
    "simulation.pose_source": "PoseSource",
    "simulation.recorded": "RecordedDrive",
    "simulation.scenarios": "SCENARIOS STREETS Scenario scenario",
    "simulation.trajectory": "SimulatedDrive",
    "values.errors": "DriveFileError EncodeError IllPosedError LayoutError MapFileError "
    "MaplinesError",
    "values.gaussian": "Gaussian nearest_covariance",
    "values.line": "Kind LeftOut MapLine MapLineList Slot Status lateral lateral_jacobian "
    "transform_line",
    "values.mixture": "GaussianMixture",
    "values.polyline": "Polyline",
    "values.scene": "Estimate PoseError Scene",
    "wire": "Authenticator Batch Codec Decoder E2EConfig E2EState Frame Key Monitor ProfileStatus "
    "Reason SceneView SlotView",
}
#: Modules that are names of the package as a whole.
_SUBMODULES = ("maps",)
_MODULE_OF = {name: module for module, names in _EXPORTS.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Import a name from its module (PEP 562)."""
    if name in _SUBMODULES:
        return import_module(f".{name}", __name__)
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)
    globals()[name] = value  # found without this function the next time
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
