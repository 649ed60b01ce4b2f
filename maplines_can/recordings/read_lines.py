"""Logs to tables of lines: at once, or in blocks whose memory is bounded."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import IO

from ..logs.log_part import AFTER, ALL, ChannelError, Time, Window, of_channel
from ..logs.log_summary import LogReader, Times
from ..values.errors import LogError
from ..values.line import Slot
from ..wire import Codec, LineCodec
from .block_reception import LineBlock, LogReceiver
from .blocks import BLOCK_FRAMES, FrameBlock, read_blocks
from .fitting import misfit
from .line_tables import LineTable, checked_at, joined, line_table

Log = str | PathLike[str] | IO[bytes]


def read_lines(
    log: Log,
    *,
    at: Sequence[float] = (),
    dbc: str | Path | LineCodec | None = None,
    encoding: str | None = None,
    slots: Sequence[Slot] | None = None,
    scenes: bool = False,
    cycle_ms: float | None = None,
    timeout_ms: float | None = None,
    times: Times = "auto",
    time: Time = ALL,
    channel: str | None = None,
) -> LineTable:
    """Return the lines of a log as a table, in the order of their last frames.

    The lines are those of ``Decoder.feed`` frame by frame. A line that must not be used (its status
    is OUT_OF_RANGE, or its age is infinite) has nan for its values, and so has a position at an x
    outside of the range of its line. ``usable`` is true if a controller might have used the line as
    it arrived, see ``SlotView.usable``.

    ===================  ==========================================================================
    column               meaning
    ===================  ==========================================================================
    t, t_ns              time of the first frame [s; nan if the log has no times] [ns]
    channel, slot        categories
    kind, status         categories, those of ``MapLine``
    state                E2E state after the line, see ``SlotView.state``
    usable, two_senders  as in ``SlotView``, at the time of the last frame
    counter, ahead       of the last record, and by how much it is ahead of the one before; 0 after
                         a sequence break
    components           number of components; 1 for a line that is no mixture
    age                  from the pose to the sending [s]
    x_min, x_max         range [m]
    y_off, beta, c0, c1  mean [m, rad, 1/m, 1/m^2]
    cov_y_off_beta ...   covariance, upper triangle
    y40, sigma40 ...     position at x = 40 m and its standard deviation, to first order [m]
    ===================  ==========================================================================

    Args:
        log: path of a file, or a stream; see `read_log` for the formats.
        at: distances ahead of the car [m].
        dbc: path of the DBC or its codec; that of the package by default.
        encoding: of the DBC; None to find it.
        slots: lines of these only.
        scenes: whether to give the table of scenes, too.
        cycle_ms: as in ``Codec.decoder``.
        timeout_ms: as in ``Codec.decoder``.
        times: kind of the time stamps, see `read_log`.
        time: first and last time [s] of the rows, from the first line on, or of the clock of the
            log if they are more than 1e8. They are those of the whole log; it is not read further.
        channel: frames of this one only; by default of all.

    Warns:
        UserWarning: the log is damaged; the table has what is intact. Or it has neither a line nor
            a pose error of the DBC; the warning says which DBC fits.

    Raises:
        LogError: the log cannot be opened, has no frame of the channel, or no times for ``time``.
        ValueError: a distance or a time is out of range, or the DBC has no scenes.

    >>> table = read_lines("drive.log", at=[20, 40])  # doctest: +SKIP
    >>> left = table.where(table["slot"] == "EGO_LEFT").to_pandas()  # doctest: +SKIP
    """
    tables: list[LineTable] = []
    found = line_tables(
        log,
        at=at,
        dbc=dbc,
        encoding=encoding,
        slots=slots,
        scenes=scenes,
        cycle_ms=cycle_ms,
        timeout_ms=timeout_ms,
        times=times,
        time=time,
        channel=channel,
    )
    try:
        tables.extend(found)
    except LogError as error:
        if not tables or isinstance(error, ChannelError):
            raise
        warnings.warn(str(error), stacklevel=2)
    return joined(tables)


def line_tables(
    log: Log,
    *,
    at: Sequence[float] = (),
    dbc: str | Path | LineCodec | None = None,
    encoding: str | None = None,
    slots: Sequence[Slot] | None = None,
    scenes: bool = False,
    cycle_ms: float | None = None,
    timeout_ms: float | None = None,
    times: Times = "auto",
    time: Time = ALL,
    channel: str | None = None,
    block_frames: int = BLOCK_FRAMES,
) -> Iterator[LineTable]:
    """Return an iterator over the tables of the blocks of a log.

    The last table has the scenes at the end of the log, and no lines.

    Args:
        log: as for `read_lines`, like all but the last argument.
        at: distances [m].
        dbc: path or codec.
        encoding: of the DBC.
        slots: lines of these only.
        scenes: whether to give them.
        cycle_ms: as in ``Codec.decoder``.
        timeout_ms: as in ``Codec.decoder``.
        times: kind of the time stamps, see `read_log`.
        time: of the rows.
        channel: frames of this one only.
        block_frames: most frames of a block.

    Warns:
        UserWarning: there was neither a line nor a pose error; the warning says which DBC fits.

    Raises:
        LogError: the log cannot be opened; or, after the last table, it is damaged.
        ValueError: as for `read_lines`.
    """
    codec = dbc if isinstance(dbc, LineCodec) else Codec.from_dbc(dbc, encoding=encoding)
    receiver = LogReceiver(codec, cycle_ms=cycle_ms, timeout_ms=timeout_ms, scenes=scenes)
    window = Window(time)
    blocks = of_channel(
        read_blocks(log, block_frames=block_frames, times=times), channel, name_of(log)
    )
    checked_at(at)

    def tables() -> Iterator[LineTable]:
        error = None
        try:
            yield from tables_of(
                receiver, blocks, at, slots, scenes=scenes, window=window, name=name_of(log)
            )
        except LogError as damage:
            error = damage
        if receiver.is_empty and (receiver.frames or error is None):
            why = misfit(receiver.first, [codec], blocks.summary).text.replace("--dbc ", "dbc=")
            warnings.warn(f"{name_of(log)}: {why}", stacklevel=2)
        if error is not None:
            raise error

    return tables()


def tables_of(
    receiver: LogReceiver,
    blocks: LogReader[FrameBlock],
    at: Sequence[float] = (),
    slots: Sequence[Slot] | None = None,
    *,
    scenes: bool = False,
    window: Window | None = None,
    name: str = "the log",
) -> Iterator[LineTable]:
    """Yield the tables of the blocks of a log, as `line_tables`, with a receiver of the caller.

    Raises:
        LogError: after the last table, the log is damaged; or it has no times for the window.
    """
    window = window or Window()

    def table_of(lines: LineBlock, frames: FrameBlock | None) -> LineTable:
        table = line_table(lines, frames, at, slots, scenes=scenes)
        if len(table):
            window.see(float(table["t"][0]), name)
        return replace(table if window.is_all else _within(table, window), log=blocks.summary)

    error = None
    try:
        for block in blocks:
            part = block.part(0, _end_of(block, window))
            yield table_of(receiver.feed(part), part)
            if window.is_over(int(block.t_ns.max())):
                window.check_frames(receiver.frames, name)
                break
    except LogError as damage:
        error = damage
    blocks.close()
    yield table_of(receiver.finish(), None)
    if error is not None:
        raise error


def _end_of(block: FrameBlock, window: Window) -> int:
    """Return the number of frames of a block that are not beyond a window."""
    if not window.is_over(int(block.t_ns.max())):
        return len(block)
    return int((block.t_ns / 1e9 > window.bounds[1] + AFTER).argmax())


def _within(table: LineTable, window: Window) -> LineTable:
    """Return the rows of a window."""
    lines = table.where(window.are_in(table["t"]))
    rejects, scenes = table.rejects, table.scenes
    return replace(
        table,
        columns=lines.columns,
        rejects=rejects.where(window.are_in(rejects["t"])),
        scenes=scenes.where(window.are_in(scenes["t"])) if scenes.columns else scenes,
    )


def name_of(log: Log) -> str:
    """Return the name of a log for messages."""
    return str(getattr(log, "name", log))
