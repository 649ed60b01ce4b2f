"""Mistakes of a caller of the C core: named, and nothing is sent, nor does a counter advance."""

from functools import cache
from typing import Any

import pytest
from scene_layouts import layout_of
from support.scene_streams import COMPLETE, CONDITIONAL

from maplines_can.core import ffi, lib
from maplines_can.wire.core_tables import tables_of
from maplines_can.wire.layout.pose_layout import OWNERS

NAN, INF = float("nan"), float("inf")
COUNTERS = [255] * len(OWNERS)
VARIANCES = [1e-2, 1e-4, 1e-8, 1e-12]
HALVES = (0.5, 0.5)  #: weights of two components


@cache
def table(dbc: str) -> Any:
    return tables_of(layout_of(dbc))


def check(dbc: str, refusal: str, function: Any, *given: Any) -> None:
    """Call a function of a sender, and check what it says."""
    encoder, frames = ffi.new("maplines_encoder_t *"), ffi.new("maplines_frame_t[1024]")
    lib.maplines_encoder_init(encoder, table(dbc), ffi.NULL)
    encoder.counter = COUNTERS

    sent = function(encoder, *given, frames)

    assert ffi.string(lib.maplines_refusal_name(sent.refusal)).decode() == refusal
    assert (sent.count > 0) == (refusal == "SENT")
    assert refusal == "SENT" or [*encoder.counter] == COUNTERS


def put(structure: Any, *place: Any) -> None:
    """Set a member, whose place is names and indices, to the last of the arguments."""
    *path, last, value = place
    for step in path:
        structure = getattr(structure, step) if isinstance(step, str) else structure[step]
    if isinstance(last, str):
        setattr(structure, last, value)
    else:
        structure[last] = value


def good_line() -> Any:
    line = ffi.new(
        "maplines_input_t *", {"kind": 1, "status": 1, "x_min": -8, "x_max": 64, "has_age": True}
    )
    for i, variance in enumerate(VARIANCES):
        line.cov[i][i] = variance
    return line


LINES: list[tuple[str, tuple[Any, ...]]] = [
    ("SENT", ("age", 0.04)),
    ("NO_MESSAGE", ("slot", 9)),
    ("NO_MESSAGE", ("slot", 8)),
    ("BAD_MEAN", ("mean", 0, NAN)),
    ("BAD_MEAN", ("mean", 2, -INF)),
    ("BAD_COVARIANCE", ("cov", 1, 1, NAN)),
    ("BAD_COVARIANCE", ("cov", 3, 0, 2e307)),
    ("BAD_VARIANCE", ("cov", 2, 2, -1e-300)),
    ("ASYMMETRIC", ("cov", 0, 1, 1e-3 * 2e-9)),
    ("SENT", ("cov", 0, 1, 1e-3 * 9e-10)),
    ("BAD_RANGE", ("x_min", NAN)),
    ("BAD_RANGE", ("x_max", INF)),
    ("BAD_RANGE", ("x_min", 64.1)),
    ("SENT", ("x_min", 64.0)),
    ("BAD_AGE", ("age", -1e-9)),
    ("BAD_AGE", ("age", NAN)),
    ("SENT", ("age", INF)),
    ("BAD_KIND", ("kind", 8)),
    ("BAD_STATUS", ("status", 6)),
]


@pytest.mark.parametrize(("refusal", "change"), LINES, ids=str)
def test_a_mistake_in_a_line(refusal: str, change: Any) -> None:
    line = good_line()
    put(line, *change)
    check(COMPLETE, refusal, lib.maplines_encode_line, line, False, 0)


def test_a_covariance_that_is_not_sent_is_not_read() -> None:
    line = good_line()
    line.status, line.cov[1][1] = 0, NAN
    check(COMPLETE, "SENT", lib.maplines_encode_line, line, False, 0)


def test_a_line_of_a_conditional_dbc_is_sent_as_a_scene() -> None:
    check(CONDITIONAL, "NO_COVARIANCE", lib.maplines_encode_line, good_line(), False, 0)


