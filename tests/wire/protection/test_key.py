"""Keys for AES-CMAC: published vectors, and no secret in any text."""

import pickle
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.secoc_streams import (
    AES_256,
    LAYOUT,
    SECRET,
    check_no_secret,
    check_traceback,
    codec_of,
    key_file,
    reference_cmac,
    whole_traceback,
)

from maplines_can.bus import key_from_env, key_from_file
from maplines_can.values.errors import EncodeError, KeyMaterialError, MissingExtraError
from maplines_can.wire import Authenticator, Key

# ---- the MAC ---------------------------------------------------------------------

#: RFC 4493 section 4 has AES-128, NIST SP 800-38B appendix D.3 AES-256; the messages are the same.
MESSAGE = bytes.fromhex(
    "6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e51"
    "30c81c46a35ce411e5fbc1191a0a52eff69f2445df4f9b17ad2b417be66c3710"
)


@pytest.mark.parametrize(
    ("secret", "length", "mac"),
    [
        (SECRET, 0, "bb1d6929e95937287fa37d129b756746"),
        (SECRET, 16, "070a16b46b4d4144f79bdd9dd04a287c"),
        (SECRET, 40, "dfa66747de9ae63030ca32611497c827"),
        (SECRET, 64, "51f0bebf7e3b9d92fc49741779363cfe"),
        (AES_256, 0, "028962f61b7bf89efc6b551f4667d983"),
        (AES_256, 16, "28a7023f452e8f82bd4bf28d8c37c35c"),
        (AES_256, 40, "aaf3d8f1de5640c232f5b169b9c911e6"),
        (AES_256, 64, "e1992190549f6ed5696a2c056c315410"),
    ],
)
def test_the_published_vectors(secret: Any, length: int, mac: str) -> None:
    """RFC 4493 and NIST SP 800-38B, twice each, because a key is used repeatedly."""
    key = Key.from_hex(secret.hex())
    assert [key.mac(MESSAGE[:length]).hex() for _ in range(2)] == [mac, mac]
    assert reference_cmac(secret, MESSAGE[:length]).hex() == mac


def test_no_text_of_an_object_contains_the_key(clock: Any, lines: Any) -> None:
    """Not repr, str, vars, pickle, or a traceback with all locals."""
    key = Key(SECRET)
    codec = codec_of(key, clock=clock)
    for thing in (
        key,
        codec.authenticator,
        codec,
        codec.decoder(),
        *codec.decoder().verifiers.values(),
    ):
        check_no_secret(f"{thing!r} {thing} {getattr(thing, '__dict__', '')} {dir(thing)}")
    assert repr(key) == f"Key(key_id=1, fingerprint='{key.fingerprint}')"
    with pytest.raises(TypeError, match="cannot be pickled"):
        pickle.dumps(key)
    try:
        codec.encoder().encode(lines[0])
    except EncodeError as error:
        check_no_secret(whole_traceback(error))


WRONG: list[tuple[Callable[[Path], Any], str]] = [
    (lambda _: key_from_env("CAR_KEY_AND_MORE"), "32 or 64 hex digits .* 33 characters"),
    (lambda path: key_from_file(path.with_suffix(".bad")), "32 or 64 hex digits .* 34 characters"),
    (lambda path: key_from_file(path, 300), "key_id must be .*, got 300"),
    (lambda _: key_from_env("CAR_KEY", "1"), "key_id must be .*, got a str"),  # type: ignore[arg-type]
    (lambda _: Key.from_hex(SECRET.hex(), None), "key_id must be .*, got None"),  # type: ignore[arg-type]
    (lambda _: Key(1, SECRET), "key_id must be .*, got a bytes"),  # type: ignore[arg-type]
    (lambda _: Key(SECRET[:15]), "must have 16 or 32 bytes .* got 15"),
    (lambda _: Key(list(SECRET)), "must be bytes, got a list"),  # type: ignore[arg-type]
    (lambda _: Key(SECRET.hex()), r"must be bytes, got a str; Key\.from_hex reads hex digits"),  # type: ignore[arg-type]
    (lambda _: Key.from_hex(SECRET), "a key must be text of hex digits, got a bytes"),  # type: ignore[arg-type]
    (lambda _: Authenticator(SECRET), "must be of the class Key, got a bytes"),  # type: ignore[arg-type]
    (lambda _: Authenticator(Key(SECRET)).add(SECRET), "must be of the class Key, got a bytes"),  # type: ignore[arg-type]
    (lambda _: Key(SECRET.hex().encode()), "all hex digits"),
    (lambda _: Key(1, int.from_bytes(SECRET)), "key_id must be .*, got an int of 126 bits"),  # type: ignore[arg-type]
    (lambda _: key_from_file(SECRET.hex()), "."),
    (lambda _: key_from_env(SECRET.hex()), "."),
    (lambda _: Key(bytes(16)), "a single byte repeated"),
    (lambda _: Key(SECRET, -1), "from 0 to 255, got -1"),
    (lambda _: Key(SECRET, 256), "from 0 to 255, got 256"),
]


