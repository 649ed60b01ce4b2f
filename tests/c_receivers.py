"""The receivers in Python and in C, side by side: the same frames and questions, byte for byte."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields
from pathlib import Path
from typing import Any

import c_core
import numpy as np

from maplines_can.values.fixed_order import cholesky
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import POSE, Authenticator, Codec, E2EConfig, Key, Layout, Reason
from maplines_can.wire.covariance.factor import CholeskyFactor
from maplines_can.wire.layout.pose_layout import Owner
from maplines_can.wire.layout.signals import PARAMETER_SIGNALS
from maplines_can.wire.reception.sequence import SlotStats
from maplines_can.wire.reception.settings import decoder_settings
from maplines_can.wire.reception.views import STALE_CYCLES

REASONS = {reason: i + 1 for i, reason in enumerate(Reason)}
OWNERS: tuple[Owner, ...] = (*Slot, POSE)
FRAME, LATEST, SCENE, EXPIRE, STATISTICS, SETTINGS, COMPONENT, PROBLEM = range(8)
#: Longest time in C [ns]; beyond it, a time is limited to it.
MAX_TIME = 4 * 10**18


@dataclass
class Vault:
    """Keys of a receiver, and its clock of freshness values."""

    keys: Sequence[tuple[int, bytes]]  #: key ID and secret of 16 bytes
    window_us: int | None = 1_000_000  #: None: there is no clock
    not_before_us: int = 0
    now_us: int = 0

    def authenticator(self) -> Authenticator:
        keys = [Key(secret, key_id) for key_id, secret in self.keys]
        if self.window_us is None:
            return Authenticator(*keys, not_before=self.not_before_us)
        return Authenticator(
            *keys,
            clock=lambda: 1000 * self.now_us,
            window_ns=1000 * self.window_us,
            not_before=self.not_before_us,
        )


@dataclass
class Receivers:
    """A decoder in Python, and what the one in C is to be asked and to answer.

    ``check`` compares both. Each step is taken by the decoder in Python at once.
    """

    layout: Layout
    timeout_ms: float | None = None
    cycle_ms: float | None = None
    e2e: E2EConfig | None = None
    stale_cycles: float = STALE_CYCLES
    vault: Vault | None = None
    met: Counter[str] = field(default_factory=Counter)  #: answers by name, for coverage

    def __post_init__(self) -> None:
        authenticator = None if self.vault is None else self.vault.authenticator()
        self.codec = Codec(self.layout, authenticator)
        self.decoder = self.codec.decoder(
            timeout_ms=self.timeout_ms, cycle_ms=self.cycle_ms, e2e=self.e2e
        )
        self._order = list(CholeskyFactor(self.layout, PARAMETER_SIGNALS).order)
        self._slots = [owner for owner in self.decoder.checks if owner != POSE]
        self._asked, self._expected = [self._settings()], [b"\0"]
        self._steps = ["the settings"]

    def frame(self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False) -> None:
        """Feed a frame."""
        now_us = 0 if self.vault is None else self.vault.now_us
        answer = self.decoder.feed(can_id, data, _limited(t_ns), is_extended=is_extended)
        head = struct.pack("<BIBB", FRAME, can_id, is_extended, len(data))
        self._asked.append(head + data + struct.pack("<qq", t_ns, now_us))
        self._steps.append(f"frame {can_id:x} {data.hex()} at {t_ns}")
        if isinstance(answer, Reason):
            self._expected.append(bytes([REASONS[answer], 0]))
            self.met[answer.name] += 1
        else:
            order = self._order if self.layout.is_conditional else None
            lines = b"".join(_line(line, order) for line in answer)
            self._expected.append(bytes([0, len(answer)]) + lines)
            self.met["line"] += len(answer)
            self.met["mixture"] += sum(line.mixture is not None for line in answer)
            for line in answer:
                self.met[line.status.name] += 1

    def latest(self, slot: Slot, now_ns: int) -> None:
        """Ask for the newest line of a slot."""
        view = self.decoder.latest(slot, _limited(now_ns), stale_cycles=self.stale_cycles)
        t_ns = 0 if view.line is None else view.line.t_ns
        status = 0xFF if view.status is None else view.status
        flags = view.stale, view.two_senders, view.usable
        self._ask(LATEST, struct.pack("<Bq", slot, now_ns), f"latest of {slot!r} at {now_ns}")
        self._expected.append(
            struct.pack("<BqdBB3B", view.line is not None, t_ns, view.age, view.state, status,
                        *flags)
        )  # fmt: skip
        self._meet_view(view)

    def component(self, slot: int, i: int) -> None:
        """Ask for a component of the newest line of any slot; records have their covariances."""
        decoder: Any = self.decoder  # of Python, which has the newest lines at hand
        line = decoder._newest.get(Slot(slot)) if slot in self._slots else None
        found: list[tuple[float, Gaussian]] = []
        if line is not None and line.mixture is not None:
            found = [*zip(line.mixture.weights, line.mixture.components, strict=True)]
        elif line is not None:
            found = [(1.0, line.gaussian)]
        self._ask(COMPONENT, bytes([slot, i]), f"component {i} of {slot}")
        expected = bytes([i < len(found)])
        if i < len(found):
            weight, gaussian = found[i]
            expected += struct.pack("<d", weight) + _gaussian(gaussian)
        self._expected.append(expected)

    def scene(self, now_ns: int) -> None:
        """Ask for the newest scene."""
        if self.layout.pose is None:
            return
        view = self.decoder.latest_scene(_limited(now_ns), stale_cycles=self.stale_cycles)
        status = 0xFF if view.status is None else view.status
        flags = view.stale, view.two_senders, view.usable
        self._ask(SCENE, struct.pack("<q", now_ns), f"scene at {now_ns}")
        expected = struct.pack(
            "<BdBB3B", view.scene is not None, view.age, view.state, status, *flags
        )
        if view.scene is not None and view.received is not None:
            received = view.received
            lines = view.scene.lines
            expected += struct.pack("<Iqd", received.counter, received.t_ns, received.age)
            expected += bytes([len(lines)])
            for line in lines:
                expected += bytes([view.slot_states[line.slot]]) + _line(line, self._order)
            self.met["scene"] += 1
        self._expected.append(expected)
        self._meet_view(view)

    def expire(self, t_ns: int) -> None:
        """Drop what has timed out."""
        self.decoder.expire(_limited(t_ns))
        self._ask(EXPIRE, struct.pack("<q", t_ns), f"expire at {t_ns}")
        self._expected.append(b"")

    def statistics(self, now_ns: int) -> None:
        """Ask for all numbers."""
        decoder, now = self.decoder, _limited(now_ns)
        known: dict[Owner, SlotStats] = {}
        known.update(decoder.slots(now).items())
        if (of_pose := decoder.pose_error(now)) is not None:
            known[POSE] = of_pose
        expected = b"".join(_stats(known.get(owner)) for owner in OWNERS)
        counts = decoder.counts
        numbers = [counts[reason] for reason in Reason]
        numbers += [decoder.frames, decoder.lines, decoder.line_frames]
        numbers += [decoder.pose_errors, decoder.pose_frames, decoder.lost]
        expected += struct.pack(f"<{len(numbers)}QI", *map(_wrapped, numbers), decoder.pending)
        self._ask(STATISTICS, struct.pack("<q", now_ns), f"statistics at {now_ns}")
        self._expected.append(expected)
        assert decoder.frames == (
            decoder.line_frames + decoder.pose_frames + sum(counts.values()) + decoder.pending
        )
        self.met.update(reason.name for reason in counts)
        if any(stats.two_senders for stats in known.values()):
            self.met["two senders"] += 1

    def check(self, program: Path, *prefix: str, is_float: bool = False) -> int:
        """Return the number of frames; raise AssertionError at the first difference.

        Args:
            program: harness.
            prefix: an emulator and its arguments.
            is_float: of a build in single precision, only decisions and counts are compared.
        """
        given = c_core.run(program, b"".join(self._asked), *prefix)
        if given != b"".join(self._expected):
            place = 0
            for i, (step, expected) in enumerate(zip(self._steps, self._expected, strict=True)):
                got = given[place : place + len(expected)]
                decided = _decisions(step, got), _decisions(step, expected)
                assert got == expected or (is_float and decided[0] == decided[1]), (
                    f"step {i}, {step}:\nC      {got.hex()}\nPython {expected.hex()}"
                )
                place += len(expected)
            assert place == len(given), "the harness writes more than was asked"
        return self.decoder.frames

    def settings_of(
        self,
        timeout_ms: float | None = None,
        cycle_ms: float | None = None,
        e2e: Mapping[str, Any] | None = None,
    ) -> bool:
        """Ask for the settings that follow from these; return whether they are refused."""
        try:
            config = None if e2e is None else E2EConfig(**e2e)
            settings = decoder_settings(self.layout, timeout_ms, cycle_ms, config)
        except ValueError:
            settings = {}
        data = _times(timeout_ms, cycle_ms, STALE_CYCLES) + bytes([e2e is not None])
        if e2e is not None:
            data += bytes(map(int, replace_all(E2EConfig(), e2e)))
        data += struct.pack("<BBqq", 0, 0, 1, 0)
        self._ask(SETTINGS, data, f"settings {timeout_ms}, {cycle_ms}, {e2e}")
        expected = bytes([not settings])
        for owner in OWNERS if settings else ():
            of_owner = settings.get(owner)
            expected += bytes(27) if of_owner is None else struct.pack(
                "<qq", of_owner.timeout_ns, of_owner.cycle_ns
            ) + bytes(map(int, astuple(of_owner.e2e)))  # fmt: skip
        self._expected.append(expected)
        return not settings

    def _ask(self, kind: int, data: bytes, step: str) -> None:
        self._asked.append(bytes([kind]) + data)
        self._steps.append(step)

    def _meet_view(self, view: Any) -> None:
        self.met[f"state {view.state.name}"] += 1
        if view.status is not None:
            self.met[f"status {view.status.name}"] += 1
        for name in ("stale", "two_senders", "usable"):
            self.met[name] += getattr(view, name)

    def _settings(self) -> bytes:
        data = _times(self.timeout_ms, self.cycle_ms, self.stale_cycles)
        data += bytes([self.e2e is not None])
        if self.e2e is not None:
            data += bytes(map(int, astuple(self.e2e)))
        vault = Vault(()) if self.vault is None else self.vault
        data += bytes([len(vault.keys)])
        data += b"".join(bytes([key_id]) + secret for key_id, secret in vault.keys)
        window_us = 1 if vault.window_us is None else vault.window_us
        has_clock = vault.window_us is not None
        return data + struct.pack("<Bqq", has_clock, window_us, vault.not_before_us)


def replace_all(config: E2EConfig, changes: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the fields of windows with changes that need not be valid."""
    return tuple(changes.get(f.name, getattr(config, f.name)) for f in fields(config))


