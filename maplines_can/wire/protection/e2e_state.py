"""AUTOSAR's E2E state machine: from the checks of single records to what a channel is worth.

After PRS_E2EProtocol (document 849, R20-11), the check of profile 5 (E2E_P05Check) and the state
machine (E2E_SMCheck) with its windows of their own size for each state. Left out is what that
release adds as transitToInvalidExtended: INIT is left for INVALID by errors alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

__all__ = ["COUNTERS", "E2EConfig", "E2EState", "ProfileStatus", "StateMachine", "check"]

#: How many counters profile 5 has.
COUNTERS = 256
#: Beyond half of them a step forward is as likely one back.
LONGEST_DELTA = COUNTERS // 2 - 1
LONGEST_WINDOW = 255


class ProfileStatus(IntEnum):
    """Outcome of the check of one record, or of a cycle without one; numbers as in profile 5."""

    OK = 0x00  #: the checksum holds, and the counter is the next one
    NONEWDATA = 0x01  #: a cycle went by, and nothing came
    ERROR = 0x07  #: the checksum does not hold, or the record is none
    REPEATED = 0x08  #: the counter is that of the record before
    OKSOMELOST = 0x20  #: OK, but up to max_delta_counter - 1 records are missing before it
    WRONGSEQUENCE = 0x40  #: the checksum holds, and the counter has jumped


class E2EState(IntEnum):
    """What the records of a slot are worth; numbers as in AUTOSAR, which has DEINIT too."""

    VALID = 0  #: enough of the last records were good
    NODATA = 2  #: nothing has come yet
    INIT = 3  #: not enough has come yet to tell
    INVALID = 4  #: too few of the last records were good, or too many bad: do not use the line


OK, NONEWDATA, ERROR, REPEATED, OKSOMELOST, WRONGSEQUENCE = ProfileStatus
VALID, NODATA, INIT, INVALID = E2EState


@dataclass(frozen=True, slots=True)
class E2EConfig:
    """Window sizes and bounds of a state machine, by AUTOSAR's names.

    The defaults are for lines at 20 Hz, 50 ms apart, where a window of 10 is half a
    second. VALID is left when fewer than 6 of 10 checks were OK: four lost lines do not
    matter, 5 cycles of silence do, and so does a second sender, which makes every other
    record one out of sequence. 3 errors of 10 end it too: CAN's own checksum repairs
    by repetition what the wire does, so they come from a sender or a gateway at fault. It
    takes 8 good checks to regain VALID, more than to keep it, lest the state flicker, and
    none of them from before the fault.

    Args:
        max_delta_counter: farthest step of the counter that passes for lost records. 16 is
            two whole mixtures of 8 parts, or 0.8 s of single lines.
        window_size_init: how many of the last checks count while INIT.
        window_size_valid: how many count while VALID; not less than the others.
        window_size_invalid: how many count while INVALID.
        min_ok_state_init: good ones that it takes from INIT to VALID.
        min_ok_state_valid: good ones that it takes to stay VALID.
        min_ok_state_invalid: good ones that it takes from INVALID to VALID.
        max_error_state_init: errors with which INIT may still become VALID; more make it INVALID.
        max_error_state_valid: errors with which VALID stays so.
        max_error_state_invalid: errors with which INVALID may become VALID.
        clear_to_invalid: forget all checks on the way to INVALID.

    Raises:
        ValueError: a value breaks a constraint of the standard.

    >>> E2EConfig(min_ok_state_valid=9)
    Traceback (most recent call last):
    ...
    ValueError: min_ok_state_valid + max_error_state_valid must fit into window_size_valid, \
