"""The command ``maplines decode``."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..bus import LogFrame, read_log
from ..logs.first_frames import FirstFrames
from ..logs.log_part import ALL, Window, of_channel
from ..values.arrays import count_text
from ..values.errors import LogError
from ..values.line import MapLine, Slot
from ..wire import (
    SCENE,
    SHIPPED,
    Decoder,
    LineCodec,
    Reason,
    SceneView,
    SlotView,
    default_dbc_path,
)
from .command_line import add_command, note, number, option_group, progress_bar, with_progress
from .file_arguments import add_force, check_new
from .frame_source import add_part, add_times, check_received, choose_dbc, note_log
from .options import (
    add_codec,
    add_cycle,
    add_scenes,
    add_transfer_timeout,
    check_scenes,
    decoder_of,
    keyed_codec,
)
from .output import (
    check_text,
    counts_text,
    is_another_scene,
    line_dict,
    lost_text,
    owner_text,
    pose_errors_text,
    scene_dict,
    write_csv,
)

if TYPE_CHECKING:
    from ..logs.log_summary import LogSummary
    from ..recordings.block_reception import LogReceiver

DESCRIPTION = """\
Print the lines in a log file, or in a pipe as they arrive, one row of JSON each. At the end,
standard error shows how many frames were dropped and why, and the end-to-end (E2E) state of each
slot and of the pose error.

If the sender states the error of the pose from which the lines of a cycle are seen, these lines
are a scene. --scenes prints the joint covariance of each scene.

With -o, the lines are written to a table instead, many times as fast: see 'Tables of lines' in
docs/recordings.md. It has the columns of --csv, and the counter and, for each x of
--at, the lateral position and its standard deviation (y40, sigma40). Frames that are dropped are in
FILE.rejects, and scenes with the width and the centre of the ego lane in FILE.scenes (--scenes);
MF4 and MCAP have all of them in one file. MCAP has the lines with their bands as a scene, too, for
the 3D view of Foxglove. A ROS 2 bag (.rosbag2, a folder) and a trace of ASAM OSI (.osi.mcap) have
points along each line; what OSI has no place for is said in its metadata. Many logs are a data set
in a folder, a file a log; the same command goes on where it was stopped.

"usable" says of a line whether a controller might have used it as it arrived: its state is VALID,
there is no second sender, it fits the message and is not too old. With --csv, a line that is
OUT_OF_RANGE or too old has empty cells instead of values.

