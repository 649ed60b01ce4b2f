"""Records as raw values by signal, with page numbers, transfer IDs and checksum."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..layout.packing import Packing
from ..layout.record_layout import RecordLayout
from ..layout.signals import PAGE, PAGE_BYTES, TRANSFER_ID
from ..protection.e2e import CRC_BYTES, record_crc, record_crc_one
from ..reasons import Reason


class RawRecords:
    """Packer and unpacker of the records of a layout, or of their first pages only.

    Args:
        layout: of the records.
        pages: number of pages of these records; None for all pages.
    """

    def __init__(self, layout: RecordLayout, pages: int | None = None) -> None:
        self.pages = layout.pages if pages is None else pages
        #: Length of a record.
        self.record_bytes = self.pages * PAGE_BYTES
        end = 8 * self.record_bytes
        signals = [signal for signal in layout.signals.values() if signal.start < end]
        self._packing = Packing(signals, self.record_bytes)
        self._crc_offset = layout.crc_offset
        self._transfer_mask = 2 ** layout[f"{TRANSFER_ID}0"].length - 1

    def pack_one(self, raw: Mapping[str, int], counter: int, data_id: int) -> bytes:
        """Return the record of raw values by signal; a signal without a value is 0."""
        numbers = {f"{PAGE}{page}": page for page in range(self.pages)}
        ids = {f"{TRANSFER_ID}{page}": counter for page in range(self.pages)}
        payload = self._packing.pack_one({**raw, "Counter": counter, **numbers, **ids})
        crc = record_crc_one(payload, data_id, self._crc_offset).to_bytes(CRC_BYTES, "little")
        return payload[: self._crc_offset] + crc + payload[self._crc_offset + CRC_BYTES :]

    def unpack_one(self, payload: bytes, data_id: int) -> dict[str, int] | Reason:
        """Return the raw values of a record; MIXED or CRC if it is damaged, or its length."""
        if len(payload) != self.record_bytes:
            return Reason.LENGTH
        raw = self._packing.unpack_one(payload)
        transfer = raw["Counter"] & self._transfer_mask
        for page in range(self.pages):
            if raw[f"{PAGE}{page}"] != page or raw[f"{TRANSFER_ID}{page}"] != transfer:
                return Reason.MIXED
        if raw["Crc"] != record_crc_one(payload, data_id, self._crc_offset):
            return Reason.CRC
        return raw

    def pack(
        self,
        raw: Mapping[str, NDArray[np.int64]],
        counters: NDArray[np.int64],
        data_ids: NDArray[np.uint16],
    ) -> NDArray[np.uint8]:
        """Return (N, record bytes) records of (N,) raw values by signal: as ``pack_one``."""
        n = len(counters)
        numbers = {f"{PAGE}{page}": np.full(n, page) for page in range(self.pages)}
        ids = {f"{TRANSFER_ID}{page}": counters for page in range(self.pages)}
        payloads = self._packing.pack({**raw, "Counter": counters, **numbers, **ids}, n)
        crc = record_crc(payloads, data_ids, self._crc_offset)
        payloads[:, self._crc_offset] = crc & 0xFF
        payloads[:, self._crc_offset + 1] = crc >> 8
        return payloads

    def unpack(
        self, payloads: NDArray[np.uint8], data_ids: NDArray[np.uint16]
    ) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.bool_]]:
        """Return the (N,) raw values of records by signal, and (N,) which are not damaged."""
        raw = self._packing.unpack(payloads)
        valid = raw["Crc"] == record_crc(payloads, data_ids, self._crc_offset)
        transfer = raw["Counter"] & self._transfer_mask
        for page in range(self.pages):
            valid &= (raw[f"{PAGE}{page}"] == page) & (raw[f"{TRANSFER_ID}{page}"] == transfer)
        return raw, valid
