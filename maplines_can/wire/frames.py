"""CAN frames of a record: classic pages, one CAN FD frame, or one authenticated CAN FD frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import repeat
from struct import Struct
from typing import Any, NamedTuple

from ..values.errors import EncodeError, LayoutError
from .layout.message_layout import Layout
from .layout.pose_layout import Owner, owner_name
from .layout.record_signals import PAGE_BYTES
from .protection.secoc import Authenticator, check_freshness

#: Most combinations of records whose form is remembered.
MAX_FORMS = 64


class Frame(NamedTuple):
    """CAN frame to be sent on any bus."""

    can_id: int
    data: bytes
    is_fd: bool = False
    is_extended: bool = False


class Records(NamedTuple):
    """Records one after the other."""

    data: bytes
    owners: tuple[Owner, ...]  #: of each
    lengths: tuple[int, ...]  #: of each [byte]

    @classmethod
    def of(cls, records: Iterable[tuple[Owner, bytes]]) -> Records:
        """Return records that are given by one."""
        given = [*records]
        data = b"".join(record for _, record in given)
        owners = tuple(owner for owner, _ in given)
        return cls(data, owners, tuple(len(record) for _, record in given))


class FrameWriter:
    """Writer of the frames of a record; with an authenticator, all frames are authenticated.

    Raises:
        LayoutError: there is an authenticator, but the DBC has no authenticated message, or its
            freshness value is too short.
    """

    def __init__(self, layout: Layout, authenticator: Authenticator | None) -> None:
        if authenticator is not None:
            if layout.secured is None:
                raise LayoutError(
                    f"{layout.source} has no authenticated message (SecOCDataId), and classic CAN "
                    "and plain CAN FD are not authenticated; take maplines-secoc.dbc, or no key"
                )
            check_freshness(authenticator, layout.secured)
        self._layout, self._authenticator = layout, authenticator
        #: Of what was written before, by owners, lengths and whether it is CAN FD.
        self._forms: dict[tuple[Any, ...], _Form] = {}

    @property
    def is_secured(self) -> bool:
        """Whether all frames are authenticated."""
        return self._authenticator is not None

    def write(self, record: bytes, owner: Owner, fd: bool) -> list[Frame]:
        """Return the frames of a record.

        Raises:
            EncodeError: the DBC has no such message, or classic CAN is requested with an
                authenticator.
        """
        return self.write_all(Records(record, (owner,), (len(record),)), fd)[0]

    def write_all(self, records: Records, fd: bool) -> list[list[Frame]]:
        """Return the frames of each record; see ``write``."""
        key = records.owners, records.lengths, bool(fd)
        form = self._forms.get(key)
        if form is None:
            if len(self._forms) >= MAX_FORMS:
                self._forms.clear()
            form = self._forms[key] = self._form(records, fd)
        data: Iterable[bytes] = form.cut.unpack(records.data)
        if form.finish:
            data = [finish(one) for finish, one in zip(form.finish, data, strict=True)]
        parts = zip(form.can_ids, data, repeat(form.is_fd), form.are_extended)
        # The constructor of a named tuple takes as long as all the rest.
        frames = [*map(_new, repeat(Frame), parts)]
        return [frames[place] for place in form.places]

    def _form(self, records: Records, fd: bool) -> _Form:
        """Return how records are cut into frames."""
        sizes: list[int] = []
        frames: list[tuple[int, bool, Callable[[bytes], bytes]]] = []
        places: list[slice] = []
        for owner, length in zip(records.owners, records.lengths, strict=True):
            step = length if fd else PAGE_BYTES
            own = [min(step, length - start) for start in range(0, length, step)]
            places.append(slice(len(sizes), len(sizes) + len(own)))
            frames += [self._message(owner, length, fd)] * len(own)
            sizes += own
        can_ids, are_extended, finish = zip(*frames, strict=True)
        cut = Struct("".join(f"{size}s" for size in sizes))
        needed = finish if any(one is not bytes for one in finish) else ()
        return _Form(cut, can_ids, are_extended, bool(fd), needed, tuple(places))

    def _message(
        self, owner: Owner, length: int, fd: bool
    ) -> tuple[int, bool, Callable[[bytes], bytes]]:
        """Return ID and format of the frames of a record, and what makes their data of it."""
        messages = self._layout.messages_of.get(owner)
        secured = self._layout.record_of(owner).secured
        name = owner_name(owner)
        authenticator = self._authenticator
        if authenticator is not None:
            if not fd:
                raise EncodeError(
                    "classic CAN is not authenticated; send CAN FD (fd=True), or without a key"
                )
            if messages is None or secured is None or messages.secured_can_id is None:
                raise EncodeError(f"{self._layout.source} has no authenticated message for {name}")
            data_id, own = messages.secured_data_id, secured
            can_id, is_extended = messages.secured_can_id, messages.secured_is_extended
            return can_id, is_extended, lambda data: authenticator.secure(data, data_id, own)
        found = None if messages is None else messages.fd_can_id if fd else messages.can_id
        if messages is None or found is None:
            kind = "CAN FD" if fd else "classic"
            raise EncodeError(f"{self._layout.source} has no {kind} message for {name}")
        if not fd:
            return found, messages.is_extended, bytes
        size = messages.fd_length
        pad = bytes if length == size else lambda data: data.ljust(size, b"\0")
        return found, messages.fd_is_extended, pad


class _Form(NamedTuple):
    """How records are cut into frames."""

    cut: Struct
    can_ids: tuple[int, ...]
    are_extended: tuple[bool, ...]
    is_fd: bool
    finish: tuple[Callable[[bytes], bytes], ...]  #: of each frame; empty for none
    places: tuple[slice, ...]  #: of the frames of each record


_new = tuple.__new__
