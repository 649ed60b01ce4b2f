"""Why frames that complete no line are probably of another DBC, and of which."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set as AbstractSet

from ..wire import Codec, Reason
from .options import SHIPPED, codec_from

#: CAN IDs of a log that are kept for this; more than the classic ones.
MAX_IDS = 4096


#: Reasons for which the frames of another DBC with the same CAN IDs are dropped.
_OTHER_LAYOUT = (Reason.CRC, Reason.PAGE, Reason.LENGTH)


def dbc_hint(can_ids: AbstractSet[int], codec: Codec, dropped: Counter[Reason]) -> str:
    """Return whose frames they are if not those of a codec, and what to do; otherwise nothing.

    Args:
        can_ids: of the frames.
        codec: that found no line in them.
        dropped: frames by reason.
    """
    source = codec.layout.source
    fitting = {name: len(can_ids & codec_from(name).can_ids) for name in SHIPPED}
    best = max(SHIPPED, key=lambda name: fitting[name])
    if fitting[best] > len(can_ids & codec.can_ids):
        key = " and the key of the sender" if "secoc" in best else ""
        return f"the CAN IDs are not those of {source}, but of {best}; take --dbc {best}{key}"
    if not can_ids & codec.can_ids:
        return (
            f"no frame has a CAN ID of {source}, nor of another DBC of this package; take the "
            "--dbc of the sender"
        )
    if any(dropped[reason] for reason in _OTHER_LAYOUT):
        return (
            f"the CAN IDs are those of {source}, but no frame completes a line of it; take the "
            "--dbc of the sender, if the frames are not damaged"
        )
    return ""