LOG has a format of python-can (.asc .blf .csv .db .mf4 .trc), of SavvyCAN (.csv), OVMS (.crtd) or
BUSMASTER (.log), is a capture of Wireshark or tcpdump (.pcap .pcapng), or is the output of candump,
with or without -L, -t and -x. Without -L and -t it has no time stamps: "t" is null, no frame times
out, cycles without data are not counted, and the lines of a sender that restarts are dropped until
its counter has caught up. So prefer -L."""


def add_decode(commands: Any) -> None:
    """Add the command ``decode``."""
    example = (
        "maplines decode drive.blf --at 0,20,40 -o drive.parquet\n"
        "         candump -L vcan0 | maplines decode -"
    )
    parser = add_command(commands, "decode", _decode, DESCRIPTION, example)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    add_times(parser)
    add_part(parser)
    parser.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        help="log file, or - for standard input; with -o FOLDER also directories, and patterns "
        "such as 'drives/**/*.blf'",
    )
    rows = option_group(parser, "output").add_mutually_exclusive_group()
    rows.add_argument("--csv", action="store_true", help="print CSV instead of JSON")
    add_scenes(rows)
    add_tables(parser)


def _decode(arguments: argparse.Namespace) -> int:
    check_tables(arguments)
    choose_dbc(arguments)
    if arguments.out is None:
        return _print_lines(arguments)
    return write_files(arguments)


def _print_lines(arguments: argparse.Namespace) -> int:
    arguments.log = arguments.logs[0]
    codec = keyed_codec(arguments, clock=None)
    check_scenes(codec, arguments)
    if arguments.log != "-" and not arguments.scenes and arguments.time == ALL:
        return _print_blocks(arguments, codec)
    log = DecodedLog(codec, arguments)
    with closing(log.lines()) as rows:  # ends the progress bar
        try:
            if arguments.csv:
                write_csv(sys.stdout, rows, arguments.at)
            else:
                for channel, line, view in rows:
                    row = line_dict(line, view, arguments.at) | {"channel": channel}
                    print(json.dumps(row), flush=True)
        except KeyboardInterrupt:  # the counters so far are still useful
            log.status = 130
    if not log.has_time:
        note(
            "the log has no time stamps, so nothing that depends on time is checked; use candump -L"
        )
    log.note_counters()
    if log.is_empty and log.status != 130:
        check_received(arguments.log, log.first, codec, log.summary, has_failed=bool(log.status))
    return log.status


def _print_blocks(arguments: argparse.Namespace, codec: LineCodec) -> int:
    """Print the lines of a file block by block: the bytes that `DecodedLog` would print."""
    from ..recordings.block_reception import LogReceiver
    from ..recordings.blocks import read_blocks
    from ..recordings.row_texts import LineTexts

    receiver, printed, status = LogReceiver(codec, **_timing(arguments)), 0, 0
    read = read_blocks(arguments.log, times=arguments.times)
    blocks = of_channel(read, arguments.channel, arguments.log)
    if arguments.csv:
        write_csv(sys.stdout, (), arguments.at)
    try:
        for block in with_progress(blocks, " blocks"):
            texts = LineTexts(receiver.feed(block), arguments.slots, arguments.at)
            sys.stdout.write(texts.csv() if arguments.csv else texts.json())
            printed += len(texts)
    except LogError as error:  # the intact records have been read by now
        if not receiver.frames:
            raise
        note(f"error: {error}")
        status = 1
    except KeyboardInterrupt:  # the counters so far are still useful
        status = 130
    sys.stdout.flush()
    if status != 130:
        receiver.finish()
    return _note_blocks(arguments, receiver, blocks.summary, printed, status)


class DecodedLog:
    """Lines and scenes in a log, with a decoder for each channel.

    Args:
        codec: of the lines.
        arguments: options of the command.

    Raises:
        LogError: the log cannot be opened.
    """

    def __init__(self, codec: LineCodec, arguments: argparse.Namespace) -> None:
        self.status, self.has_time = 0, True
        self._codec, self._arguments = codec, arguments
        source = sys.stdin.buffer if arguments.log == "-" else arguments.log
        log = read_log(source, times=arguments.times)
        self._frames = of_channel(log, arguments.channel, arguments.log)
        self._window = Window(arguments.time)
        self.summary, self.first = self._frames.summary, FirstFrames()
        self._decoders: dict[str, Decoder] = {}
        self._scenes: dict[str, SceneView] = {}  # the newest of each channel, with --scenes
        self._lines = self._printed = self._last_ns = self._beyond = 0

    def lines(self) -> Generator[tuple[str, MapLine, SlotView], None, None]:
        """Yield the lines with their channels and the views of their slots; print the scenes."""
        try:
            for frame in with_progress(self._frames, " frames"):
                if self._window.is_over(frame.t_ns):
                    self._window.check_frames(len(self._decoders), self._arguments.log)
                    break
                if self._knows(frame):
                    yield from self._feed(frame)
        except LogError as error:  # the intact records have been read by now
            if not self._decoders:
                raise
            note(f"error: {error}")
            self.status = 1
        if self._beyond:
            note(beyond_text(self._arguments.log, self._beyond))
            self.status = 1
        for channel, decoder in self._decoders.items():
            # This counts the incomplete lines at the end of the log.
            decoder.expire(self._last_ns + 10**18)
            self._see(channel)
        for channel, scene in self._scenes.items():  # that nothing has followed
            self._print_scene(channel, scene)

    def _knows(self, frame: LogFrame) -> bool:
        """Return whether there is a decoder for the channel of a frame, now at the latest."""
        if not self._lines:
            self.first.add(frame)
        if frame.channel in self._decoders:
            return True
        if len(self._decoders) == MAX_CHANNELS:
            self._beyond += 1
            return False
        self._decoders[frame.channel] = decoder_of(self._codec, self._arguments)
        return True

    def _feed(self, frame: LogFrame) -> Iterator[tuple[str, MapLine, SlotView]]:
        """Yield the lines that a frame completes."""
        self.has_time, self._last_ns = frame.has_time, frame.t_ns
        decoder = self._decoders[frame.channel]
        found = decoder.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
        if not isinstance(found, Reason):
            self._lines += len(found)
            for line in found:
                if self._arguments.slots is not None and line.slot not in self._arguments.slots:
                    continue
                t = (line.t_ns or 0) / 1e9 if self.has_time else math.nan
                if not self._window.takes(t, self._arguments.log):
                    continue
                self._printed += 1
                view = decoder.latest(line.slot, frame.t_ns)
                yield frame.channel, line if self.has_time else replace(line, t_ns=None), view
        self._see(frame.channel)

    def _see(self, channel: str) -> None:
        """Print the scene before if there is a new one, which may still get lines."""
        if not self._arguments.scenes:
            return
        view = self._decoders[channel].latest_scene(self._last_ns)
        before = self._scenes.get(channel, view)
        is_new = is_another_scene(view, before)
        if is_new:
            self._print_scene(channel, before)
        if view.received is not None and (is_new or before is view or not view.stale):
            self._scenes[channel] = view

    def _print_scene(self, channel: str, view: SceneView) -> None:
        row = scene_dict(view) | ({} if self.has_time else {"t": None})
        if self._window.has(math.nan if row["t"] is None else row["t"]):
            print(json.dumps(row | {"channel": channel}), flush=True)

    @property
    def is_empty(self) -> bool:
        """Whether there was neither a line nor a pose error."""
        return not any(one.lines or one.pose_errors for one in self._decoders.values())

    def note_counters(self) -> None:
        """Print the counters of all frames, and the state of each slot at the end of the log."""
        note_log(self._arguments.log, self.summary)
        note_decoders(self._decoders, self._last_ns)
        note_slots(self._arguments, self._lines, self._printed)


#: No log of a car has more channels. Each one needs a decoder, some 16 kB.
MAX_CHANNELS = 256


def add_tables(parser: argparse.ArgumentParser) -> None:
    """Add the options of tables."""
    add = option_group(parser, "output").add_argument
    add(
        "--at",
        type=distances,
        default=(),
        metavar="X,...",
        help="give the lateral position and its standard deviation at these distances ahead of "
        "the car, too [m], such as 0,20,40",
    )
    add("--slots", type=slots, metavar="NAME,...", help="lines of these slots only: ego-left,...")
    add(
        "-o",
        "--out",
        metavar="FILE|FOLDER",
        help="write a table to FILE (.parquet .csv .jsonl .mf4 .mcap .rosbag2 .osi.mcap), or for "
        "many logs a data set to FOLDER",
    )
    add(
        "--format",
        choices=("parquet", "csv", "jsonl", "mf4", "mcap", "rosbag2", "osi.mcap"),
        default="parquet",
        help="format of the files in FOLDER (default: parquet)",
    )
    add("--no-bands", action="store_true", help="leave the scene out of .mcap, which is smaller")
    add_force(parser)
    scenario = option_group(parser, "output").add_argument
    scenario(
        "--jobs",
        type=number(int, 1, 1024),
        metavar="N",
        help="processes for many logs (default: one for each processor)",
    )
    scenario("--scheduler", metavar="ADDRESS", help="decode on the workers of this Dask scheduler")


def check_tables(arguments: argparse.Namespace) -> None:
    """Raise ValueError if the options contradict each other."""
    if arguments.out is None:
        if len(arguments.logs) > 1:
            raise ValueError(
                f"{len(arguments.logs)} logs: give -o FOLDER, for a data set with a file for each"
            )
        if (arguments.jobs, arguments.scheduler) != (None, None):
            raise ValueError("--jobs and --scheduler are for many logs; give -o FOLDER")


def write_files(arguments: argparse.Namespace) -> int:
    """Write the tables of one log, or of many; return the exit status."""
    from ..recordings.formats import LINES_ONLY, suffix_of

    out = Path(arguments.out)
    suffix = suffix_of(out) if out.suffix else f".{arguments.format}"
    if arguments.scenes and suffix in LINES_ONLY:
        raise ValueError(f"-o {out}: {suffix} has lines only; leave out --scenes")
    if arguments.no_bands and suffix != ".mcap":
        raise ValueError(f"-o {out}: --no-bands is for .mcap")
    if not out.suffix:
        return _write_folder(arguments, out)
    if len(arguments.logs) > 1:
        raise ValueError(f"-o {out}: many logs are a data set; give a folder, without a suffix")
    return _write_file(arguments, out, suffix)


def _write_file(arguments: argparse.Namespace, out: Path, suffix: str) -> int:
    from ..recordings.block_reception import LogReceiver
    from ..recordings.data_set import write_tables
    from ..recordings.formats import LINES_ONLY, About, beside, open_tables

    codec = keyed_codec(arguments, clock=None)
    check_scenes(codec, arguments)
    path_of = beside(out)
    is_one = suffix in (".mf4", ".mcap", *LINES_ONLY)
    others = [] if is_one else [path_of("rejects"), path_of("scenes")]
    check_new(arguments, out, *others)
    if not out.parent.is_dir():
        raise ValueError(f"-o {out}: there is no folder {out.parent}")
    (log,) = arguments.logs
    receiver = LogReceiver(codec, scenes=arguments.scenes, **_timing(arguments))
    about = About.of(codec, log, arguments.at, arguments.cycle_ms)
    writer = open_tables(path_of, about, suffix, bands=not arguments.no_bands)
    tables = _tables(arguments)
    for path in others:  # of the file that is replaced
        path.unlink(missing_ok=True)
    done = 0
    with progress_bar(" frames", unit_scale=True) as progress:

        def count(frames: int) -> None:
            nonlocal done
            done += frames
            progress(done, done)

        source: Any = sys.stdin.buffer if log == "-" else log
        written = write_tables(receiver, source, writer, tables, count)
    status = 0
    if written.damage:
        note(f"error: {written.damage}")
        status = 1
    return _note_blocks(arguments, receiver, written.summary, written.lines, status, written.files)


def _note_blocks(
    arguments: argparse.Namespace,
    receiver: LogReceiver,
    summary: LogSummary,
    kept: int,
    status: int,
    files: Sequence[Path] = (),
) -> int:
    """Print the counters of a log that was read by blocks, and its files; return the status."""
    (log,) = arguments.logs
    if receiver.beyond:
        note(beyond_text(log, receiver.beyond))
        status = status or 1
    if not receiver.has_time:
        note(
            "the log has no time stamps, so nothing that depends on time is checked; use candump -L"
        )
    note_log(log, summary)
    note_decoders(receiver.decoders, receiver.last_ns)
    note_slots(arguments, sum(one.lines for one in receiver.decoders.values()), kept)
    if files:
        note(f"written: {' '.join(map(str, files))}")
    if receiver.is_empty and (receiver.frames or not status) and status != 130:
        check_received(log, receiver.first, receiver.codec, summary, has_failed=bool(status))
    return status


def _write_folder(arguments: argparse.Namespace, folder: Path) -> int:
    from ..recordings.data_set import dropped_of, logs_of, write_data_set

    if arguments.keys:
        raise ValueError("a key is for one log: give -o FILE, once for each log")
    check_scenes(keyed_codec(arguments), arguments)
    logs = logs_of(arguments.logs)
    with progress_bar(" logs") as progress:
        results = write_data_set(
            logs,
            folder,
            f".{arguments.format}",
            _tables(arguments),
            jobs=arguments.jobs or os.cpu_count() or 1,
            scheduler=arguments.scheduler,
            progress=lambda done, total, _: progress(done, total),
        )
    bad = [result for result in results if result["error"]]
    for result in bad:
        note(f"error: {result['error']}")
    note(
        f"{count_text(sum(result['lines'] for result in results), 'line')} from "
        f"{count_text(sum(result['frames'] for result in results), 'frame')}; "
        f"logs: {len(results)}, "
        f"{len(bad)} of them with an error; dropped frames: {counts_text(dropped_of(results))}"
    )
    note_slots(arguments, *(sum(result[key] for result in results) for key in ("lines", "rows")))
    note(f"written: {folder}; {folder / 'manifest.jsonl'} has the result of each log")
    return 1 if bad else 0


def _tables(arguments: argparse.Namespace) -> Any:
    from ..recordings.data_set import Tables

    dbc = arguments.dbc
    if dbc in SHIPPED and not Path(dbc).exists():
        dbc = str(default_dbc_path(dbc))
    return Tables(
        at=arguments.at,
        dbc=None if dbc is None else str(Path(dbc).absolute()),
        encoding=arguments.encoding,
        slots=arguments.slots,
        scenes=arguments.scenes,
        times=arguments.times,
        time=arguments.time,
        channel=arguments.channel,
        bands=not arguments.no_bands,
        **_timing(arguments),
    )


def _timing(arguments: argparse.Namespace) -> dict[str, Any]:
    return {"cycle_ms": arguments.cycle_ms, "timeout_ms": arguments.transfer_timeout}


def distances(text: str) -> tuple[float, ...]:
    """Return the distances of ``--at``.

    >>> distances("0,20,-5.5")
    (0.0, 20.0, -5.5)
    """
    from ..recordings.line_tables import checked_at

    try:
        return checked_at([float(part) for part in text.split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be numbers such as 0,20,40: {error}") from None


def slots(text: str) -> tuple[Slot, ...]:
    """Return the slots of ``--slots``.

    >>> slots("ego-left,route")
    (<Slot.EGO_LEFT: 0>, <Slot.ROUTE: 7>)
    """
    try:
        return tuple(Slot[part.strip().upper().replace("-", "_")] for part in text.split(","))
    except KeyError as error:
        names = ", ".join(slot.name.lower().replace("_", "-") for slot in Slot)
        raise argparse.ArgumentTypeError(f"{error} is no slot; they are {names}") from None


def beyond_text(log: str, frames: int) -> str:
    """Return the error of frames of too many channels."""
    return (
        f"error: {log}: not read: {count_text(frames, 'frame')} of channels beyond the first "
        f"{MAX_CHANNELS}; split the log by channel"
    )


def note_slots(arguments: argparse.Namespace, received: int, kept: int) -> None:
    """Say that ``--slots`` and ``--time`` leave out all lines, if they do."""
    if received and not kept:
        names = ",".join(slot.name.lower().replace("_", "-") for slot in arguments.slots or ())
        parts = [f"of --slots {names}"] * bool(names) + ["in --time"] * (arguments.time != ALL)
        note(f"{count_text(received, 'line')}, none {' and '.join(parts)}")


def note_decoders(decoders: Mapping[str, Decoder], last_ns: int) -> None:
    """Print the counters of all frames, and the state of each owner at the end of the log."""
    each: Sequence[Decoder] = [*decoders.values()]
    total = sum((one.counts for one in each), Counter())
    has_scenes = any(SCENE in one.checks for one in each)
    left_out = sum(one.left_out for one in each)
    note(
        f"{count_text(sum(one.lines for one in each), 'line')}"
        f"{pose_errors_text(sum(one.pose_errors for one in each))} from "
        f"{count_text(sum(one.frames for one in each), 'frame')}; "
        f"{lost_text(sum(one.lost for one in each), scenes=has_scenes)}; "
        f"{count_text(left_out, 'line') + ' left out by the sender; ' if left_out else ''}"
        f"dropped frames: {counts_text({reason.name: n for reason, n in total.items()})}"
    )
    for channel, decoder in decoders.items():
        where = f"{channel} " if len(each) > 1 else ""
        for owner, stats in decoder.messages(last_ns).items():
            note(f"{where}{owner_text(owner)}: {check_text(stats)}")
