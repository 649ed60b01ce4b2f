"""Keys from files and from the environment."""

import os
import traceback
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.secoc_streams import AES_256, OTHER, SECRET, check_no_secret, key_file

from maplines_can.bus import key_from_env, key_from_file
from maplines_can.values.errors import KeyMaterialError
from maplines_can.wire import Codec, Key

HEX = SECRET.hex()


@pytest.mark.parametrize("text", [SECRET.hex(), f"\n {SECRET.hex().upper()}\r\n", AES_256.hex()])
def test_a_key_from_a_file_and_from_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: Any
) -> None:
    """Hex digits in either case, and with the newline that an editor adds."""
    monkeypatch.setenv("CAR_KEY", text)
    key = key_from_file(key_file(tmp_path, text.encode()), key_id=7)
    assert key == key_from_env("CAR_KEY", 7) == Key(bytes.fromhex(text.strip()), 7)
    assert len({key, key_from_env("CAR_KEY", 7)}) == 1
    assert key != key_from_env("CAR_KEY", 8)
    assert key != Key(OTHER, 7)
    assert key != text


@pytest.mark.parametrize(
    ("text", "mode", "message"),
    [
        (SECRET.hex()[:-1].encode(), 0o600, "must hold 32 or 64 hex digits .* got 31 characters$"),
        (SECRET.hex().encode() + b"0" * 16, 0o600, "got 48 characters$"),
        (b"", 0o600, "got 0 characters$"),
        (SECRET.hex()[:-1].encode() + b"g", 0o600, "32 characters, not all of them hex digits$"),
        (SECRET, 0o600, "not all of them hex digits$"),
        (SECRET.hex().encode(), 0o604, r"everybody .* \(mode 0604\); chmod 600"),
        (SECRET.hex().encode(), 0o644, r"everybody .* \(mode 0644\); chmod 600"),
    ],
)
def test_an_invalid_key_file_raises(tmp_path: Path, text: Any, mode: int, message: str) -> None:
    """The message names the file and what is wrong, but not its content."""
    path = key_file(tmp_path, text, mode)
    with pytest.raises(KeyMaterialError, match=message) as caught:
        key_from_file(path)
    assert str(path) in str(caught.value)
    check_no_secret(str(caught.value))


@pytest.mark.parametrize(("name", "mode", "allowed"), [
    ("posix", 0o640, True), ("posix", 0o604, False), ("nt", 0o666, True),
])  # fmt: skip
def test_who_may_read_a_key_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, mode: int, allowed: bool
) -> None:
    """A group may; on Windows the mode says nothing about who can."""
    path = key_file(tmp_path, HEX.encode(), mode)
    monkeypatch.setattr("maplines_can.bus.keys.os", SimpleNamespace(name=name, path=os.path))
    if allowed:
        assert key_from_file(path) == Key(SECRET, 1)
    else:
        with pytest.raises(KeyMaterialError, match="everybody"):
            key_from_file(path)


def test_a_missing_key_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no such file, or no such variable."""
    monkeypatch.delenv("CAR_KEY", raising=False)
    with pytest.raises(KeyMaterialError, match=r"none\.key: cannot be read: No such file"):
        key_from_file(tmp_path / "none.key")
    with pytest.raises(KeyMaterialError, match="environment variable CAR_KEY is not set"):
        key_from_env("CAR_KEY")


def test_an_existing_file_or_variable_may_look_like_a_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its name may consist of hex digits."""
    path = key_file(tmp_path, HEX.encode()).rename(tmp_path / f"{OTHER.hex()}.key")
    monkeypatch.setenv("F47AC10B58CC4372A5670E02", HEX)
    assert key_from_file(path) == key_from_env("F47AC10B58CC4372A5670E02") == Key(SECRET)


def _reads_a_key(path: Path, wrong: Any) -> list[Callable[[], object]]:
    """Calls with a secret in the place of another argument."""
    return [
        lambda: key_from_file(wrong),
        lambda: key_from_env(wrong),
        lambda: key_from_file(path, wrong),
        lambda: key_from_file(path.with_name("none"), wrong),
        lambda: key_from_env("HOME", wrong),
        lambda: Key.from_hex(HEX, wrong),
        lambda: Codec.from_dbc(None, wrong),
        lambda: Codec(Codec.from_dbc().layout, wrong),
    ]


@pytest.mark.parametrize("wrong", [HEX, HEX.encode(), SECRET, bytearray(SECRET)])
@pytest.mark.parametrize("call", range(8))
def test_no_argument_shows_a_secret(tmp_path: Path, call: int, wrong: Any) -> None:
    """Neither the error nor a local variable of the package in its traceback."""
    path = key_file(tmp_path, HEX.encode())
    with pytest.raises((KeyMaterialError, TypeError), match=r"must|cannot|looks like") as caught:
        _reads_a_key(path, wrong)[call]()
    check_no_secret(str(caught.value))
    for frame, _ in traceback.walk_tb(caught.tb):
        if "maplines_can" in frame.f_globals.get("__name__", ""):
            check_no_secret(repr(list(frame.f_locals.values())))


def test_a_key_is_no_authenticator() -> None:
    """The error says how to make one of it."""
    with pytest.raises(TypeError, match=r"got a Key; Authenticator\(key, clock=time.time_ns\)"):
        Codec.from_dbc(None, Key(SECRET))  # type: ignore[arg-type]