@pytest.mark.parametrize(
    ("refusal", "weights", "change"),
    [
        ("SENT", HALVES, ("slot", 0)),
        ("BAD_WEIGHTS", (0.5, 0.6), ("slot", 0)),
        ("BAD_WEIGHTS", (1.5, -0.5), ("slot", 0)),
        ("BAD_WEIGHTS", (NAN, 0.5), ("slot", 0)),
        ("BAD_COUNT", (1 / 9,) * 9, ("slot", 0)),
        ("BAD_COUNT", (), ("slot", 0)),
        ("NO_MESSAGE", HALVES, ("slot", 8)),
        ("BAD_COVARIANCE", HALVES, ("cov", 1, 1, INF)),
    ],
)
def test_a_mistake_in_a_mixture(refusal: str, weights: Any, change: Any) -> None:
    line, components = good_line(), ffi.new("maplines_component_t[9]")
    put(line, *change)
    for i, weight in enumerate(weights):
        components[i].weight, components[i].cov = weight, line.cov
    given = line, components, len(weights), False, 0
    check(COMPLETE, refusal, lib.maplines_encode_mixture, *given)


SCENES: list[tuple[str, tuple[Any, ...]]] = [
    ("SENT", ("count", 2)),
    ("SENT", ("count", 0)),
    ("BAD_COUNT", ("count", 9)),
    ("BAD_MEAN", ("lines", 1, "mean", 1, INF)),
    ("BAD_COVARIANCE", ("cov", 5, 5, NAN)),
    ("BAD_VARIANCE", ("cov", 5, 5, -1e-9)),
    ("ASYMMETRIC", ("cov", 0, 5, 1.0)),
    ("INDEFINITE", ("cov", 1, 1, 1e-5)),
    ("BAD_VARIANCE", ("lines", 0, "specific", 2, 2, -1.0)),
    ("BAD_VARIANCE", ("pose_cov", 1, 1, -1.0)),
    ("BAD_POSE", ("pose_cov", 1, 1, 1e6)),
    ("BAD_RANGE", ("lines", 0, "fit_range", 1, -99.0)),
    ("BAD_RANGE", ("lines", 0, "fit_range", 0, -INF)),
    ("BAD_RANGE", ("lines", 0, "fit_range", 1, INF)),
    ("BAD_RANGE", ("lines", 0, "quartic", NAN)),
    ("BAD_RANGE", ("lines", 0, "x_min", 99.0)),
    ("BAD_POSE", ("offset_sigma", -1e-9)),
    ("BAD_POSE", ("offset_sigma", INF)),
    ("BAD_POSE", ("heading_sigma", NAN)),
    ("BAD_POSE", ("heading_sigma", INF)),
    ("BAD_POSE", ("correlation_time", 0.0)),
    ("BAD_AGE", ("pose_age", -1e-9)),
    ("BAD_AGE", ("pose_age", NAN)),
    ("SENT", ("pose_age", INF)),
    ("BAD_AGE", ("lines", 1, "age", -1e-9)),
    ("SENT", ("lines", 1, "age", INF)),
    ("SAME_SLOT", ("lines", 0, "slot", 1)),
    ("NO_MESSAGE", ("lines", 0, "slot", 8)),
    ("BAD_KIND", ("lines", 1, "kind", 8)),
    ("BAD_STATUS", ("lines", 1, "status", 6)),
]


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
@pytest.mark.parametrize(("refusal", "change"), SCENES, ids=str)
def test_a_mistake_in_a_scene(dbc: str, refusal: str, change: Any) -> None:
    members = {"count": 2, "has_specific": True, "correlation_time": 4.0, "has_pose_age": True}
    scene = ffi.new("maplines_scene_input_t *", members)
    for i in range(2):
        line = scene.lines[i]
        line.slot, line.kind, line.status, line.has_age = i, 1, 1, True
        line.x_max, line.mean[0], line.fit_range = 80, 1.75 - 3.5 * i, [-4, 84]
        for k, variance in enumerate(VARIANCES):
            line.specific[k][k], scene.cov[4 * i + k][4 * i + k] = variance, 4 * variance
    scene.cov[0][1] = scene.cov[1][0] = 1e-3
    for i, variance in enumerate((0.01, 0.01, 1e-6)):
        scene.pose_cov[i][i] = variance
    put(scene, *change)
    workspace = ffi.new("maplines_scene_workspace_t *")
    check(dbc, refusal, lib.maplines_encode_scene, scene, False, 0, workspace)
