"""AUTOSAR's E2E check of a record's counter, and E2E state machine of a slot.

As in PRS_E2EProtocol (document 849, R20-11): the check of profile 5 (E2E_P05Check), and the state
machine (E2E_SMCheck) with a window size for each state. The option transitToInvalidExtended of that
release is not implemented: only errors cause the transition from INIT to INVALID.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

#: Counter modulus of profile 5.
COUNTERS = 256
#: Greatest step of the counter; a larger one may as well be a step back.
MAX_DELTA = COUNTERS // 2 - 1
MAX_WINDOW = 255


class ProfileStatus(IntEnum):
    """Result of the check of one record, or of a cycle without one; numbers as in profile 5."""

    OK = 0x00  #: the checksum is correct, and the counter is the next one
    NONEWDATA = 0x01  #: no record was received for a cycle
    ERROR = 0x07  #: the checksum or the format of the record is wrong
    REPEATED = 0x08  #: the counter is that of the previous record
    OKSOMELOST = 0x20  #: OK, but up to max_delta_counter - 1 records before it are missing
    WRONGSEQUENCE = 0x40  #: the checksum is correct, but the counter is out of sequence


class E2EState(IntEnum):
    """State of the records of a slot; numbers as in AUTOSAR, which also has DEINIT."""

    VALID = 0  #: enough of the last checks were OK
    NODATA = 2  #: no record has been received yet
    INIT = 3  #: too few records have been received yet
    INVALID = 4  #: too few of the last checks were OK, or too many errors: do not use the line


OK, NONEWDATA, ERROR, REPEATED, OKSOMELOST, WRONGSEQUENCE = ProfileStatus
VALID, NODATA, INIT, INVALID = E2EState


@dataclass(frozen=True, slots=True)
class E2EConfig:
    """Window sizes and bounds of a state machine, with AUTOSAR's names.

    The defaults are for lines at 20 Hz, 50 ms apart, where a window of 10 is half a second. VALID
    requires that at least 6 of 10 checks are OK. So four lost lines do not matter, but 5 cycles of
    silence do, and a second sender does too, because it puts every other record out of sequence.
    VALID also ends with 3 errors of 10: CAN repeats frames that are damaged on the bus, so errors
    come from a faulty sender or gateway. To become VALID again takes 8 OKs, more than to stay
    VALID, so that the state does not toggle. None of them is from before the fault.

    Args:
        max_delta_counter: greatest step of the counter that counts as lost records. 16 is two
            complete mixtures of 8 components, or 0.8 s of single lines.
        window_size_init: number of the last checks that count in INIT.
        window_size_valid: number that counts in VALID; not less than the others.
        window_size_invalid: number that counts in INVALID.
        min_ok_state_init: OKs required from INIT to VALID.
        min_ok_state_valid: OKs required to stay VALID.
        min_ok_state_invalid: OKs required from INVALID to VALID.
        max_error_state_init: errors allowed from INIT to VALID; with more, INIT becomes INVALID.
        max_error_state_valid: errors allowed to stay VALID.
        max_error_state_invalid: errors allowed from INVALID to VALID.
        clear_to_invalid: clear the window at the transition to INVALID.

    Raises:
        ValueError: a value violates a constraint of the standard.

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
            most = MAX_DELTA if name == "max_delta_counter" else MAX_WINDOW
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
        """Return window size, least OKs and most errors in a state; in NODATA, those of INIT."""
        return self._of("init" if state is E2EState.NODATA else state.name.lower())

    def _of(self, state: str) -> tuple[int, int, int]:
        names = (f"window_size_{state}", f"min_ok_state_{state}", f"max_error_state_{state}")
        size, ok, error = (getattr(self, name) for name in names)
        return size, ok, error


def check(
    counter: int, last_counter: int | None, max_delta_counter: int, modulus: int = COUNTERS
) -> ProfileStatus:
    """Check the counter of a record whose checksum is correct (E2E_P05Check).

    Args:
        counter: of the record.
        last_counter: of the previous record with a correct checksum. None if there is none; the
            result is then OK. (AUTOSAR compares with the initial value 255, so a receiver that
            joins late starts with WRONGSEQUENCE.)
        max_delta_counter: see ``E2EConfig``.
        modulus: counter modulus.

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
    """State machine of one slot, driven by its last checks (E2E_SMCheck). It has no clock.

    ======== ============================================================ =======
    in       when                                                         becomes
    ======== ============================================================ =======
    NODATA   a check other than ERROR and NONEWDATA; it does not count    INIT
    INIT     errors <= max_error_state_init, OKs >= min_ok_state_init     VALID
    INIT     errors > max_error_state_init                                INVALID
    VALID    errors > max_error_state_valid or OKs < min_ok_state_valid   INVALID
    INVALID  errors <= max_error_state_invalid, OKs >= min_ok_..._invalid VALID
    ======== ============================================================ =======

    Errors and OKs are counted in the window of the state: the last checks since the window was
    cleared. OK and OKSOMELOST are OKs, and ERROR is an error. REPEATED, WRONGSEQUENCE and NONEWDATA
    are neither, but fill the window. At a transition to a larger window, the checks in the smaller
    one are kept, and older checks do not return.

    >>> machine = StateMachine(E2EConfig())
    >>> [machine.step(ProfileStatus.OK).name for _ in range(7)]
    ['INIT', 'INIT', 'INIT', 'INIT', 'INIT', 'INIT', 'VALID']
    >>> [machine.step(ProfileStatus.NONEWDATA).name for _ in range(5)]
    ['VALID', 'VALID', 'VALID', 'VALID', 'INVALID']
    """

    def __init__(self, config: E2EConfig) -> None:
        self.config = config
        self._bounds = {state: config.of(state) for state in E2EState}
        # The window as bits, the last check lowest: one bit each for OK and for ERROR.
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
        """Return the state after the check of one record, or NONEWDATA for a cycle without one."""
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
        """Clear the window, and keep the state (E2E_SMClearStatus)."""
        self._oks = self._errors = 0

    def _enter(self, state: E2EState) -> None:
        self.state = state  #: of the slot
        size, self._min_ok, self._max_error = self._bounds[state]
        self._mask = 2**size - 1
        self._oks &= self._mask
        self._errors &= self._mask
