"""Variables of the two nodes: what a receiver and a sender take and give."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

from ...propagation.refit import MAX_MISFIT
from ...values.line import Kind, Slot, Status
from ...values.scene import MapError
from ...wire.layout.message_layout import Layout
from ...wire.protection.e2e_state import E2EState
from ...wire.reception.check import Reason
from .variables import ENTRIES, Role, Row, Store

#: Where a receiver evaluates lines, unless its parameters say otherwise [m].
POSITIONS = (0.0, 20.0, 40.0, 80.0)
REAL, CHOICE, COUNT, FLAG = Store
FIXED, TUNABLE, INPUT, OUTPUT = Role
#: Standard deviation of a position that no line has: the start value of a limit is finite [m].
NO_LIMIT = 1e6
#: E2E checks of a slot, or of a message of whole scenes.
CHECKS = ("ok", "lost", "repeated", "wrong_sequence", "errors", "no_new_data")
THREE, FOUR = range(1, 4), range(1, 5)


class ArbitrationLost(IntEnum):
    """What a bus does with a frame that has lost the arbitration, as FMI-LS-BUS numbers it."""

    BUFFER_AND_RETRANSMIT = 1
    DISCARD_AND_NOTIFY = 2


class E2EStatus(IntEnum):
    """Result of the E2E check of one record, as AUTOSAR numbers it, and that of none."""

    OK = 0x00
    NONEWDATA = 0x01
    ERROR = 0x07
    REPEATED = 0x08
    OKSOMELOST = 0x20
    WRONGSEQUENCE = 0x40
    NONE = 0xFF


class Refusal(IntEnum):
    """Why a line is not sent, as maplines.h numbers it."""

    SENT = 0
    NO_MESSAGE = 1
    NO_COVARIANCE = 2
    BAD_MEAN = 3
    BAD_COVARIANCE = 4
    BAD_VARIANCE = 5
    ASYMMETRIC = 6
    BAD_RANGE = 7
    BAD_AGE = 8
    BAD_KIND = 9
    BAD_STATUS = 10


class Omission(IntEnum):
    """Why the line of a slot is not given for a pose."""

    GIVEN = 0
    NOT_IN_WINDOW = 1
    ACROSS = 2
    TOO_SHORT = 3
    UNCERTAIN = 4
    FEW_POINTS = 5
    NO_LINE = 6


class LeftOut(IntEnum):
    """Why a whole scene does not have the line of a slot, as maplines.h numbers it."""

    IN_SCENE = 0
    ACROSS = 1
    RANGE = 2
    MEAN = 3
    COVARIANCE = 4


class CanState(IntEnum):
    """State of a CAN controller, as FMI-LS-BUS numbers it."""

    ERROR_ACTIVE = 1
    ERROR_PASSIVE = 2
    BUS_OFF = 3


def controller_rows(fd_baud_rate: int) -> list[Row]:
    """Return the variables of the CAN controller that each node has."""
    return [
        Row(COUNT, "BAUD_RATE", "CAN.baud_rate", FIXED, "bit rate of the bus", "bit/s", 500_000),
        Row(COUNT, "FD_BAUD_RATE", "CAN.fd_baud_rate", FIXED,
            "bit rate of the data of CAN FD frames; 0: the node has classic CAN", "bit/s",
            fd_baud_rate),
        Row(CHOICE, "ARBITRATION_LOST", "CAN.arbitration_lost", FIXED,
            "what a bus simulation does with a frame that has lost the arbitration",
            start=ArbitrationLost.BUFFER_AND_RETRANSMIT, choices=ArbitrationLost),
        Row(FLAG, "BUS_NOTIFICATIONS", "CAN.BusNotifications", FIXED,
            "the bus confirms frames, and tells of errors and of lost arbitrations"),
        Row(CHOICE, "CAN_STATE", "CAN.state", OUTPUT, "state of the CAN controller",
            choices=CanState),
        Row(COUNT, "TRANSMIT_ERRORS", "CAN.transmit_error_counter", OUTPUT,
            "transmit error counter of CAN"),
        Row(COUNT, "RECEIVE_ERRORS", "CAN.receive_error_counter", OUTPUT,
            "receive error counter of CAN"),
        Row(COUNT, "FRAMES_SENT", "CAN.frames_sent", OUTPUT,
            "frames given to the bus, with those that were given again"),
        Row(COUNT, "CONFIRMED", "CAN.confirmed", OUTPUT, "frames that the bus confirmed"),
        Row(COUNT, "ARBITRATIONS_LOST", "CAN.arbitrations_lost", OUTPUT,
            "frames that the bus dropped, since they lost the arbitration"),
        Row(COUNT, "BUS_ERRORS", "CAN.bus_errors", OUTPUT, "errors that the bus told of"),
        Row(COUNT, "MALFORMED", "CAN.malformed", OUTPUT,
            "operations that were dropped, since they are malformed"),
        Row(COUNT, "FORMAT_ERRORS", "CAN.format_errors", OUTPUT,
            "operations of this node that another participant found malformed"),
    ]  # fmt: skip


def receiver_rows() -> list[Row]:
    """Return the variables of a receiver, besides those of its controller."""
    positions = range(1, len(POSITIONS) + 1)
    rows = [
        Row(REAL, "CYCLE_TIME", "cycle_time", FIXED,
            "time between the lines of a slot; 0: that of the DBC", "s"),
        Row(REAL, "TIMEOUT", "timeout", FIXED,
            "longest time between the frames of a line; 0: that which follows from cycle_time",
            "s"),
        Row(REAL, "X", "x", TUNABLE, "place at which lines are evaluated", "m", POSITIONS,
            indices=positions),
        Row(FLAG, "USABLE", ".usable", OUTPUT, "a controller may use the line"),
        Row(FLAG, "RECEIVED", ".received", OUTPUT, "a line was received, however long ago"),
        Row(FLAG, "STALE", ".stale", OUTPUT, "nothing newer came for some cycles"),
        Row(FLAG, "TWO_SENDERS", ".two_senders", OUTPUT, "two nodes send lines of this slot"),
        Row(CHOICE, "KIND", ".kind", OUTPUT, "kind of marking or boundary", choices=Kind),
        Row(CHOICE, "STATUS", ".status", OUTPUT, "quality of the covariance", choices=Status),
        Row(CHOICE, "E2E_STATE", ".e2e_state", OUTPUT, "E2E state of the slot", choices=E2EState),
        Row(CHOICE, "E2E_STATUS", ".e2e_status", OUTPUT, "result of the last E2E check",
            choices=E2EStatus),
        Row(REAL, "AGE", ".age", OUTPUT,
            "time since the pose of the line; infinite if too old, unknown, or without a line",
            "s"),
        Row(REAL, "X_MIN", ".x_min", OUTPUT, "start of the valid range", "m"),
        Row(REAL, "X_MAX", ".x_max", OUTPUT, "end of the valid range", "m"),
        Row(REAL, "MEAN", ".mean", OUTPUT, "y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]",
            indices=FOUR),
        Row(REAL, "COV", ".cov", OUTPUT,
            "covariance of the mean, in the units of the mean; variances are infinite without a "
            "line", indices=ENTRIES),
        Row(REAL, "Y", ".y", OUTPUT, "lateral position at x of the same index", "m",
            indices=positions),
        Row(REAL, "Y_SIGMA", ".y_sigma", OUTPUT,
            "standard deviation of y; infinite outside the valid range", "m", indices=positions),
        Row(COUNT, "OK", ".ok", OUTPUT, "records accepted in sequence"),
        Row(COUNT, "LOST", ".lost", OUTPUT, "records missing between those"),
        Row(COUNT, "REPEATED", ".repeated", OUTPUT, "records that came again"),
        Row(COUNT, "WRONG_SEQUENCE", ".wrong_sequence", OUTPUT, "records out of sequence"),
        Row(COUNT, "ERRORS", ".errors", OUTPUT, "records with a wrong checksum or content"),
        Row(COUNT, "NO_NEW_DATA", ".no_new_data", OUTPUT, "cycles without a record"),
        Row(CHOICE, "LEFT_OUT", ".left_out", OUTPUT,
            "why the newest whole scene that names the slot has no line of it; then the line is an "
            "older one", choices=LeftOut),
        *(Row(COUNT, owner, owner, OUTPUT, f"E2E checks of the message of whole scenes {owner}",
              indices=CHECKS) for owner in ("SCENE", "SCENE2")),
        Row(COUNT, "FRAMES", "frames", OUTPUT, "frames received"),
        Row(COUNT, "LINES", "lines", OUTPUT, "lines delivered"),
        Row(COUNT, "POSE_ERRORS", "pose_errors", OUTPUT, "pose errors received"),
        Row(COUNT, "LOST", "lost", OUTPUT, "records of lines that are missing"),
        Row(COUNT, "PENDING", "pending", OUTPUT, "frames of what is not complete yet"),
        Row(COUNT, "DROPPED", "dropped", OUTPUT, "frames dropped, by reason",
            indices=[reason.name for reason in list(Reason)[1:]]),
    ]  # fmt: skip
    return rows + scene_rows(positions)


def sender_rows(layout: Layout) -> list[Row]:
    """Return the variables of a sender, besides those of its controller and its inputs."""
    messages = list(layout.messages.values())
    cycles_ms = [own.cycle_ms for own in messages if own.cycle_ms > 0]
    has_classic = any(own.can_id is not None for own in messages)
    return [
        Row(REAL, "CYCLE_TIME", "cycle_time", FIXED, "time between two lines of a slot", "s",
            min(cycles_ms, default=50) * 1e-3),
        Row(REAL, "MAX_AGE", "max_age", FIXED,
            "greatest age that is stated; beyond it, a line is sent as too old", "s",
            layout.max_age),
        Row(FLAG, "FD", "fd", FIXED, "send CAN FD frames", start=not has_classic),
        Row(COUNT, "LINES", "lines", OUTPUT, "lines sent with all their frames"),
        Row(COUNT, "EXPIRED", "expired", OUTPUT, "lines sent as too old"),
        Row(COUNT, "OVERRUNS", "overruns", OUTPUT, "deadlines missed by a period or more"),
        Row(COUNT, "GIVEN_UP", "given_up", OUTPUT,
            "lines of which frames were not sent: the bus did not confirm them for a period, or "
            "is off"),
        Row(COUNT, "REFUSED", "refused", OUTPUT, "lines that cannot be sent"),
        Row(CHOICE, "REFUSAL", "refusal", OUTPUT, "why the last of those cannot be sent",
            choices=Refusal),
    ]  # fmt: skip


def line_rows() -> list[Row]:
    """Return the inputs of a sender that takes lines."""
    return [
        Row(FLAG, "VALID", ".valid", INPUT, "there is a line, which is sent"),
        Row(CHOICE, "KIND", ".kind", INPUT, "kind of marking or boundary", choices=Kind),
        Row(CHOICE, "STATUS", ".status", INPUT,
            "FULL; DIAGONAL to send the variances only, UNKNOWN the mean only; or that of a "
            "received line", start=Status.FULL, choices=Status),
        Row(REAL, "X_MIN", ".x_min", INPUT, "start of the valid range", "m"),
        Row(REAL, "X_MAX", ".x_max", INPUT, "end of the valid range", "m"),
        Row(REAL, "AGE", ".age", INPUT, "time since the pose of the line, now", "s"),
        Row(REAL, "MEAN", ".mean", INPUT, "y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]",
            indices=FOUR),
        Row(REAL, "COV", ".cov", INPUT, "covariance of the mean, in the units of the mean",
            indices=ENTRIES),
    ]  # fmt: skip


def pose_rows(window: tuple[float, float], map_error: MapError, max_sigma: float) -> list[Row]:
    """Return the inputs of a sender that takes a pose, and what it says of the map around it.

    The arguments are the start values of parameters, see ``map_lines``.
    """
    low, high = window
    return [
        Row(REAL, "WINDOW_X_MIN", "window.x_min", FIXED,
            "start of the range ahead of the car that lines may extend to, -60 m or more", "m",
            low),
        Row(REAL, "WINDOW_X_MAX", "window.x_max", FIXED, "end of that range, 150 m or less", "m",
            high),
        Row(REAL, "MAX_MISFIT", "max_misfit", FIXED,
            "greatest deviation of a cubic from its line", "m", MAX_MISFIT),
        Row(REAL, "MAX_SIGMA", "max_sigma", FIXED,
            "greatest standard deviation of a lateral position; a range ends there", "m",
            min(max_sigma, NO_LIMIT)),
        Row(REAL, "MAP_POINT_SIGMA", "map_error.point_sigma", FIXED,
            "standard deviation of the error of each map point", "m", map_error.point_sigma),
        Row(REAL, "MAP_OFFSET_SIGMA", "map_error.offset_sigma", FIXED,
            "standard deviation of the common offset of a line of the map", "m",
            map_error.offset_sigma),
        Row(REAL, "MAP_HEADING_SIGMA", "map_error.heading_sigma", FIXED,
            "standard deviation of the common rotation of a line of the map", "rad",
            map_error.heading_sigma),
        Row(FLAG, "POSE_VALID", "pose.valid", INPUT, "there is a pose"),
        Row(REAL, "POSE_AGE", "pose.age", INPUT, "time since the pose, now", "s"),
        Row(REAL, "POSE_MEAN", "pose.mean", INPUT,
            "x [m], y [m], heading [rad] in the frame of the map", indices=THREE),
        Row(REAL, "POSE_COV", "pose.cov", INPUT, "covariance of the mean, in the units of the mean",
            indices=ENTRIES[:6]),
        Row(FLAG, "ON_ROUTE", "route.is_on", OUTPUT, "the pose is on the route"),
        Row(COUNT, "SECTION", "route.section", OUTPUT,
            "section of the route where the pose is, from 1; 0 if it is not on the route"),
        Row(REAL, "ROUTE_S", "route.s", OUTPUT, "position of the pose along the route", "m"),
        Row(CHOICE, "LEFT_OUT", ".left_out", OUTPUT, "why there is no new line, or that there is",
            start=Omission.NO_LINE, choices=Omission),
        Row(COUNT, "OFF_ROUTE", "off_route", OUTPUT, "poses that are not on the route"),
        Row(COUNT, "NOT_COMPUTED", "not_computed", OUTPUT,
            "poses without lines, since the Gaussian is none, or is too wide"),
    ]  # fmt: skip


def scene_rows(positions: Sequence[int]) -> list[Row]:
    """Return the variables of a receiver for lines with the error of their pose."""
    return [
        Row(CHOICE, "LANE_LEFT", "lane.left", TUNABLE, "line on the left of the lane",
            start=Slot.EGO_LEFT, choices=Slot),
        Row(CHOICE, "LANE_RIGHT", "lane.right", TUNABLE, "line on the right of the lane",
            start=Slot.EGO_RIGHT, choices=Slot),
        Row(FLAG, "SCENE_USABLE", "scene.usable", OUTPUT, "a controller may use the scene"),
        Row(CHOICE, "SCENE_E2E_STATE", "scene.e2e_state", OUTPUT, "E2E state of the pose error",
            choices=E2EState),
        Row(COUNT, "SCENE_LINES", "scene.lines", OUTPUT, "lines of the scene"),
        Row(REAL, "SCENE_AGE", "scene.age", OUTPUT,
            "time since the pose of the scene; infinite if too old or unknown", "s"),
        Row(REAL, "WIDTH", "lane.width", OUTPUT, "lateral distance of the lines at x", "m",
            indices=positions),
        Row(REAL, "WIDTH_SIGMA", "lane.width_sigma", OUTPUT,
            "standard deviation of the width; infinite outside the valid ranges, and without a "
            "scene that has both lines", "m", indices=positions),
        Row(REAL, "CENTRE", "lane.centre", OUTPUT, "middle between the lines at x", "m",
            indices=positions),
        Row(REAL, "CENTRE_SIGMA", "lane.centre_sigma", OUTPUT,
            "standard deviation of the centre; infinite as that of the width", "m",
            indices=positions),
    ]  # fmt: skip
