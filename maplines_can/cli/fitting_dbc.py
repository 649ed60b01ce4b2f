"""Why frames that complete no line are probably of another DBC, and of which."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Set as AbstractSet
from pathlib import Path

from ..values.errors import LogError
from ..wire import SHIPPED, Codec, Reason
from .options import codec_from
from .stderr import note

#: CAN IDs of a log that are kept for this; more than the classic ones.
MAX_IDS = 4096


#: Reasons for which the frames of another DBC with the same CAN IDs are dropped.
_OTHER_LAYOUT = (Reason.CRC, Reason.PAGE, Reason.LENGTH)


def choose_dbc(arguments: argparse.Namespace) -> None:
    """Replace ``--dbc auto``, or a folder of DBCs, by the DBC that fits a log best.

    Raises:
        LogError: no DBC fits, or the log is a stream.
    """
    wanted = arguments.dbc
    if wanted is None or (wanted != "auto" and not Path(wanted).is_dir()):
        return
    from ..recordings.data_set import logs_of
    from ..recordings.fitting import best_fit, fits

    if "-" in arguments.logs:
        raise LogError(f"--dbc {wanted} reads the begin of a log twice; give a file, or the DBC")
    log = logs_of(arguments.logs)[0]
    dbcs = SHIPPED if wanted == "auto" else [*map(str, sorted(Path(wanted).glob("*.dbc")))]
    found = fits(log, dbcs, arguments.encoding)
    best = best_fit(found, log)
    others = [fit for fit in found if fit is not best and fit.records]
    also = f"; {', '.join(fit.name for fit in others)}: {others[0].intact} frames" if others else ""
    note(f"--dbc {wanted}: {best}{also}")
    arguments.dbc = best.codec.layout.source


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
