"""Bus as input of a command: what it shows of a sender, and why nothing is received."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..bus import Link, LogFrame
from ..logs.first_frames import FirstFrames
from ..wire import Decoder, LineCodec, Reason
from .output import counts_text


class ObservedLink(Link):
    """Link that receives frames of all CAN IDs until the first line; they tell which DBC fits.

    Args:
        decoder: of the lines.
        opener: of the interface, as for ``Link``.
        settings: as for ``Link``.
    """

    def __init__(self, decoder: Decoder, opener: Any = None, **settings: Any) -> None:
        super().__init__(opener, **settings)
        self.first = FirstFrames()
        self._decoder: Decoder | None = decoder

    def recv(self, timeout: float) -> Any:
        """Return the next frame, as ``Link.recv``."""
        message = super().recv(timeout)
        if self._decoder is None or message is None:
            return message
        if self._decoder.lines:
            self.accept_only(self._decoder.can_ids)
            self._decoder = None
        elif not (message.is_error_frame or message.is_remote_frame):
            self.first.add(
                LogFrame(
                    message.arbitration_id,
                    bytes(message.data),
                    round(message.timestamp * 1e9),
                    message.is_extended_id,
                    "",
                    has_time=True,
                )
            )
        return message


def why_silent(
    link: ObservedLink, codec: LineCodec, counts: Mapping[Reason, int], *, fd: bool
) -> str:
    """Return what to check if no line has arrived.

    Args:
        link: on which it was to come.
        codec: of the lines.
        counts: dropped frames by reason.
        fd: whether the interface is for CAN FD.
    """
    from ..recordings.fitting import misfit

    if not link.first.frames:
        return (
            "no frame has arrived; check that the sender runs, on the same --interface and "
            "--channel" + ("" if fd else ", and whether it sends CAN FD (--fd)")
        )
    dropped = counts_text({reason.name: n for reason, n in counts.items()})
    return (
        f"frames have arrived, but none completed a line (dropped: {dropped}); "
        f"{misfit(link.first, [codec]).text}"
    )
