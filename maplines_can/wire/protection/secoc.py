"""Authentication of a record: AUTOSAR SecOC with AES-CMAC (RFC 4493).

A secured payload is  record | padding | key number | freshness | MAC , where the MAC is
the first bytes of

    AES-CMAC(key, data ID in 16 bits | all before the freshness | freshness in 64 bits)

and the freshness that is sent is the low bytes of those 64 bits. All numbers here have
their most significant byte first, as in AUTOSAR's specification (SWS_SecureOnboardCommunication).

The freshness value is the sender's time in microseconds, or one more than the last one where
that is greater. So it grows with each frame, also over a restart, and nothing has to be
stored. What it guards against and what it does not is told in docs/security.md.
"""

from __future__ import annotations

import hmac
import math
import re
from collections.abc import Callable
from typing import Any

from ...errors import EncodeError, KeyMaterialError, MissingExtraError
from ..message.channel import SecuredForm
from ..reasons import Reason

__all__ = ["Authenticator", "Key", "Verifier", "complete"]

#: Bytes of the secrets of AES-128 and AES-256.
SECRET_BYTES = (16, 32)
DATA_ID_BYTES, FRESHNESS_BYTES = 2, 8
#: The greatest freshness value that a caller may state: what is completed fits 64 bits too.
MOST_FRESHNESS = 2**63 - 1


class Key:
    """A secret for AES-CMAC, with the number by which frames name it.

    The secret itself is not kept where Python can show it: ``repr`` has the number
    and a fingerprint, which tells two keys apart and says nothing of either. No error holds
    it, nor do the locals of a frame of ours that an error has left.

    Args:
        secret: 16 or 32 random bytes.
        key_id: its number on the wire, 0 to 255.

    Raises:
        KeyMaterialError: the secret is no bytes, too short, too long, or one byte repeated, or
            the number is none.
        MissingExtraError: the package cryptography is not installed.

    >>> Key(bytes(range(16)), key_id=7)
    Key(key_id=7, fingerprint='78ad15')
    >>> Key.from_hex("00ff", source="the file")
    Traceback (most recent call last):
    ...
    maplines_can.errors.KeyMaterialError: the file must hold 32 or 64 hex digits (AES-128 or \
AES-256), got 4 characters
    """

    __slots__ = ("_base", "_check", "fingerprint", "key_id")

    def __init__(self, secret: bytes, key_id: int = 1) -> None:
        self.key_id, self.fingerprint = -1, "none"  # what a traceback shows of a key refused
        try:
            whole = isinstance(key_id, int)  # else it may be the secret, in the wrong place
            if not (whole and 0 <= key_id <= 255):
                got = repr(key_id) if whole else f"a {type(key_id).__name__}"
                raise KeyMaterialError(f"key_id must be a whole number from 0 to 255, got {got}")
            if not isinstance(secret, bytes | bytearray | memoryview):
                raise KeyMaterialError(
                    f"a key must be bytes, got a {type(secret).__name__}; Key.from_hex reads hex "
                    "digits"
                )
            if len(secret) not in SECRET_BYTES:
                raise KeyMaterialError(
                    f"a key must have 16 or 32 bytes (AES-128 or AES-256), got {len(secret)}"
                )
            if len(set(secret)) == 1:
                raise KeyMaterialError("a key must be random; this one is a single byte repeated")
            aes, cmac = _primitives()
            self._base = cmac(aes(bytes(secret)))
            self.key_id = int(key_id)
        finally:
            del secret, key_id  # a traceback may show what still has a name
        self._check = self.mac(b"maplines_can")  # shorter than any data that is sent
        self.fingerprint = self._check[:3].hex()

    @classmethod
    def from_hex(cls, text: str, key_id: int = 1, source: str = "a key") -> Key:
        """A key from hex digits; white space around them is left out.

        Args:
            text: the digits.
            key_id: see ``Key``.
            source: what errors call it; they never hold the text.
        """
        try:
            if not isinstance(text, str):
                raise KeyMaterialError(
                    f"{source} must be text of hex digits, got a {type(text).__name__}; Key takes "
                    "bytes"
                )
            text = text.strip()
            length, good = len(text), re.fullmatch("[0-9A-Fa-f]*", text) is not None
            if not good or length / 2 not in SECRET_BYTES:
                odd = "" if good else ", not all of them hex digits"
                raise KeyMaterialError(
                    f"{source} must hold 32 or 64 hex digits (AES-128 or AES-256), got {length} "
                    f"characters{odd}"
                )
            return cls(bytes.fromhex(text), key_id)
        finally:
            del text  # a traceback may show what still has a name

    def mac(self, data: bytes) -> bytes:
        """(16,) the whole AES-CMAC of some bytes."""
        cmac = self._base.copy()  # four times as fast as to begin with the secret
        cmac.update(data)
        return bytes(cmac.finalize())

    def holds(self, mac: bytes, data: bytes) -> bool:
        """Whether these are the first bytes of the MAC; takes as long wherever they differ."""
        return hmac.compare_digest(self.mac(data)[: len(mac)], mac)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Key):
            return NotImplemented
        same = hmac.compare_digest(self._check, other._check)
        return same and self.key_id == other.key_id

    def __hash__(self) -> int:
        return hash((self.key_id, self.fingerprint))

    def __repr__(self) -> str:
        return f"Key(key_id={self.key_id}, fingerprint={self.fingerprint!r})"

    def __reduce__(self) -> str:
        raise TypeError("a Key cannot be pickled or copied, since that would write its secret")


