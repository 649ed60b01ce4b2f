"""Codec of map lines: what a DBC holds, and the objects for each job."""

from __future__ import annotations

from dataclasses import astuple
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..core import ffi, lib
from ..dbc_files.parser import default_dbc_path
from ..values.arrays import number_text
from .batch import BatchCodec
from .core_tables import LineTables, check_code
from .encoder import Encoder, conditional_error
from .frames import FrameWriter
from .layout.cholesky import CholeskyCode
from .layout.message_layout import Layout
from .layout.pose_layout import Owner
from .layout.slot_messages import MAX_MS
from .protection.e2e_state import E2EConfig
from .protection.secoc import Authenticator, Verifier
from .reception.decoder import Decoder

if TYPE_CHECKING:
    from ..dbc_files.parser import Database


@runtime_checkable
class LineCodec(Protocol):
    """What senders and receivers of lines need of a codec: a `Codec`, or one of the study."""

    @property
    def layout(self) -> Layout:
        """Of the records and their messages."""

    @property
    def authenticator(self) -> Authenticator | None:
        """Keys and clock; None without authentication."""

    @property
    def can_ids(self) -> frozenset[int]:
        """CAN IDs of all lines, for filters."""

    @property
    def resolution(self) -> NDArray[np.float64]:
        """(4,) variances of the mean's rounding error."""

    def of_layout(self, layout: Layout) -> LineCodec:
        """Return the codec of another layout, without a key."""

    def encoder(self) -> Encoder:
        """Return a new encoder."""

    def decoder(
        self,
        *,
        timeout_ms: float | None = None,
        cycle_ms: float | None = None,
        e2e: E2EConfig | None = None,
    ) -> Decoder:
        """Return a new decoder."""


