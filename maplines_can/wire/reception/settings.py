"""Settings of a decoder: time-outs, cycle times and E2E windows, by default those of the DBC."""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

from ...core import ffi, lib
from ...values.arrays import number_text
from ..layout.message_layout import Layout
from ..layout.slot_messages import MAX_MS
from ..protection.e2e_state import E2EConfig


def decoder_settings(
    layout: Layout,
    tables: Any,
    timeout_ms: float | None = None,
    cycle_ms: float | None = None,
    e2e: E2EConfig | None = None,
) -> Any:
    """Return a ``maplines_settings_t *`` for the tables of a DBC; see ``Codec.decoder``."""
    for name, value in (("timeout_ms", timeout_ms), ("cycle_ms", cycle_ms)):
        if value is not None and not 0 < value <= MAX_MS:
            raise ValueError(
                f"{name} must be more than 0 ms and at most an hour ({MAX_MS} ms), "
                f"got {number_text(value)}"
            )
    modulus = 2 ** (layout.scene or layout)["Counter"].length
    if e2e is not None and e2e.max_delta_counter >= modulus // 2:
        raise ValueError(
            f"max_delta_counter must be less than {modulus // 2}, half the counter modulus of "
            f"{layout.source}, got {e2e.max_delta_counter}"
        )
    settings = ffi.new("maplines_settings_t *")
    windows = ffi.NULL if e2e is None else ffi.new("maplines_e2e_config_t *", astuple(e2e))
    given = timeout_ms or 0.0, cycle_ms or 0.0, windows
    problem = lib.maplines_settings_for(tables, *given, settings)
    if problem != ffi.NULL:
        raise ValueError(ffi.string(problem).decode())
    return settings
