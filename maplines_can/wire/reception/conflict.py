"""Evidence that two senders use one slot."""

from __future__ import annotations

__all__ = ["SenderConflict"]

#: Proofs that make it certain, each within so many cycles of the one before. A transfer that a gateway
#: holds up or a sender that starts anew leaves one or two.
PROOFS, NEAR_CYCLES = 8, 32
#: Of so many records, so many came a second time: that makes it certain, too.
NEWS, COPIES = 32, 29
#: It is forgotten after so many cycles without either.
FORGOTTEN_CYCLES = 256


class SenderConflict:
    """What two senders leave, told from what a bad bus does to the records of one.

    A proof is a record that the first sender cannot have sent: one with the counter of another,
    or of a sequence of its own; at most one counts in half a cycle, and between two news.
    Two senders that send the same leave copies only; so does a path on which all comes
    twice. Time is an argument.

    Args:
        cycle_ns: how often records come [ns].
    """

    def __init__(self, cycle_ns: int) -> None:
        self._cycle_ns = cycle_ns
        self._proofs = self._news = self._copies = 0
        self._proof_ns = self._certain_ns = -(2**62)
        self._is_stuck = True  # nothing was new since the last proof
        #: Whether there are two senders, as far as is known now.
        self.is_certain = False

    def news(self) -> None:
        """A record was news."""
        self._is_stuck = False
        self._news += 1
        if self._news > NEWS:
            self._news, self._copies = 1, 0

    def copy(self, t_ns: int) -> None:
        """A record that was news came again for the first time: what is stuck leaves one."""
        self._copies += 1
        if self._news >= NEWS and self._copies >= COPIES:
            self.is_certain, self._certain_ns = True, t_ns

    def proof(self, t_ns: int) -> None:
        """A record came that another sender must have sent."""
        cycles = abs(t_ns - self._proof_ns) / self._cycle_ns
        if cycles < 0.5 or self._is_stuck:
            return
        self._proofs = self._proofs + 1 if cycles <= NEAR_CYCLES else 1
        self._proof_ns, self._is_stuck = t_ns, True
        if self._proofs >= PROOFS:
            self.is_certain, self._certain_ns = True, t_ns

    def withdraw(self) -> None:
        """The last proof was none: the sequence has taken over, as of a sender that starts anew."""
        self._proofs = max(0, self._proofs - 1)

    def elapse(self, t_ns: int) -> None:
        """Forget what is long past."""
        if self.is_certain and abs(t_ns - self._certain_ns) > FORGOTTEN_CYCLES * self._cycle_ns:
            self.is_certain, self._proofs = False, 0