class Codec:
    """Codec between map lines and CAN frames; all factors, ranges and bits are from a DBC.

    It has no state. ``batch`` is for arrays of lines, ``encoder()`` for a sender and ``decoder()``
    for a receiver; each of these two has a state of its own. A codec can be pickled, for another
    process; one with an authenticator cannot, since that would write its keys.

    The covariance is never overconfident. Let S be the covariance that was given, d the error of
    the decoded mean, and S' the decoded covariance. Unless the status is OUT_OF_RANGE, S' is
    positive definite and S' - (S + d d^T) is positive semidefinite. With the requested status
    DIAGONAL, S is the given covariance without its correlations, so those are not covered.

    Args:
        layout: from ``Layout.from_dbc``; most callers use ``Codec.from_dbc``.
        authenticator: keys and clock. With it, the codec sends authenticated frames only, and its
            decoders accept no others. None for a bus without authentication.

    Raises:
        LayoutError: the covariance code is unknown, or there is an authenticator but the DBC has
            no authenticated message, or its freshness value is too short.
        TypeError: ``authenticator`` is something else, such as a key.

    >>> codec = Codec.from_dbc()
    >>> payload = codec.batch.encode([[1.75, 0, 0, 0]], [np.diag([0.01, 1e-4, 1e-8, 1e-12])])
    >>> payload.shape, payload.dtype
    ((1, 32), dtype('uint8'))
    >>> batch = codec.batch.decode(payload)
    >>> batch.accepted, batch.mean[0, 0], np.sqrt(batch.cov[0, 0, 0]).round(3)
    (array([ True]), np.float64(1.75), np.float64(0.102))
    """

    def __init__(self, layout: Layout, authenticator: Authenticator | None = None) -> None:
        self.layout = layout
        self.authenticator: Authenticator | None = None
        if not isinstance(authenticator, Authenticator | None):
            strange = type(authenticator).__name__
            del authenticator  # it may be a secret
            raise TypeError(
                f"authenticator must be an Authenticator, or None, got a {strange}; "
                "Authenticator(key, clock=time.time_ns) makes one of a Key"
            )
        self.authenticator = authenticator
        check_code(layout)
        self._tables = LineTables.of(layout)
        self._frame_writer = FrameWriter(layout, authenticator)

    @classmethod
    def from_dbc(
        cls,
        dbc: str | Path | Database | None = None,
        authenticator: Authenticator | None = None,
        *,
        encoding: str | None = None,
    ) -> Codec:
        """Return the codec of a DBC file, or of a database that cantools has loaded from one.

        By default, the DBC is the project's ``maplines.dbc``, or ``maplines-secoc.dbc`` with an
        authenticator. Its encoding is found, or stated, as in ``Layout.from_dbc``.

        Raises:
            LayoutError: the file is missing, or the DBC does not describe a map line; the message
                names the signal or message and what it needs.
            TypeError: ``dbc`` or ``authenticator`` is of another class.

        >>> database = cantools.database.load_file("dbc/maplines.dbc")  # doctest: +SKIP
        >>> Codec.from_dbc(database)  # doctest: +SKIP
        <Codec of the cantools database: Cholesky>
        """
        if dbc is None and authenticator is not None:
            dbc = default_dbc_path("maplines-secoc.dbc")
        try:
            return cls(Layout.from_dbc(dbc, encoding=encoding), authenticator)
        finally:
            del authenticator  # a traceback may show the locals

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.layout, self.authenticator)

    def __repr__(self) -> str:
        secured = "" if self.authenticator is None else ", authenticated"
        return f"<Codec of {self.layout.source}: {self.layout.covariance_code}{secured}>"

    @property
    def can_ids(self) -> frozenset[int]:
        """CAN IDs of all lines, for filters."""
        return self.layout.can_ids

    @property
    def resolution(self) -> NDArray[np.float64]:
        """(4,) variances of the mean's rounding error, factor^2 / 12, in SI units squared."""
        return self.layout.resolution

    @cached_property
    def covariance(self) -> CholeskyCode:
        """Code of the covariance of a line.

        Raises:
            LayoutError: the records are whole scenes, whose lines have no code of their own.
        """
        return CholeskyCode(self.layout)

    @cached_property
    def batch(self) -> BatchCodec:
        """Arrays of lines to records and back, without any state.

        Raises:
            EncodeError: the records are conditional on the pose error.
        """
        if self.layout.is_conditional:
            raise conditional_error(self.layout)
        return BatchCodec(partial(getattr, self, "batch"), self.layout, self._tables)

    def of_layout(self, layout: Layout) -> Codec:
        """Return the codec of another layout, without a key."""
        return Codec(layout)

    def encoder(self) -> Encoder:
        """Return a new encoder, which holds the counters of a sender."""
        return Encoder(self.encoder, self.layout, self._tables, self._frame_writer)

    def decoder(
        self,
        *,
        timeout_ms: float | None = None,
        cycle_ms: float | None = None,
        e2e: E2EConfig | None = None,
    ) -> Decoder:
        """Return a new decoder, which holds the state of a receiver.

        Args:
            timeout_ms: longest time between the frames of a transfer, and between the components
                of a mixture [ms]. The default is shorter than the time after which transfer IDs
                repeat: 1.5 cycles, at least half a cycle of the DBC, and at most an hour; 75 ms
                with ``maplines.dbc``.
                ``model/reassembly.py`` describes the effect of a longer one.
            cycle_ms: cycle time of the lines of a slot [ms], for the E2E state, stale and late
                lines, and the default of ``timeout_ms``; by default the slot's cycle time in the
                DBC, or 100 ms.
            e2e: windows and bounds of the E2E state machines.

        Raises:
            ValueError: a time is 0 or less, or more than an hour; or ``e2e`` does not fit the
                DBC's counter.
        """
        layout, authenticator = self.layout, self.authenticator
        verifiers: dict[Owner, Verifier] = {}
        if authenticator is not None:
            secured = {owner: layout.record_of(owner).secured for owner in layout.messages_of}
            verifier = {own: Verifier(authenticator, own) for own in secured.values() if own}
            verifiers = {owner: verifier[own] for owner, own in secured.items() if own}
        settings = decoder_settings(layout, self._tables.dbc, timeout_ms, cycle_ms, e2e)
        return Decoder(layout, self._tables.dbc, verifiers, settings)


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
