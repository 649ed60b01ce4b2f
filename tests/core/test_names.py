"""Names of the values of enumerations in C: those of Python, or else of the header."""

import re
from functools import partial

import pytest
from support import c_core

from maplines_can import Kind, Slot, Status
from maplines_can.core import ffi, lib
from maplines_can.values.line import LEFT_OUT
from maplines_can.wire import Reason
from maplines_can.wire.layout.pose_layout import OWNERS, number_of
from maplines_can.wire.protection.e2e_state import E2EState, ProfileStatus

HEADER = (c_core.C / "include" / "maplines.h").read_text(encoding="utf-8")


def of_header(enumeration: str) -> dict[int, str]:
    """The enumerators without their prefix."""
    body = re.search(rf"typedef enum {{([^}}]*)}} maplines_{enumeration}_t;", HEADER)
    assert body
    found = re.findall(r"^    MAPLINES_(\w+) = ([^,]+),", body[1], re.MULTILINE)
    slots = str(len(Slot))
    values = {name: value.replace("MAPLINES_SLOTS", slots).split(" + ") for name, value in found}
    return {sum(int(number, 0) for number in value): name for name, value in values.items()}


def of_python() -> dict[str, dict[int, str]]:
    """The names of the enumerations that Python has."""
    return {
        "owner": {number: number_of(owner).name for number, owner in enumerate(OWNERS)},
        "kind": {kind: kind.name for kind in Kind},
        "status": {status: status.name for status in Status},
        "reason": {-1: "COMPLETE"} | {i: reason.name for i, reason in enumerate(Reason)},
        "e2e_state": {state: state.name for state in E2EState},
        "e2e_status": {status: status.name for status in ProfileStatus} | {0xFF: "NONE"},
        "left_out": {i: why.name if why else "IN_SCENE" for i, why in enumerate(LEFT_OUT)},
    }


@pytest.fixture(scope="module")
def names() -> dict[str, dict[int, str]]:
    """The names in C by enumeration."""
    found: dict[str, dict[int, str]] = {}
    for enumeration in re.findall(r"maplines_(\w+)_name\(", HEADER):
        name_of = getattr(lib, f"maplines_{enumeration}_name")
        kind = partial(ffi.cast, f"maplines_{enumeration}_t")
        every = {i: ffi.string(name_of(kind(i))).decode() for i in range(-3, 300)}
        found[enumeration] = {i: name for i, name in every.items() if name != "?"}
    return found


def test_names_are_those_of_python(names: dict[str, dict[int, str]]) -> None:
    assert {enumeration: names[enumeration] for enumeration in of_python()} == of_python()


def test_names_are_those_of_the_header(names: dict[str, dict[int, str]]) -> None:
    """Without prefixes that C needs, since its enumerators share one name space."""
    prefixes = {"kind": "KIND_", "e2e_state": "E2E_", "e2e_status": "E2E_", "left_out": "LEFT_OUT_"}
    for enumeration, of_c in names.items():
        expected = of_header(enumeration)
        if enumeration == "reason":
            assert expected.pop(len(Reason)) == "REASONS"  # their number
            pose = list(Reason).index(Reason.POSE)
            assert (expected.pop(pose), of_c[pose]) == ("NO_POSE", "POSE")  # POSE is an owner
            expected[pose] = of_c[pose]
        prefix = prefixes.get(enumeration, "")
        assert of_c == {i: name.removeprefix(prefix) for i, name in expected.items()}
