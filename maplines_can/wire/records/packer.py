"""Packing of records: raw values by signal, with page numbers, transfer IDs and checksum."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..layout.message_layout import Layout
from ..layout.packing import Packing
from ..layout.pose_layout import PoseLayout
from ..layout.signals import PAGE, PAGE_BYTES, TRANSFER_ID
from ..protection.e2e import CRC_BYTES, record_crc, record_crc_one
from ..reasons import Reason

#: Outcomes of the checks of a record, in the order of their numbers in ``Batch.verdict``.
VERDICTS = (None, Reason.MIXED, Reason.CRC, Reason.CONTENT)
#: Up to this number, records are packed one by one: with few records, arrays cost more than they
#: save.
FEW = 8


class RecordPacker:
    """Packer and unpacker of the records of a layout.

    It is the only place that knows page numbers, transfer IDs and checksum. A record whose
    ``HasCovariance`` is 0 has the first ``layout.short_pages`` only.

    Args:
        layout: of the records.
    """

    def __init__(self, layout: Layout | PoseLayout) -> None:
        self._layout = layout
        self._crc_offset = layout.crc_offset
        self._transfer_mask = 2 ** layout[f"{TRANSFER_ID}0"].length - 1
        lengths = {layout.pages, layout.short_pages}
        self._packings = {pages: _packing(layout, pages) for pages in lengths}
        self._page_numbers = {f"{PAGE}{page}": page for page in range(layout.pages)}
        self._transfer_ids = [f"{TRANSFER_ID}{page}" for page in range(layout.pages)]

    def pack_one(self, raw: Mapping[str, int], data_id: int) -> bytes:
        """Return the record of raw values by signal; a signal without a value is 0.

        Args:
            raw: all values but page numbers, transfer IDs and checksum.
            data_id: E2E data ID.
        """
        transfer_ids = dict.fromkeys(self._transfer_ids, raw["Counter"])
        packing = self._packings[self._pages(raw)]
        payload = packing.pack_one({**raw, **self._page_numbers, **transfer_ids})
        crc = record_crc_one(payload, data_id, self._crc_offset).to_bytes(CRC_BYTES, "little")
        return payload[: self._crc_offset] + crc + payload[self._crc_offset + CRC_BYTES :]

    def unpack_one(self, payload: bytes, data_id: int) -> dict[str, int] | Reason:
        """Return the raw values of a record; MIXED or CRC if it is damaged, or LENGTH."""
        pages = len(payload) // PAGE_BYTES
        if len(payload) % PAGE_BYTES or pages not in self._packings:
            return Reason.LENGTH
        raw = self._packings[pages].unpack_one(payload)
        transfer = raw["Counter"] & self._transfer_mask
        for page in range(pages):
            if raw[f"{PAGE}{page}"] != page or raw[f"{TRANSFER_ID}{page}"] != transfer:
                return Reason.MIXED
        if raw["Crc"] != record_crc_one(payload, data_id, self._crc_offset):
            return Reason.CRC
        return raw if self._pages(raw) == pages else Reason.LENGTH

    def pack(
        self, raw: Mapping[str, NDArray[np.int64]], data_ids: NDArray[np.uint16]
    ) -> NDArray[np.uint8]:
        """Return (N, record bytes) records of (N,) raw values by signal: as ``pack_one``."""
        n, record_bytes = len(data_ids), self._layout.record_bytes
        if n <= FEW:
            rows = zip(*(values.tolist() for values in raw.values()), strict=True)
            records = [
                self.pack_one(dict(zip(raw, row, strict=True)), data_id)
                for row, data_id in zip(rows, data_ids.tolist(), strict=True)
            ]
            joined = np.frombuffer(b"".join(records), dtype=np.uint8)
            return joined.reshape(n, record_bytes).copy()
        numbers = {name: np.full(n, page) for name, page in self._page_numbers.items()}
        transfer_ids = dict.fromkeys(self._transfer_ids, raw["Counter"])
        payloads = self._packings[self._layout.pages].pack({**raw, **numbers, **transfer_ids}, n)
        crc = record_crc(payloads, data_ids, self._crc_offset)
        payloads[:, self._crc_offset] = crc & 0xFF
        payloads[:, self._crc_offset + 1] = crc >> 8
        return payloads

    def unpack(
        self, payloads: NDArray[np.uint8], data_ids: NDArray[np.uint16]
    ) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.int8]]:
        """Return the (N,) raw values of records by signal, and their (N,) ``VERDICTS``.

        The verdicts are MIXED or CRC if a record is damaged: as ``unpack_one``.
        """
        raw = self._packings[self._layout.pages].unpack(payloads)
        verdict = np.zeros(len(payloads), dtype=np.int8)
        crc = record_crc(payloads, data_ids, self._crc_offset)
        verdict[raw["Crc"] != crc] = VERDICTS.index(Reason.CRC)
        transfer = raw["Counter"] & self._transfer_mask
        for page in range(self._layout.pages):
            mixed = (raw[f"{PAGE}{page}"] != page) | (raw[f"{TRANSFER_ID}{page}"] != transfer)
            verdict[mixed] = VERDICTS.index(Reason.MIXED)
        return raw, verdict

    def _pages(self, raw: Mapping[str, int]) -> int:
        """Return the number of pages of a record with these raw values."""
        return self._layout.pages if raw.get("HasCovariance", 1) else self._layout.short_pages


def _packing(layout: Layout | PoseLayout, pages: int) -> Packing:
    """Return the packing of the first pages of a record."""
    signals = [s for s in layout.signals.values() if s.start < 8 * PAGE_BYTES * pages]
    return Packing(signals, PAGE_BYTES * pages)