@pytest.mark.parametrize(("act", "words"), WRONG)
def test_no_traceback_of_an_invalid_key_contains_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: Any, words: str
) -> None:
    """Not even with the locals of every frame of this package; the message has the cure."""
    monkeypatch.setenv("CAR_KEY", SECRET.hex())
    monkeypatch.setenv("CAR_KEY_AND_MORE", SECRET.hex() + "0")
    path = key_file(tmp_path, SECRET.hex().encode())
    path.with_suffix(".bad").write_bytes(SECRET.hex().encode() + b"zz")
    path.with_suffix(".bad").chmod(0o600)
    with pytest.raises((KeyMaterialError, TypeError), match=words) as caught:
        act(path)
    check_traceback(caught.value)


def test_no_traceback_without_cryptography_contains_a_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The key has been read by then; the message has the command that installs the extra."""
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.cmac", None)
    monkeypatch.setenv("CAR_KEY", SECRET.hex())
    path = key_file(tmp_path, SECRET.hex().encode())
    for act in (lambda: key_from_env("CAR_KEY"), lambda: key_from_file(path), lambda: Key(SECRET)):
        with pytest.raises(MissingExtraError, match=r'pip install -e "\.\[secoc\]"') as caught:
            act()  # type: ignore[no-untyped-call]
        check_traceback(caught.value)


SECRETS = [SECRET, bytearray(SECRET), SECRET.hex(), int.from_bytes(SECRET), list(SECRET)]


@pytest.mark.parametrize("secret", SECRETS, ids=lambda secret: type(secret).__name__)
@pytest.mark.parametrize(
    "act",
    [
        pytest.param(lambda s: Authenticator(Key(SECRET)).use(s), id="use"),
        pytest.param(lambda s: Authenticator(Key(SECRET)).retire(s), id="retire"),
        pytest.param(lambda s: Authenticator(Key(SECRET), not_before=s), id="not_before"),
        pytest.param(lambda s: Authenticator(Key(SECRET), clock=s), id="clock"),
        pytest.param(lambda s: Authenticator(Key(SECRET), clock=lambda: [s]), id="of-the-clock"),  # type: ignore[arg-type, return-value]
        pytest.param(lambda s: Authenticator(Key(SECRET), window_ns=[s]), id="window_ns"),  # type: ignore[arg-type]
        pytest.param(lambda s: Key(SECRET, s), id="key_id"),
        pytest.param(lambda s: Authenticator(s), id="key"),
    ],
)
def test_item_10_a_secret_in_the_wrong_place_is_not_repeated(
    act: Any, secret: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither by the message nor by the locals of a traceback: bytes, hex digits or a number."""
    with pytest.raises((KeyMaterialError, TypeError, ValueError)) as caught:
        act(secret)
    check_no_secret(str(caught.value))
    number = str(int.from_bytes(SECRET))
    assert number not in str(caught.value)
    assert str(list(SECRET)) not in str(caught.value)
    frames = [
        frame
        for frame in traceback.TracebackException.from_exception(
            caught.value, capture_locals=True
        ).stack
        if "maplines_can" in frame.filename
    ]
    assert frames
    texts = " ".join(str(frame.locals) for frame in frames if "tests" not in frame.filename)
    check_no_secret(texts)
    assert number not in texts


@pytest.mark.parametrize("text", [SECRET.hex(), AES_256.hex(), SECRET.hex().upper(), "5" * 16])
@pytest.mark.parametrize("end", ["", "\n"])
def test_item_10_hex_digits_in_bytes_are_no_key(text: str, end: str) -> None:
    """32 hex digits have the length of an AES-256 key; their writer meant an AES-128 key."""
    with pytest.raises(KeyMaterialError, match=r"all hex digits, which Key\.from_hex reads"):
        Key((text + end).encode())


@pytest.mark.parametrize("length", [0, 15, 17, 31, 33])
def test_a_key_has_16_or_32_bytes(length: int) -> None:
    """And twice as many hex digits."""
    with pytest.raises(KeyMaterialError, match=f"16 or 32 bytes .*, got {length}$"):
        Key(AES_256[:1].ljust(length, b"\xff") if length else b"")
    digits = (2 * length + 1) * "5"
    with pytest.raises(KeyMaterialError, match=f"32 or 64 hex digits .* {len(digits)} characters$"):
        Key.from_hex(digits)


def test_hex_digits_may_have_space_around_them_and_not_within() -> None:
    """A file ends with a new line."""
    assert Key.from_hex(f" {SECRET.hex()}\n", 7) == Key(SECRET, 7)
    with pytest.raises(KeyMaterialError, match="got 32 characters, not all of them hex digits"):
        Key.from_hex(f"{SECRET.hex()[:15]} {SECRET.hex()[16:]}")


@pytest.mark.parametrize("most", [0, 2**63 - 1])
def test_a_freshness_value_at_the_ends_of_its_range(most: int) -> None:
    """``not_before`` may be either; after the greatest one, nothing can be sent."""
    keys = Authenticator(Key(SECRET), clock=lambda: 1000 * (2**63 - 1), not_before=most)
    if most:
        with pytest.raises(EncodeError, match="freshness must be"):
            keys.secure(bytes(32), 1, LAYOUT)
    else:
        assert len(keys.secure(bytes(32), 1, LAYOUT)) == LAYOUT.length
        assert keys.last_sent == 2**63 - 1


def test_the_ends_of_key_ids_and_of_windows() -> None:
    assert [Key(SECRET, key_id).key_id for key_id in (0, 255)] == [0, 255]
    assert Authenticator(Key(SECRET), window_ns=1000).window == 1
    assert Authenticator(Key(SECRET), window_ns=1999).window == 1
