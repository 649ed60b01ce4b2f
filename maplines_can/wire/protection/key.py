"""Keys for AES-CMAC (RFC 4493)."""

from __future__ import annotations

import hmac
import re
from typing import Any

from ...values.errors import KeyMaterialError, missing_extra

#: Bytes of the secrets of AES-128 and AES-256.
SECRET_BYTES = (16, 32)
#: An integer of at least this magnitude may be a secret.
MIN_SECRET_NUMBER = 2**64


def shown(value: object) -> str:
    """Return a wrong argument as text for an error message, or only its type if it may be a secret.

    >>> shown(300), shown(-0.5), shown(None), shown("2b7e1516"), shown(2**100)
    ('300', '-0.5', 'None', 'a str', 'an int of 101 bits')
    """
    if isinstance(value, int) and abs(value) >= MIN_SECRET_NUMBER:
        return f"an int of {value.bit_length()} bits"
    return repr(value) if isinstance(value, int | float | None) else f"a {type(value).__name__}"


class Key:
    """Secret key for AES-CMAC, with the key ID that identifies it on the bus.

    Python never shows the secret. ``repr`` has the key ID and a fingerprint, which distinguishes
    two keys and reveals nothing of either. Neither an error message nor the locals in a traceback
    of this package contain the secret.

    Args:
        secret: 16 or 32 random bytes; for hex digits, see ``from_hex``.
        key_id: key ID on the bus, 0 to 255.

    Raises:
        KeyMaterialError: the secret is not bytes, is too short or too long, consists of hex
            digits, or is one byte repeated; or the key ID is not an integer from 0 to 255.
        MissingExtraError: the package cryptography is not installed.

    >>> Key(bytes(range(16)), key_id=7)
    Key(key_id=7, fingerprint='78ad15')
    >>> Key.from_hex("00ff", source="the file")
    Traceback (most recent call last):
    ...
    maplines_can.values.errors.KeyMaterialError: the file must hold 32 or 64 hex digits (AES-128 \
or AES-256), got 4 characters
    """

    __slots__ = ("_base", "_check", "fingerprint", "key_id")

    def __init__(self, secret: bytes, key_id: int = 1) -> None:
        self.key_id, self.fingerprint = -1, "none"  # for the repr of a rejected key in a traceback
        try:
            if not (isinstance(key_id, int) and 0 <= key_id <= 255):
                raise KeyMaterialError(
                    f"key_id must be a whole number from 0 to 255, got {shown(key_id)}"
                )
            if not isinstance(secret, bytes | bytearray | memoryview):
                raise KeyMaterialError(
                    f"a key must be bytes, got a {type(secret).__name__}; Key.from_hex reads hex "
                    "digits"
                )
            if re.fullmatch(rb"[0-9A-Fa-f]{16,}", bytes(secret).strip()):
                raise KeyMaterialError(
                    f"a key must be random bytes; these {len(secret)} are all hex digits, which "
                    "Key.from_hex reads"
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
            del secret, key_id  # a traceback may show the locals
        self._check = self.mac(b"maplines_can")  # shorter than any data that is sent
        self.fingerprint = self._check[:3].hex()

    @classmethod
    def from_hex(cls, text: str, key_id: int = 1, source: str = "a key") -> Key:
        """Return the key of hex digits; surrounding white space is ignored.

        Args:
            text: hex digits of the secret.
            key_id: see ``Key``.
            source: name of the key in error messages, which never contain the text.

        Raises:
            KeyMaterialError: the text is not 32 or 64 hex digits; or as ``Key``.
            MissingExtraError: the package cryptography is not installed.
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
            del text, key_id  # a traceback may show the locals

    def mac(self, data: bytes) -> bytes:
        """Return the full AES-CMAC of the data, 16 bytes."""
        cmac = self._base.copy()  # four times as fast as a new one
        cmac.update(data)
        return bytes(cmac.finalize())

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
        raise TypeError(
            "a Key cannot be pickled or copied, since that would write its secret; read it in each "
            "process, such as with key_from_file"
        )


def _primitives() -> tuple[Any, Any]:
    try:
        from cryptography.hazmat.primitives.ciphers.algorithms import AES
        from cryptography.hazmat.primitives.cmac import CMAC
    except ImportError as error:
        raise missing_extra("authentication needs cryptography", "secoc") from error
    return AES, CMAC
