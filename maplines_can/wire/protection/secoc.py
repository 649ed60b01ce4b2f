"""Authentication of records: AUTOSAR SecOC with AES-CMAC (RFC 4493).

A secured I-PDU is

    authentic I-PDU: record | padding | key ID
    truncated freshness value: its low bytes
    truncated MAC: its first bytes

and the MAC is

    AES-CMAC(key, data ID in 16 bits | authentic I-PDU | freshness value in 64 bits)

All numbers are big-endian, as in AUTOSAR's specification (SWS_SecureOnboardCommunication).

The freshness value is the sender's time in microseconds, or the last freshness value plus one if
that is greater. So it increases with each frame, also over a restart, and nothing has to be stored.
docs/security.md says which attacks this prevents and which it does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

from ...core import ffi, lib
from ...values.errors import EncodeError, LayoutError
from ..layout.slot_messages import SecuredLayout
from .key import Key, shown

DATA_ID_BYTES, FRESHNESS_BYTES = 2, 8
#: Greatest freshness value that is sent or accepted, so that a reconstructed one fits 64 bits.
MAX_FRESHNESS = 2**63 - 1
#: Bytes of a complete freshness value, enough for 2283 years.
WHOLE_FRESHNESS = 7


class Authenticator:
    """Keys of a sender or a receiver, and the freshness values of a sender.

    Keys can be changed during operation without losing a line, because each frame has the ID of
    its key: ``add`` the new key to all receivers and the sender, ``use`` it at the sender, and
    ``retire`` the old key when all its frames have been received.

    One thread may send with it; any thread may receive, and any thread may change the keys.

    Args:
        keys: the first one signs; all of them verify.
        clock: function that returns the time since 1970 as an int [ns], such as ``time.time_ns``.
            Any clock that increases over restarts will do. It is called once here, as a check. A
            receiver can do without; see ``Verifier``. "frames": a receiver takes the times of
            reception of the frames, such as those of a log with absolute time stamps.
        window_ns: greatest difference between a frame's freshness value and the receiver's clock
            [ns], 1000 or more. It must exceed the difference of the two clocks plus the time that
            a frame may wait, which includes the 0.1 s that a ``Transmitter`` signs ahead.
        not_before: freshness values up to this one are neither sent nor accepted [us]. Without a
            reliable clock, the last freshness value before a restart.

    Raises:
        TypeError: a key is not a ``Key``.
        ValueError: there is no key, two keys have the same ID, the clock does not return an int,
            or a bound is out of range.

    >>> layout = SecuredLayout(length=48, freshness_bytes=7, mac_bytes=8)
    >>> sender = Authenticator(Key(bytes(range(16))), clock=lambda: 1_000_000)
    >>> payload = sender.secure(bytes(32), data_id=0x4D50, layout=layout)
    >>> len(payload), payload[:32] == bytes(32), sender.last_sent
    (48, True, 1000)

    A key change, with a receiver that never sends:

    >>> receiver, new = Authenticator(Key(bytes(range(16)))), Key(bytes(range(1, 17)), key_id=2)
    >>> receiver.add(new)
    >>> sender.add(new)
    >>> sender.use(2)
    >>> receiver.retire(1)
    >>> sender.active == receiver.active == new
    True
    """

    def __init__(
        self,
        *keys: Key,
        clock: Callable[[], int] | Literal["frames"] | None = None,
        window_ns: int = 1_000_000_000,
        not_before: int = 0,
    ) -> None:
        if not keys:
            raise ValueError("an authenticator needs a key or more")
        if strange := [type(key).__name__ for key in keys if not isinstance(key, Key)]:
            del keys  # one of them may be a secret
            raise TypeError(f"keys must be of the class Key, got a {strange[0]}; make a Key of it")
        if problem := _problem(clock, window_ns, not_before):
            del keys, clock, window_ns, not_before  # a traceback may show them
            raise ValueError(problem)
        self._keys: dict[int, Key] = {}
        for key in keys:
            self.add(key)
        self._active = keys[0]
        self._clock = clock
        self.window = int(window_ns // 1000)  #: [us]
        self.not_before = not_before  #: [us]
        #: Last freshness value of a sent frame [us]; to be stored for ``not_before``.
        self.last_sent = not_before

    @property
    def active(self) -> Key:
        """Key that signs."""
        return self._active

    @property
    def keys(self) -> tuple[Key, ...]:
        """All keys, by key ID."""
        return tuple(key for _, key in sorted(self._keys.items()))

    def key(self, key_id: int) -> Key | None:
        """Return the key with this key ID; None if there is none."""
        return self._keys.get(key_id)

    def add(self, key: Key) -> None:
        """Accept frames of this key too.

        Raises:
            TypeError: it is not a ``Key``.
            ValueError: another key has the same key ID, so their frames could not be told apart.
        """
        if not isinstance(key, Key):
            strange = type(key).__name__
            del key  # it may be a secret
            raise TypeError(f"key must be of the class Key, got a {strange}; make a Key of it")
        if self._keys.setdefault(key.key_id, key) != key:
            raise ValueError(
                f"key_id {key.key_id} is taken by {self._keys[key.key_id]!r}; give the new key "
                "another key_id, or retire that one first"
            )

    def use(self, key_id: int) -> None:
        """Sign with this key from now on.

        Raises:
            ValueError: there is no such key.
        """
        if not isinstance(key_id, int) or key_id not in self._keys:
            got = shown(key_id)
            del key_id  # it may be a secret
            raise ValueError(f"key_id must be one of {sorted(self._keys)}, got {got}; add it")
        self._active = self._keys[key_id]

    def retire(self, key_id: int) -> None:
        """Accept frames of this key no longer.

        A sender that has sent must ``use`` another key first. An authenticator that has not sent
        may retire any key but the last; if it is the active one, the earliest added of the
        remaining keys becomes active.

        Raises:
            ValueError: the key is in use, is the last one, or does not exist.
        """
        kept = set()
        if self.last_sent > self.not_before or len(self._keys) == 1:
            kept = {self._active.key_id}
        if not isinstance(key_id, int) or key_id not in self._keys.keys() - kept:
            got = shown(key_id)
            del key_id  # it may be a secret
            in_use = f"; the key that is in use, {self._active.key_id}, cannot be retired"
            raise ValueError(
                f"key_id must be one of {sorted(self._keys.keys() - kept)}, got {got}"
                f"{in_use if kept else ''}"
            )
        if key_id == self._active.key_id:
            self._active = next(key for key in self._keys.values() if key.key_id != key_id)
        del self._keys[key_id]

    @property
    def has_clock(self) -> bool:
        """Whether a receiver knows the time."""
        return self._clock is not None

    def now(self, t_ns: int | None = None) -> int | None:
        """Return the time as a freshness value [us]; None if it is not known.

        Args:
            t_ns: time of reception of the frame that is received [ns].
        """
        now_ns = self._clock() if callable(self._clock) else t_ns if self._clock else None
        return None if now_ns is None else now_ns // 1000

    def secure(self, record: bytes, data_id: int, layout: SecuredLayout) -> bytes:
        """Return the secured I-PDU of a record with a SecOC data ID and the next freshness value.

        Raises:
            EncodeError: there is no clock, or its time is out of range.
        """
        now = self.now()
        if now is None:
            raise EncodeError("an authenticator that sends needs a clock, such as time.time_ns")
        if (least := max(self.last_sent + 1, now)) > MAX_FRESHNESS:
            raise EncodeError(f"freshness must be 2^63 - 1 us at most, got {least}")
        if len(record) >= layout.authentic_bytes:
            raise EncodeError(
                f"a record must have {layout.authentic_bytes - 1} bytes at most, got {len(record)}"
            )
        key = self._active
        signing = ffi.new(
            "maplines_signing_t *",
            {
                "layout": {
                    "fd_authentic": layout.authentic_bytes,
                    "fd_freshness": layout.freshness_bytes,
                    "fd_mac": layout.mac_bytes,
                },
                "data_id": data_id,
                "signer": {"key_id": key.key_id, "last_us": self.last_sent},
            },
        )
        lib.maplines_sign(signing, len(record), record, max(now, 0), ffi.NULL)
        mac = key.mac(ffi.buffer(signing.data, signing.size)[:])
        size = lib.maplines_sign(signing, len(record), record, max(now, 0), mac)
        self.last_sent = signing.signer.last_us
        return bytes(ffi.buffer(signing.pdu, size))


class Verifier:
    """What a receiver of secured I-PDUs has: keys, clock, and the last accepted freshness values.

    A decoder verifies with it. Only a valid MAC changes a freshness value.

    A freshness value is accepted if it is greater than the last accepted one, and with a clock,
    if it is also within the authenticator's window about the current time. Only the clock rejects
    a recording that is replayed to a receiver that has just started; without a clock, only
    ``not_before`` does. A value beyond ``MAX_FRESHNESS`` is never accepted.

    The clock also completes a freshness value of less than 7 bytes, after any silence and any
    number of lost frames, since at most one value with these low bytes lies within the window.
    Without a clock the message must have all 7 bytes, because the length of a silence is unknown.
    A log has the times of its frames, so that they are the clock, if they are absolute.

    Raises:
        LayoutError: ``Freshness`` has too few bytes for the window, or for a receiver without a
            clock.
    """

    def __init__(self, authenticator: Authenticator, layout: SecuredLayout) -> None:
        check_freshness(authenticator, layout)
        self.authenticator = authenticator  #: keys and clock
        self.layout = layout  #: of the secured I-PDUs
        #: Last accepted freshness value, by data ID [us].
        self.last_accepted: dict[int, int] = {}


def _problem(clock: object, window_ns: object, not_before: object) -> str | None:
    """Return what is wrong with the settings of an authenticator, without repeating a secret."""
    now = clock() if callable(clock) else None
    is_of_frames = isinstance(clock, str) and clock == "frames"
    if not (clock is None or is_of_frames or isinstance(now, int)):
        got = f"one that returns {shown(now)}" if callable(clock) else shown(clock)
        return (
            "clock must be a function that returns nanoseconds as an int, such as time.time_ns, or "
            f'"frames", got {got}'
        )
    if not (isinstance(window_ns, int | float) and 1000 <= window_ns < math.inf):
        return (
            f"window_ns must be at least 1000 ns and finite, got {shown(window_ns)}; a second is "
            "1_000_000_000"
        )
    if not (isinstance(not_before, int) and 0 <= not_before <= MAX_FRESHNESS):
        return (
            "not_before must be a whole number (int) from 0 to 2^63 - 1 us, got "
            f"{shown(not_before)}; take a stored last_sent, or a stored last accepted value"
        )
    return None


def check_freshness(authenticator: Authenticator, layout: SecuredLayout) -> None:
    """Check that the message has enough bytes of the freshness value to complete it.

    Raises:
        LayoutError: it has too few bytes.
    """
    span = 2 ** (8 * layout.freshness_bytes)  # [us]
    has = f"Freshness has {layout.freshness_bytes} bytes"
    if not authenticator.has_clock:
        if layout.freshness_bytes < WHOLE_FRESHNESS:
            raise LayoutError(
                f"{has}, but without a clock {WHOLE_FRESHNESS} are needed, since no frame could be "
                f"accepted after a silence of {span / 1e6:.6g} s; give the authenticator a clock, "
                'such as time.time_ns, or "frames" for a log, or widen Freshness in the DBC'
            )
    elif span < 2 * authenticator.window + 2:
        raise LayoutError(
            f"{has}, which repeat after {span / 1e6:.6g} s, but window_ns allows a difference of "
            f"{authenticator.window / 1e6:.6g} s to either side; widen Freshness in the DBC, or "
            f"use a window_ns of {1000 * (span // 2 - 1)} at most"
        )