def _times(timeout_ms: float | None, cycle_ms: float | None, stale_cycles: float) -> bytes:
    return struct.pack("<3d", timeout_ms or 0.0, cycle_ms or 0.0, stale_cycles)


def _decisions(step: str, answer: bytes) -> bytes:
    """Return what an answer says besides floating-point numbers."""
    if step.startswith("frame"):
        return answer[:2]
    if step.startswith("latest"):
        return answer[:9] + answer[17:]
    return answer[:1] + answer[9:14] if step.startswith("scene") else answer


def _limited(t_ns: int) -> int:
    return max(-MAX_TIME, min(t_ns, MAX_TIME))


def _wrapped(number: int) -> int:
    return number % 2**64


def _gaussian(gaussian: Gaussian) -> bytes:
    return gaussian.mean.astype("<f8").tobytes() + gaussian.cov.astype("<f8").tobytes()


def _line(line: MapLine, order: list[int] | None) -> bytes:
    """Return what the harness writes of a line.

    The factor of a covariance that is a sum, of a mixture or in a scene, is the Cholesky factor, in
    a scene with the rows in this order.
    """
    mixture = line.mixture
    count = 1 if mixture is None else len(mixture.weights)
    assert line.t_ns is not None
    head = struct.pack("<4B", line.slot, line.kind, line.status, count)
    head += struct.pack("<3dq", line.x_min, line.x_max, line.age, line.t_ns)
    if mixture is None and order is None:
        return head + _gaussian(line.gaussian)
    rows = list(range(4)) if mixture is not None or order is None else order
    factor = np.zeros((4, 4))
    factor[rows] = cholesky(line.gaussian.cov[np.ix_(rows, rows)])
    assert np.isfinite(factor).all()
    data = head + line.gaussian.mean.astype("<f8").tobytes() + factor.astype("<f8").tobytes()
    if mixture is None:
        return data
    for weight, component in zip(mixture.weights, mixture.components, strict=True):
        data += struct.pack("<d", weight) + _gaussian(component)
    return data


def _stats(stats: SlotStats | None) -> bytes:
    if stats is None:
        return b"\0"
    assert stats.status is not None
    numbers = (
        stats.ok, stats.lost, stats.repeated, stats.wrong_sequence, stats.errors,
        stats.no_new_data,
    )  # fmt: skip
    head = bytes([1, stats.state, stats.status])
    return head + struct.pack("<6Q", *map(_wrapped, numbers)) + bytes([stats.two_senders])
