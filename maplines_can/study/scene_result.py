"""Scene as sent and as received: the ego lane, and the frames of a cycle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from ..values.linalg import block_diagonal
from ..values.line import LeftOut, Slot
from ..values.scene import Scene
from ..wire import Frame, Owner, PreparedScene

#: Distances at which the ego lane is compared [m].
LANE_X = (0.0, 20.0, 40.0)
#: Lines of the ego lane.
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)


@dataclass(frozen=True)
class LaneResult:
    """Width or centre of the ego lane at a distance, as sent and as received."""

    quantity: str  #: width or centre
    x: float  #: [m]
    true_value: float  #: before encoding [m]
    true_sigma: float  #: [m]
    value: float  #: as received [m]
    sigma: float  #: [m]
    sigma_ratio: float | None  #: received over true; None if the true one is 0
    independent_sigma: float  #: of the received lines if they are taken as independent [m]


@dataclass(frozen=True)
class SceneResult:
    """Scene before encoding and as received; without a lane if that was not received."""

    lane: Sequence[LaneResult]  #: where both of its lines are valid
    #: of each cycle by the owner of the record: the pose error ("pose"), then each line; or the
    #: messages of whole scenes ("scene2", "scene")
    frames: Mapping[str, int]
    frames_of_full_records: int  #: of a cycle, if each line had a covariance of its own
    #: reasons of the lines that do not fit the message, or have no place there
    unsent: Mapping[Slot, LeftOut]

    def as_dict(self) -> dict[str, Any]:
        """Return all figures, for JSON."""
        return {
            "lane": [asdict(lane) for lane in self.lane],
            "frames": dict(self.frames),
            "frames_per_cycle": sum(self.frames.values()),
            "frames_of_full_records": self.frames_of_full_records,
            "unsent": [slot.name for slot in self.unsent],
        }


def scene_result(
    sent: PreparedScene,
    transfers: Mapping[Owner, Sequence[Frame]],
    left_out: Mapping[Slot, LeftOut],
    received: Scene | None,
    frames_of_full_records: int,
) -> SceneResult:
    """Compare a scene as sent with the scene as received.

    Args:
        sent: the scene as sent.
        transfers: frames of each record, by its owner.
        left_out: why lines are not sent.
        received: the scene as received; None if none was.
        frames_of_full_records: of a cycle, if each line had a covariance of its own.
    """
    scene = sent.scene
    return SceneResult(
        lane=[] if received is None else lane_results(scene, received),
        frames={
            owner.name if isinstance(owner, Slot) else owner: len(frames)
            for owner, frames in transfers.items()
        },
        frames_of_full_records=frames_of_full_records,
        unsent={slot: why for slot, why in left_out.items() if slot in scene.index},
    )


def lane_results(sent: Scene, received: Scene) -> list[LaneResult]:
    """Compare the width and the centre of the ego lane, where its lines are valid in both scenes.

    Returns:
        None of them if a scene lacks a line of the lane.
    """
    if not all(slot in scene.index for scene in (sent, received) for slot in LANE):
        return []
    ranges = [scene.x_range(LANE) for scene in (sent, received)]
    low, high = max(low for low, _ in ranges), min(high for _, high in ranges)
    blocks = block_diagonal(line.gaussian.cov for line in received.lines)
    apart = replace(received, cov=blocks)
    found = []
    for quantity, of in (("width", Scene.width), ("centre", Scene.centre)):
        for x in (x for x in LANE_X if low <= x <= high):
            (true, true_sigma), (value, sigma), (_, independent) = (
                [float(part) for part in of(scene, x)] for scene in (sent, received, apart)
            )
            ratio = sigma / true_sigma if true_sigma else None
            found.append(
                LaneResult(quantity, x, true, true_sigma, value, sigma, ratio, independent)
            )
    return found
