"""Keys, clocks and authenticated frames, for tests of authentication."""

import traceback
from pathlib import Path
from typing import Any

from answers import one
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from support.dbcs import new_codec

from maplines_can import MapLine
from maplines_can.wire import Authenticator, Key
from maplines_can.wire.layout.slot_messages import SecuredLayout

SECRET = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")  # of RFC 4493
OTHER = bytes.fromhex("603deb1015ca71be2b73aef0857d7781")
LAYOUT = SecuredLayout(length=48, freshness_bytes=7, mac_bytes=8)
US, MS, S = 1_000, 1_000_000, 1_000_000_000
NOW = 1_750_000_000 * S


class Clock:
    """Clock that a test sets [ns]."""

    def __init__(self, now: Any = NOW) -> None:
        self.now = now

    def __call__(self) -> Any:
        return self.now


def codec_of(*keys: Any, clock: Any = None, **rest: Any) -> Any:
    return new_codec(Authenticator(*(keys or (Key(SECRET),)), clock=clock, **rest))


def feed(decoder: Any, frames: Any, t_ns: Any = NOW, step_ns: Any = 50 * MS) -> Any:
    """Return the answers to frames, a period apart."""
    return [one(decoder.feed(f.can_id, f.data, t_ns + i * step_ns)) for i, f in enumerate(frames)]


def names(answers: Any) -> Any:
    return ["line" if isinstance(answer, MapLine) else answer.name for answer in answers]


def sent(encoder: Any, clock: Any, line: Any, n: Any, step_ns: Any = 50 * MS) -> Any:
    """Return n frames of a line, a period apart."""
    frames = []
    for _ in range(n):
        frames += encoder.encode(line, fd=True)
        clock.now += step_ns
    return frames


AES_256 = OTHER + bytes.fromhex("1f352c073b6108d72d9810a30914dff4")


def reference_cmac(secret: Any, data: Any) -> Any:
    """RFC 4493 figures 2.2 and 2.3, from AES of single blocks."""

    def aes(block: Any) -> Any:
        encryptor = Cipher(algorithms.AES(secret), modes.ECB()).encryptor()  # noqa: S305 - single blocks
        return encryptor.update(block) + encryptor.finalize()

    def doubled(number: Any) -> Any:
        return (number << 1) % 2**128 ^ (0x87 if number >> 127 else 0)

    k1 = doubled(int.from_bytes(aes(bytes(16)), "big"))
    blocks = [data[i : i + 16] for i in range(0, len(data), 16)] or [b""]
    last, k = (blocks[-1], k1) if len(blocks[-1]) == 16 else (blocks[-1] + b"\x80", doubled(k1))
    last = int.from_bytes(last.ljust(16, b"\0"), "big") ^ k
    x = bytes(16)
    for block in [*blocks[:-1], last.to_bytes(16, "big")]:
        x = aes((int.from_bytes(x, "big") ^ int.from_bytes(block, "big")).to_bytes(16, "big"))
    return x


def key_file(tmp_path: Path, text: Any, mode: int = 0o600) -> Any:
    path = tmp_path / "car.key"
    path.write_bytes(text)
    path.chmod(mode)
    return path


def check_no_secret(text: Any) -> None:
    """Check for eight digits of the secret in a row, and for its bytes as Python prints them."""
    lowered = text.lower()
    for i in range(len(SECRET.hex()) - 7):
        assert SECRET.hex()[i : i + 8] not in lowered
    assert repr(SECRET)[2:-1] not in text
    assert str(list(SECRET))[1:-1] not in text


def check_traceback(error: Any) -> None:
    text = whole_traceback(error)
    assert "path = " in text or "monkeypatch = " in text  # locals are there
    assert "repr() failed" not in text
    check_no_secret(text)


def whole_traceback(error: Any) -> Any:
    report = traceback.TracebackException.from_exception(error, capture_locals=True)
    return "".join(report.format())
