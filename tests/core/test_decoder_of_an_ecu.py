"""What an ECU may ask of a decoder that Python never does: mistakes, and clocks before 1970."""

from __future__ import annotations

from typing import Any

import pytest

from maplines_can import Slot
from maplines_can.core import ffi, lib
from maplines_can.model import writer
from maplines_can.model.matrices import Vector, matrix
from maplines_can.testing.ecu_streams import signed, write_mac
from maplines_can.wire import Layout, default_dbc_path
from maplines_can.wire.core_tables import tables_of

SECURED = Layout.from_dbc(default_dbc_path("maplines-secoc.dbc"))
NODATA, NONE = lib.MAPLINES_E2E_NODATA, lib.MAPLINES_E2E_NONE


class Ecu:
    """A decoder of an ECU, with its settings and a clock."""

    def __init__(self, layout: Layout = SECURED, **settings: Any) -> None:
        self.layout, self.now_us = layout, 0
        self.decoder = ffi.new("maplines_decoder_t *")
        self._dbc, self._settings = tables_of(layout), ffi.new("maplines_settings_t *")
        lib.maplines_default_settings(self._dbc, self._settings)
        for name, value in settings.items():
            setattr(self._settings, name, value)

    def authenticate(self, window_us: int, not_before_us: int = 0) -> Ecu:
        """Require frames with a MAC of ``write_mac``, within a window about the clock."""
        mac = "bool(void *, uint8_t, const uint8_t *, size_t, uint8_t *)"
        self._kept = (
            ffi.callback(mac, write_mac),
            ffi.callback("int64_t(void *)", lambda _: self.now_us),
        )
        self._authenticator = ffi.new("maplines_authenticator_t *")
        self._authenticator.mac, self._authenticator.now_us = self._kept
        self._authenticator.window_us = window_us
        self._authenticator.not_before_us = not_before_us
        self._settings.authenticator = self._authenticator
        return self

    def start(self) -> str | None:
        """Start the decoder; return what is wrong."""
        problem = lib.maplines_decoder_init(self.decoder, self._dbc, self._settings)
        return ffi.string(problem).decode() if problem else None

    def feed(self, can_id: int, data: bytes, *, is_extended: bool = False) -> str:
        """Return the reason of a frame."""
        frame = ffi.new("maplines_frame_t *", {"can_id": can_id, "is_extended": is_extended})
        frame.length = len(data)
        ffi.buffer(frame.data)[: len(data)] = data
        fed = lib.maplines_feed(self.decoder, frame, 0)
        return ffi.string(lib.maplines_reason_name(fed.reason)).decode()

    def feed_signed(self, time_us: int, key_id: int = 1) -> str:
        """Return the reason of an authenticated frame of a line, with a freshness value."""
        slot = Slot.EGO_LEFT
        cov = [[float(i == j) * 1e-6 for j in range(4)] for i in range(4)]
        line = writer.Draft(slot, Vector([0.0] * 4), matrix(cov), x_max=50.0)
        messages = self.layout.messages[slot]
        assert self.layout.secured is not None
        record = writer.write(self.layout, line, 0)
        can_id, is_extended, _, data = signed(
            self.layout.secured, messages, record, key_id, time_us
        )
        return self.feed(can_id, data, is_extended=is_extended)


@pytest.fixture
def wrong() -> Ecu:
    """A decoder whose settings are refused."""
    ecu = Ecu(stale_cycles=-1.0)
    assert ecu.start() == "stale_cycles must be 0 or more"
    return ecu


def test_a_decoder_with_wrong_settings_takes_no_frame(wrong: Ecu) -> None:
    """It has no line, no scene, no state, and counts frames as foreign."""
    view, scene = ffi.new("maplines_view_t *"), ffi.new("maplines_scene_view_t *")
    numbers = ffi.new("maplines_statistics_t *")
    stats = ffi.new("maplines_slot_stats_t *")
    assert wrong.feed(wrong.layout.messages[Slot.EGO_LEFT].can_id or 0, bytes(8)) == "FOREIGN"
    lib.maplines_expire(wrong.decoder, 10**9)
    lib.maplines_latest(wrong.decoder, 0, 0, view)
    lib.maplines_latest_scene(wrong.decoder, 0, scene)
    lib.maplines_statistics(wrong.decoder, numbers)

    assert (view.line, view.state, view.status) == (ffi.NULL, NODATA, NONE)
    assert view.is_stale
    assert not view.is_usable
    assert (scene.scene, scene.state, scene.is_usable) == (ffi.NULL, NODATA, False)
    assert (numbers.frames, numbers.counts[lib.MAPLINES_FOREIGN], numbers.pending) == (1, 1, 0)
    assert not lib.maplines_slot_stats(wrong.decoder, 0, 0, stats)
    assert not lib.maplines_slot_stats(wrong.decoder, lib.MAPLINES_POSE, 0, stats)
    assert lib.maplines_newest(wrong.decoder, 0) == ffi.NULL


def test_a_decoder_restarts_with_its_own_settings() -> None:
    """They are copied before it is cleared."""
    decoder, dbc = ffi.new("maplines_decoder_t *"), tables_of(Layout.from_dbc())
    settings = ffi.new("maplines_settings_t *")
    lib.maplines_default_settings(dbc, settings)
    settings.stale_cycles = 7.0
    for given in (settings, ffi.addressof(decoder, "settings")):
        assert not lib.maplines_decoder_init(decoder, dbc, given)
        assert decoder.settings.stale_cycles == 7.0


@pytest.mark.parametrize("slot", [8, 9, 2**32 - 1])
def test_a_number_that_is_no_slot_has_no_line(slot: int) -> None:
    ecu = Ecu(Layout.from_dbc())
    gaussian, weight = ffi.new("maplines_gaussian_t *"), ffi.new("maplines_real_t *")
    assert ecu.start() is None
    assert lib.maplines_newest(ecu.decoder, slot) == ffi.NULL
    assert not lib.maplines_component(ecu.decoder, slot, 0, gaussian, weight)


@pytest.mark.parametrize(
    ("now_us", "window_us", "time_us", "reason"),
    [
        (-10, 5, 1, "AGE"),  # the window ends before 1970
        (-10, 15, 5, "COMPLETE"),
        (-10, 15, 6, "AGE"),
        (0, 15, 15, "COMPLETE"),
        (0, 15, 16, "AGE"),
        (10**15, 10**6, 10**15 + 10**6, "COMPLETE"),
        (10**15, 10**6, 10**15 + 10**6 + 1, "AGE"),
        (10**15, 10**6, 10**15 - 10**6, "COMPLETE"),
    ],
)
def test_freshness_values_are_within_the_window_about_any_clock(
    now_us: int, window_us: int, time_us: int, reason: str
) -> None:
    ecu = Ecu().authenticate(window_us)
    ecu.now_us = now_us
    assert ecu.start() is None
    assert ecu.feed_signed(time_us) == reason


def test_a_freshness_value_of_more_than_63_bits_is_of_no_age() -> None:
    """A sender has none, though its MAC may be right."""
    ecu = Ecu().authenticate(10**6, not_before_us=2**63 - 1)
    ecu.now_us = 2**63 - 1
    assert ecu.start() is None
    assert ecu.feed_signed(2**63 + 5) == "AGE"
    assert ecu.feed_signed(2**63 - 1) == "REPLAY"
