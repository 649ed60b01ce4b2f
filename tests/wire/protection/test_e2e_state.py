"""AUTOSAR's E2E check and state machine, row by row: of the model, which the core agrees with."""

from dataclasses import asdict, astuple
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can.model import e2e
from maplines_can.wire import E2EConfig, E2EState, ProfileStatus

OK, NONEWDATA, ERROR, REPEATED, OKSOMELOST, WRONGSEQUENCE = ProfileStatus
VALID, NODATA, INIT, INVALID = E2EState

LETTERS = {"o": OK, "l": OKSOMELOST, "e": ERROR, "r": REPEATED, "w": WRONGSEQUENCE, "n": NONEWDATA}


class StateMachine:
    """The state machine of the model."""

    def __init__(self, config: E2EConfig) -> None:
        self.machine = e2e.StateMachine(e2e.Windows(*astuple(config)))

    def step(self, status: ProfileStatus) -> E2EState:
        self.machine.step(status.name)
        return E2EState[self.machine.state]


def check(counter: int, last: int | None, max_delta: int) -> ProfileStatus:
    return ProfileStatus[e2e.status_of(counter, last, max_delta, 256)]


# ---- the check ------------------------------------------------------------------------------


@given(st.integers(0, 255), st.integers(0, 255), st.integers(1, 127))
def test_any_step_of_the_counter(last: int, counter: int, max_delta: int) -> None:
    """As in E2E_P05Check: the step is the difference modulo 256. The first record is OK."""
    assert check(counter, None, max_delta) is OK
    forward = counter - last if counter >= last else counter + 256 - last
    expected = (
        REPEATED
        if forward == 0
        else OK
        if forward == 1
        else OKSOMELOST
        if forward <= max_delta
        else WRONGSEQUENCE
    )
    assert check(counter, last, max_delta) is expected


# ---- the state machine, row by row -------------------------------------------------------------


class Reference:
    """E2E_SMCheck as the standard describes it: an array, an index, and routines on them."""

    def __init__(self, config: Any) -> None:
        self.c = asdict(config)
        self.window = [None] * config.window_size_valid  # None: E2E_P_NOTAVAILABLE
        self.top, self.state = 0, "nodata"

    def size(self, state: Any) -> Any:
        return self.c[f"window_size_{state}"]

    def newest(self, n: Any) -> Any:
        return [self.window[(self.top - 1 - i) % len(self.window)] for i in range(n)]

    def clear(self) -> None:
        self.window, self.top = [None] * len(self.window), 0

    def clear_remaining(self, state: Any) -> None:
        if self.size(self.state) < self.size(state):
            for i in range(self.size(self.state), len(self.window)):
                self.window[(self.top - 1 - i) % len(self.window)] = None

    def to_invalid(self) -> None:
        self.clear() if self.c["clear_to_invalid"] else self.clear_remaining("invalid")
        self.state = "invalid"

    def step(self, status: Any) -> Any:
        if self.state == "nodata":
            if status not in (ERROR, NONEWDATA):
                self.clear()
                self.state = "init"
            return self.state
        self.window[self.top] = OK if status == OKSOMELOST else status  # type: ignore[assignment]
        self.top = (self.top + 1) % len(self.window)
        last = self.newest(self.size(self.state))
        self.oks, self.errors = last.count(OK), last.count(ERROR)
        few_errors = self.errors <= self.c[f"max_error_state_{self.state}"]
        many_oks = self.oks >= self.c[f"min_ok_state_{self.state}"]
        if self.state == "init" and few_errors and many_oks:
            self.clear_remaining("valid")
            self.state = "valid"
        elif (self.state == "init" and not few_errors) or (
            self.state == "valid" and not (few_errors and many_oks)
        ):
            self.to_invalid()
        elif self.state == "invalid" and few_errors and many_oks:
            self.clear_remaining("valid")
            self.state = "valid"
        return self.state


@st.composite
def configs(draw: Any) -> Any:
    """Any configuration that the standard allows, with small windows."""
    errors = sorted(draw(st.lists(st.integers(0, 3), min_size=3, max_size=3)))
    oks = sorted(draw(st.lists(st.integers(1, 4), min_size=3, max_size=3)))
    pairs = {"valid": (oks[0], errors[2]), "init": (oks[1], errors[1])}
    pairs["invalid"] = (oks[2], errors[0])
    sizes = {name: sum(pair) + draw(st.integers(0, 3)) for name, pair in pairs.items()}
    sizes["valid"] = max(sizes.values())
    values = {f"window_size_{name}": size for name, size in sizes.items()}
    values |= {f"min_ok_state_{name}": ok for name, (ok, _) in pairs.items()}
    values |= {f"max_error_state_{name}": error for name, (_, error) in pairs.items()}
    return E2EConfig(**values, clear_to_invalid=draw(st.booleans()))


@settings(max_examples=150)
@given(configs(), st.text("oooooolerwn", max_size=80))
def test_the_state_machine_agrees_with_the_reference(config: Any, statuses: str) -> None:
    """For any configuration and any checks, the states are the same."""
    machine, reference = StateMachine(config), Reference(config)
    for letter in statuses:
        state = machine.step(LETTERS[letter])
        assert state.name.lower() == reference.step(LETTERS[letter])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"max_delta_counter": 0}, "max_delta_counter must be a whole number from 1 to 127, got 0"),
        ({"max_delta_counter": 128}, "from 1 to 127, got 128"),
        ({"window_size_init": 2.5}, "window_size_init must be a whole number from 1"),
        ({"min_ok_state_valid": 0}, "min_ok_state_valid must be a whole number from 1"),
        ({"max_error_state_init": -1}, "max_error_state_init must be a whole number from 0"),
        ({"window_size_init": 6}, r"must fit into window_size_init, got 6 \+ 1 > 6"),
        ({"window_size_init": 11}, "window_size_init must be window_size_valid or less"),
        ({"window_size_invalid": 11}, "window_size_invalid must be window_size_valid or less"),
        ({"min_ok_state_init": 9}, "min_ok_state_init <= min_ok_state_invalid must hold"),
        ({"max_error_state_invalid": 2}, "max_error_state_invalid <= max_error_state_init"),
    ],
)
def test_a_configuration_that_the_standard_forbids_raises(values: Any, words: str) -> None:
    """The message names the constraint and the values."""
    with pytest.raises(ValueError, match=words):
        E2EConfig(**values)


def test_states_and_results_have_the_numbers_of_autosar() -> None:
    """PRS_E2EProtocol R20-11: E2E_SMStateType and E2E_P05CheckStatusType."""
    assert {state.name: state.value for state in E2EState} == {
        "VALID": 0x00, "NODATA": 0x02, "INIT": 0x03, "INVALID": 0x04,
    }  # fmt: skip
    assert {status.name: status.value for status in ProfileStatus} == {
        "OK": 0x00, "NONEWDATA": 0x01, "ERROR": 0x07,
        "REPEATED": 0x08, "OKSOMELOST": 0x20, "WRONGSEQUENCE": 0x40,
    }  # fmt: skip
