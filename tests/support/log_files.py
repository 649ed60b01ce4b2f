"""Writers of logs of other tools, from their descriptions: independent of the readers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from hypothesis import strategies as st

from maplines_can.bus import LogFrame, Skipped

#: A day on which the sessions of BUSMASTER start, and 23:59:58.5 on it [s].
DAY = datetime(2012, 6, 29, tzinfo=UTC).timestamp()
START = DAY + 86_398.5


class Other(NamedTuple):
    """Row that is no data frame: what it is counted as; None if it is not counted."""

    text: str
    kind: Skipped | None


Rows = Sequence[LogFrame | Other]


def frames(
    step_ns: int, channels: Sequence[str], *, lengths: Sequence[int] = range(9), start: float = 0.0
) -> st.SearchStrategy[list[LogFrame]]:
    """Frames in the order of their times, which are multiples of a step."""

    def of(drawn: tuple[bool, int, bytes, str, int], t_ns: int) -> LogFrame:
        is_extended, number, data, channel, _ = drawn
        can_id = number % (2**29 if is_extended else 2**11)
        is_extended = is_extended and can_id > 0x7FF
        return LogFrame(can_id, data, t_ns, is_extended, channel, has_time=True)

    def timed(drawn: list[tuple[bool, int, bytes, str, int]]) -> list[LogFrame]:
        t_ns, found = round(start * 1e9), []
        for one in drawn:
            t_ns += one[4] * step_ns
            found.append(of(one, t_ns))
        return found

    data = st.sampled_from([*lengths]).flatmap(lambda n: st.binary(min_size=n, max_size=n))
    one = st.tuples(
        st.booleans(), st.integers(0, 2**29 - 1), data, st.sampled_from([*channels]),
        st.integers(0, 10**10 // step_ns),
    )  # fmt: skip
    return st.lists(one, min_size=1, max_size=8).map(timed)


def savvycan(rows: Rows, *, directions: bool = True) -> str:
    """Return a CSV of SavvyCAN, with and without the column of the direction."""
    head = f"Time Stamp,ID,Extended,{'Dir,' * directions}Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"

    def text(row: LogFrame | Other) -> str:
        if isinstance(row, Other):
            return row.text
        cells = [str(row.t_ns // 1000), f"{row.can_id:08X}", str(row.is_extended).lower()]
        cells += ["Rx"] * directions + [row.channel, str(len(row.data))]
        return ",".join([*cells, *(f"{byte:02X}" for byte in row.data.ljust(8, b"\0")), ""])

    return head + "".join(f"{text(row)}\n" for row in rows)


def crtd(rows: Rows) -> str:
    """Return a CRTD log of version 3; the bus 1 is left out."""

    def text(row: LogFrame | Other) -> str:
        if isinstance(row, Other):
            return row.text
        seconds, rest = divmod(row.t_ns // 1000, 10**6)
        bus = "" if row.channel == "1" else row.channel
        kind = f"{bus}R{'29' if row.is_extended else '11'}"
        return " ".join(
            [f"{seconds}.{rest:06d}", kind, f"{row.can_id:03x}", *(f"{b:02x}" for b in row.data)]
        )

    return "0.000001 CXX OVMS CRTD\n0.000002 CVR 3.0\n" + "".join(f"{text(row)}\n" for row in rows)


def busmaster(mode: str, *, is_decimal: bool = False) -> Callable[[Rows], str]:
    """Return the writer of a log of BUSMASTER in a mode: ABSOLUTE, RELATIVE or SYSTEM."""

    def write(rows: Rows) -> str:
        last = 0

        def stamp(row: LogFrame) -> str:
            nonlocal last
            units = row.t_ns // 100_000
            units, last = units - (last if mode == "RELATIVE" else 0), units
            seconds, rest = divmod(units, 10_000)
            seconds = seconds % 86_400 if mode == "SYSTEM" else seconds
            return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}:{rest:04d}"

        def text(row: LogFrame | Other) -> str:
            if isinstance(row, Other):
                return row.text
            can_id = f"{row.can_id:04d}" if is_decimal else f"0x{row.can_id:03X}"
            kind = ("x" if row.is_extended else "s") + "-fd" * (len(row.data) > 8)
            data = [f"{byte:03d}" if is_decimal else f"{byte:02X}" for byte in row.data]
            return " ".join([stamp(row), "Rx", row.channel, can_id, kind, str(len(data)), *data])

        head = ["BUSMASTER Ver 3.2.2", "PROTOCOL CAN", "[START LOGGING SESSION]"]
        head += ["START DATE AND TIME 29:6:2012 23:59:58:500", "DEC" if is_decimal else "HEX"]
        head += [f"{mode} MODE", "START CHANNEL BAUD RATE", "CHANNEL 1 - Simulation - 500 Kbps"]
        head += ["END CHANNEL BAUD RATE", "<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>"]
        tail = ["END DATE AND TIME 30:6:2012 0:0:51:391", "[STOP LOGGING SESSION]"]
        texts = [f"***{one}***" for one in head] + [text(row) for row in rows]
        return "\n".join([*texts, *(f"***{one}***" for one in tail), ""])

    return write
