"""Messages of a record: payload lengths, room, and numbers of their own."""

from dataclasses import replace
from typing import Any

import pytest

from maplines_can.values.errors import LayoutError
from maplines_can.wire.layout.slot_messages import (
    RecordMessages,
    Room,
    SecuredLayout,
    check_messages,
)

MESSAGES = RecordMessages(
    name="A",
    can_id=1,
    fd_can_id=2,
    is_extended=False,
    fd_is_extended=False,
    fd_length=32,
    data_id=7,
    cycle_ms=50,
    secured_can_id=3,
    secured_data_id=7,
)
SECURED = SecuredLayout(length=48, freshness_bytes=7, mac_bytes=8)
ROOM = Room("first", MESSAGES, SECURED, 32, 32)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param({"fd_length": 24}, "the CAN FD message has 24 bytes .* needs 32", id="fd"),
        pytest.param({"fd_length": 24, "fd_can_id": None}, "", id="no-fd"),
        pytest.param({"fd_can_id": 1}, r"first \(classic\) and first \(CAN FD\)", id="classic-fd"),
        pytest.param({"fd_can_id": 1, "fd_is_extended": True}, "", id="fd-of-29-bits"),
        pytest.param({"secured_can_id": 1}, r"\(classic\) and first \(authent", id="classic-secoc"),
        pytest.param({"secured_can_id": 2, "secured_is_extended": True}, "", id="secoc-of-29-bits"),
    ],
)
def test_the_messages_of_a_record(change: dict[str, Any], words: str) -> None:
    """Each has its own CAN ID, and room for the record."""
    rooms = [ROOM._replace(messages=replace(MESSAGES, **change))]
    if words:
        with pytest.raises(LayoutError, match=words):
            check_messages(rooms, "my.dbc")
    else:
        check_messages(rooms, "my.dbc")


@pytest.mark.parametrize(("secured", "room"), [(replace(SECURED, mac_bytes=9), 32), (None, 0)])
def test_an_authenticated_message_has_room_for_record_and_key_id(
    secured: SecuredLayout | None, room: int
) -> None:
    """33 bytes before the freshness value, and no less."""
    check_messages([ROOM], "my.dbc")
    with pytest.raises(LayoutError, match=f"authenticated message has {room} bytes .* needs 33"):
        check_messages([ROOM._replace(secured=secured)], "my.dbc")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param({}, "", id="all-its-own"),
        pytest.param({"data_id": 7}, "first and second have the same E2EDataId, 7", id="e2e"),
        pytest.param({"secured_data_id": 7}, "have the same SecOCDataId, 7", id="secoc"),
        pytest.param({"secured_data_id": 7, "secured_can_id": None}, "", id="not-authenticated"),
        pytest.param({"can_id": 3}, r"first \(authenticated\) and second \(classic\)", id="can-id"),
        pytest.param({"can_id": None}, "", id="no-classic-message"),
    ],
)
def test_two_records_have_their_own_numbers(change: dict[str, Any], words: str) -> None:
    """An E2E data ID may be equal to a SecOC data ID, but not to another one of its kind."""
    own = {"can_id": 4, "fd_can_id": 5, "secured_can_id": 6, "data_id": 8, "secured_data_id": 8}
    other = ROOM._replace(name="second", messages=replace(MESSAGES, **(own | change)))
    if words:
        with pytest.raises(LayoutError, match=words):
            check_messages([ROOM, other], "my.dbc")
    else:
        check_messages([ROOM, other], "my.dbc")
