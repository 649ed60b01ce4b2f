"""States and results of AUTOSAR's E2E checks, and the settings of the state machine of a slot.

As in PRS_E2EProtocol (document 849, R20-11): the check of profile 5 (E2E_P05Check), and the state
machine (E2E_SMCheck) with a window size for each state. The option transitToInvalidExtended of that
release is not implemented: only errors cause the transition from INIT to INVALID. Both are in the
core; ``model/e2e.py`` is to be read.
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

    def _of(self, state: str) -> tuple[int, int, int]:
        names = (f"window_size_{state}", f"min_ok_state_{state}", f"max_error_state_{state}")
        size, ok, error = (getattr(self, name) for name in names)
        return size, ok, error
