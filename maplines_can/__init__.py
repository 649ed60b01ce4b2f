"""The lines of a digital map on a CAN bus, with their uncertainty.

>>> import numpy as np, maplines_can as ml
>>> road = ml.Polyline([[x, 1.75 + x**2 / 4000] for x in range(-30, 100, 2)])
>>> ego = ml.Gaussian([0, 0, 0], np.diag([0.3, 0.1, 0.01]) ** 2)
>>> refit = ml.Refit(road, ego.mean, window=(-20.0, 80.0))
>>> line = ml.SigmaPoints()(refit, ego)  # Gaussian over (y_off, beta, c0, c1)
>>> codec = ml.Codec.from_dbc()
>>> payloads = codec.encode_batch(line.mean[None], line.cov[None])
>>> batch = codec.decode_batch(payloads)
>>> bool(batch.accepted[0]), abs(batch.mean[0, 0] - line.mean[0]) < 0.001
(True, np.True_)
"""

from .bus import Link, Receiver, Transmitter, key_from_env, key_from_file, read_log
from .errors import EncodeError, IllPosedError, LayoutError, MaplinesError
from .gaussian import Gaussian, nearest_covariance
from .line import Kind, MapLine, Slot, Status, lateral, lateral_jacobian, transform_line
from .mixture import GaussianMixture
from .polyline import Polyline
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
    pose_time_ns,
    predict,
    predict_to,
)
from .scenarios import SCENARIOS, Scenario, scenario
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
    SlotView,
)

__all__ = [
    "SCENARIOS",
    "Authenticator",
    "Batch",
    "Codec",
    "Decoder",
    "E2EConfig",
    "E2EState",
    "EncodeError",
    "Frame",
    "Gaussian",
    "GaussianMixture",
    "IllPosedError",
    "Key",
    "Kind",
    "LayoutError",
    "Linear",
    "Link",
    "MapError",
    "MapLine",
    "MaplinesError",
    "Mixture",
    "Monitor",
    "MonteCarlo",
    "Motion",
    "Polyline",
    "ProfileStatus",
    "Quadrature",
    "Reason",
    "Receiver",
    "Refit",
    "Scenario",
    "SigmaPoints",
    "Slot",
    "SlotView",
    "Status",
    "Transform",
    "Transmitter",
    "key_from_env",
    "key_from_file",
    "lateral",
    "lateral_jacobian",
    "nearest_covariance",
    "pose_time_ns",
    "predict",
    "predict_to",
    "read_log",
    "scenario",
    "transform_line",
]

__version__ = "0.1.0"