got 9 + 2 > 10
    """

    max_delta_counter: int = 16
    window_size_init: int = 10
    window_size_valid: int = 10
    window_size_invalid: int = 10
    min_ok_state_init: int = 6
    min_ok_state_valid: int = 6
    min_ok_state_invalid: int = 8
    max_error_state_init: int = 1
    max_error_state_valid: int = 2
    max_error_state_invalid: int = 0
    clear_to_invalid: bool = True

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self) if field.name != "clear_to_invalid"):
            value = getattr(self, name)
            least = 0 if name.startswith("max_error") else 1
            most = LONGEST_DELTA if name == "max_delta_counter" else LONGEST_WINDOW
            if not (isinstance(value, int) and least <= value <= most):
                raise ValueError(
                    f"{name} must be a whole number from {least} to {most}, got {value!r}"
                )
        for state in ("init", "valid", "invalid"):
            size, ok, error = self._of(state)
            if ok + error > size:
                raise ValueError(
                    f"min_ok_state_{state} + max_error_state_{state} must fit into "
                    f"window_size_{state}, got {ok} + {error} > {size}"
                )
            if size > self.window_size_valid:
                raise ValueError(
                    f"window_size_{state} must be window_size_valid or less, "
                    f"got {size} > {self.window_size_valid}"
                )
        oks = self.min_ok_state_valid, self.min_ok_state_init, self.min_ok_state_invalid
        if list(oks) != sorted(oks):
            raise ValueError(
                "min_ok_state_valid <= min_ok_state_init <= min_ok_state_invalid must hold, or "
                f"VALID would be left as soon as it is reached; got {', '.join(map(str, oks))}"
            )
        errors = self.max_error_state_invalid, self.max_error_state_init, self.max_error_state_valid
        if list(errors) != sorted(errors):
            raise ValueError(
                "max_error_state_invalid <= max_error_state_init <= max_error_state_valid must "
                "hold, or VALID would be left as soon as it is reached; "
                f"got {', '.join(map(str, errors))}"
            )

    def of(self, state: E2EState) -> tuple[int, int, int]:
        """Window size, least OKs and most errors in a state; those of INIT in NODATA."""
        return self._of("init" if state is E2EState.NODATA else state.name.lower())

    def _of(self, state: str) -> tuple[int, int, int]:
        names = (f"window_size_{state}", f"min_ok_state_{state}", f"max_error_state_{state}")
        size, ok, error = (getattr(self, name) for name in names)
        return size, ok, error


def check(
    counter: int, last_counter: int | None, max_delta_counter: int, modulus: int = COUNTERS
) -> ProfileStatus:
    """Check the counter of a record whose checksum holds (E2E_P05Check).

    Args:
        counter: of the record.
        last_counter: of the good record before it. None where it is the first, which is OK:
            AUTOSAR compares it with the initial 255, and a receiver that joins late
            begins with WRONGSEQUENCE.
        max_delta_counter: see ``E2EConfig``.
        modulus: how many counters there are.

    >>> [check(c, 254, 2).name for c in (255, 0, 1, 254, 253)]
    ['OK', 'OKSOMELOST', 'WRONGSEQUENCE', 'REPEATED', 'WRONGSEQUENCE']
    """
    delta = 1 if last_counter is None else (counter - last_counter) % modulus
    if delta == 1:
        return OK
    if delta == 0:
        return REPEATED
    return OKSOMELOST if delta <= max_delta_counter else WRONGSEQUENCE


class StateMachine:
    """The state of one slot, by its last checks (E2E_SMCheck). Time is the caller's.

    ======== ============================================================ =======
    in       when                                                         becomes
    ======== ============================================================ =======
    NODATA   a check other than ERROR and NONEWDATA; it does not count    INIT
    INIT     errors <= max_error_state_init, OKs >= min_ok_state_init     VALID
    INIT     errors > max_error_state_init                                INVALID
    VALID    errors > max_error_state_valid or OKs < min_ok_state_valid   INVALID
    INVALID  errors <= max_error_state_invalid, OKs >= min_ok_..._invalid VALID
    ======== ============================================================ =======

    Errors and OKs are counted in the window of the state, the last checks since it was
    cleared: OK and OKSOMELOST are OKs, ERROR is an error; REPEATED, WRONGSEQUENCE and
    NONEWDATA are neither, and take the place of an OK. From a small window to a larger
    one its checks go along, and what had left it does not come back.

    >>> machine = StateMachine(E2EConfig())
    >>> [machine.step(ProfileStatus.OK).name for _ in range(7)]
    ['INIT', 'INIT', 'INIT', 'INIT', 'INIT', 'INIT', 'VALID']
    >>> [machine.step(ProfileStatus.NONEWDATA).name for _ in range(5)]
    ['VALID', 'VALID', 'VALID', 'VALID', 'INVALID']
    """

    def __init__(self, config: E2EConfig) -> None:
        self.config = config
        self._bounds = {state: config.of(state) for state in E2EState}
        # The window as bits, the last check lowest: those that were OK, and those in error.
        self._oks = self._errors = 0
        self._enter(E2EState.NODATA)

    @property
    def ok_count(self) -> int:
        """OKs in the window."""
        return self._oks.bit_count()

    @property
    def error_count(self) -> int:
        """Errors in the window."""
        return self._errors.bit_count()

    def step(self, status: ProfileStatus) -> E2EState:
        """Take the check of one record, or NONEWDATA for a cycle without one."""
        state = self.state
        if state is NODATA:
            if status is not ERROR and status is not NONEWDATA:
                self._enter(INIT)
            return self.state
        self._oks = (self._oks << 1 | (status is OK or status is OKSOMELOST)) & self._mask
        self._errors = (self._errors << 1 | (status is ERROR)) & self._mask
        errors = self._errors.bit_count()
        if errors <= self._max_error and self._oks.bit_count() >= self._min_ok:
            if state is not VALID:
                self._enter(VALID)
        elif state is VALID or (state is INIT and errors > self._max_error):
            if self.config.clear_to_invalid:
                self.clear()
            self._enter(INVALID)
        return self.state

    def clear(self) -> None:
        """Forget all checks, and keep the state (E2E_SMClearStatus)."""
        self._oks = self._errors = 0

    def _enter(self, state: E2EState) -> None:
        self.state = state  #: what the slot is worth now
        size, self._min_ok, self._max_error = self._bounds[state]
        self._mask = 2**size - 1
        self._oks &= self._mask
        self._errors &= self._mask