class Authenticator:
    """The keys of a sender or a receiver, and the freshness values that a sender gives.

    Keys may change while it is in use: ``add`` the new key to all receivers and the sender,
    ``use`` it at the sender, ``retire`` the old one when no frame of it is on its way. A frame
    names its key, so no line is lost.

    One thread sends with it; any may receive, and any may change the keys.

    Args:
        keys: the first is sent with; all are received with.
        clock: time since 1970 as an int [ns], such as ``time.time_ns``; any counter that grows
            over restarts does too. It is tried once at birth. A receiver may go without: see
            ``Verifier``.
        window_ns: how far a frame's freshness may be from the receiver's clock [ns], 1000 or
            more. More than the two clocks differ and a frame may wait, the 0.1 s included
            that a ``Transmitter`` signs ahead.
        not_before: freshness values up to it are neither given nor accepted: the last one
            before a restart, for who has no clock to rely on [us].

    Raises:
        TypeError: what should be a key is none.
        ValueError: there is no key, two have the same number, the clock does not give whole
            nanoseconds, or a bound is out of range.

    >>> form = SecuredForm(length=48, freshness_bytes=7, mac_bytes=8)
    >>> sender = Authenticator(Key(bytes(range(16))), clock=lambda: 1_000_000)
    >>> payload = sender.secure(bytes(32), data_id=0x4D50, form=form)
    >>> verify = Verifier(Authenticator(Key(bytes(range(16)))), form)
    >>> verify(payload, 0x4D50)[:32] == bytes(32), verify(payload, 0x4D50).name
    (True, 'REPLAY')
    >>> verify(payload, 0x4D51).name, verify(payload[:47], 0x4D50).name
    ('MAC', 'LENGTH')

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
        clock: Callable[[], int] | None = None,
        window_ns: int = 1_000_000_000,
        not_before: int = 0,
    ) -> None:
        if not keys:
            raise ValueError("an authenticator needs a key or more")
        if strange := [type(key).__name__ for key in keys if not isinstance(key, Key)]:
            del keys  # one may be a bare secret
            raise TypeError(f"keys must be of the class Key, got a {strange[0]}; make a Key of it")
        now = clock() if callable(clock) else None
        if clock is not None and not isinstance(now, int):
            raise ValueError(
                "clock must be a function that gives whole nanoseconds as an int, such as "
                f"time.time_ns, got {now!r} from {clock!r}"
            )
        if not (isinstance(window_ns, int | float) and 1000 <= window_ns < math.inf):
            raise ValueError(
                f"window_ns must be at least 1000 ns and finite, got {window_ns!r}; a second is "
                "1_000_000_000"
            )
        if not (isinstance(not_before, int) and 0 <= not_before <= MOST_FRESHNESS):
            raise ValueError(
                f"not_before must be a whole number (int) from 0 to 2^63 - 1 us, got "
                f"{not_before!r}; it is what last_sent was, or a last value accepted"
            )
        self._keys: dict[int, Key] = {}
        for key in keys:
            self.add(key)
        self._active = keys[0]
        self._clock = clock
        self.window = int(window_ns // 1000)  #: [us]
        self.not_before = not_before  #: [us]
        #: The last freshness value given to a frame [us]; what to store for ``not_before``.
        self.last_sent = not_before

    @property
    def active(self) -> Key:
        """The key that frames are sent with."""
        return self._active

    @property
    def keys(self) -> tuple[Key, ...]:
        """All keys, by their numbers."""
        return tuple(key for _, key in sorted(self._keys.items()))

    def key(self, key_id: int) -> Key | None:
        """The key of a number."""
        return self._keys.get(key_id)

    def add(self, key: Key) -> None:
        """Accept this key too.

        Raises:
            TypeError: it is no ``Key``.
            ValueError: another key has its number: frames of the two could not be told apart.
        """
        if not isinstance(key, Key):
            strange = type(key).__name__
            del key  # it may be a bare secret
            raise TypeError(f"key must be of the class Key, got a {strange}; make a Key of it")
        if self._keys.setdefault(key.key_id, key) != key:
            raise ValueError(
                f"key_id {key.key_id} is taken by {self._keys[key.key_id]!r}; number the new key "
                "otherwise, or retire that one first"
            )

    def use(self, key_id: int) -> None:
        """Send with this key from now on.

        Raises:
            ValueError: there is no such key.
        """
        if key_id not in self._keys:
            raise ValueError(f"key_id must be one of {sorted(self._keys)}, got {key_id!r}; add it")
        self._active = self._keys[key_id]

    def retire(self, key_id: int) -> None:
        """Accept this key no more.

        Who has sent must ``use`` another key before. Who has not may retire any but the
        last; the one that was added first of those that are left is then ``active``.

        Raises:
            ValueError: it is the one that is sent with or the last one, or there is none.
        """
        kept = set()
        if self.last_sent > self.not_before or len(self._keys) == 1:
            kept = {self._active.key_id}
        if key_id not in self._keys.keys() - kept:
            in_use = f"; the key that is in use, {self._active.key_id}, cannot be retired"
            raise ValueError(
                f"key_id must be one of {sorted(self._keys.keys() - kept)}, got {key_id!r}"
                f"{in_use if kept else ''}"
            )
        if key_id == self._active.key_id:
            self._active = next(key for key in self._keys.values() if key.key_id != key_id)
        del self._keys[key_id]

    def now(self) -> int | None:
        """The time as a freshness value [us]; None without a clock."""
        return None if self._clock is None else self._clock() // 1000

    def secure(self, record: bytes, data_id: int, form: SecuredForm) -> bytes:
        """The payload that carries a record, with the next freshness value.

        Raises:
            EncodeError: there is no clock to begin with, or it is out of range.
        """
        now = self.now()
        if now is None:
            raise EncodeError("an authenticator that sends needs a clock, such as time.time_ns")
        freshness = max(self.last_sent + 1, now)
        if freshness > MOST_FRESHNESS:
            raise EncodeError(f"freshness must be 2^63 - 1 us at most, got {freshness}")
        self.last_sent = freshness
        key = self._active
        authentic = record.ljust(form.authentic_bytes - 1, b"\0") + bytes([key.key_id])
        sent = freshness.to_bytes(FRESHNESS_BYTES, "big")[-form.freshness_bytes :]
        mac = key.mac(_authenticated(data_id, authentic, freshness))
        return authentic + sent + mac[: form.mac_bytes]


class Verifier:
    """What a receiver knows of freshness: the last value accepted of each data ID.

    Called with a payload and its data ID it gives the authentic bytes back, or the reason
    why not. Nothing but a MAC that holds moves it.

    A value is accepted if it is greater than the last one, and with a clock
    also within the authenticator's window about now. The clock is what refuses a recording
    to a receiver that has just started; without one only ``not_before`` does. It also
    completes freshness values of less than 7 bytes after a long silence, which
    without it are taken to be the next ones that end so.

    Args:
        authenticator: keys, clock and window.
        form: of the payloads.
    """

    def __init__(self, authenticator: Authenticator, form: SecuredForm) -> None:
        self._authenticator, self._form = authenticator, form
        #: Last freshness value accepted, by data ID [us].
        self.last_accepted: dict[int, int] = {}

    def __call__(self, data: bytes, data_id: int) -> bytes | Reason:
        """The authentic bytes of a payload: the record, padding, the key's number."""
        form, authenticator = self._form, self._authenticator
        if len(data) != form.length:
            return Reason.LENGTH
        authentic, rest = data[: form.authentic_bytes], data[form.authentic_bytes :]
        sent, mac = rest[: form.freshness_bytes], rest[form.freshness_bytes :]
        key = authenticator.key(authentic[-1])
        if key is None:
            return Reason.KEY
        last = self.last_accepted.get(data_id, authenticator.not_before)
        now = authenticator.now()
        floor = last if now is None else max(last, now - authenticator.window - 1)
        bits = 8 * form.freshness_bytes
        freshness = complete(int.from_bytes(sent, "big"), bits, floor)
        if not key.holds(mac, _authenticated(data_id, authentic, freshness)):
            # Never accepted, but an operator should know an old frame from a forged one.
            freshness -= 2**bits
            if freshness < 0 or not key.holds(mac, _authenticated(data_id, authentic, freshness)):
                return Reason.MAC
            return Reason.REPLAY if freshness <= last else Reason.AGE
        if now is not None and freshness > now + authenticator.window:
            return Reason.AGE
        self.last_accepted[data_id] = freshness
        return authentic


def complete(sent: int, bits: int, floor: int) -> int:
    """The least value above ``floor`` that ends in these bits (AUTOSAR's reconstruction).

    >>> [hex(complete(sent, 8, 0x1FE)) for sent in (0xFF, 0xFE, 0x00)]
    ['0x1ff', '0x2fe', '0x200']
    """
    value = floor >> bits << bits | sent
    return value if value > floor else value + (1 << bits)


def _authenticated(data_id: int, authentic: bytes, freshness: int) -> bytes:
    return (
        data_id.to_bytes(DATA_ID_BYTES, "big")
        + authentic
        + freshness.to_bytes(FRESHNESS_BYTES, "big")
    )


def _primitives() -> tuple[Any, Any]:
    try:
        from cryptography.hazmat.primitives.ciphers.algorithms import AES
        from cryptography.hazmat.primitives.cmac import CMAC
    except ImportError as error:
        raise MissingExtraError(
            'authentication needs cryptography: pip install "maplines_can[secoc]"'
        ) from error
    return AES, CMAC
