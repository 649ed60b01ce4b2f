"""Facts as the rows of a terminal of any size; nothing here is a terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from .estimates import Known, correlations, lane_at, parameter, place_at
from .facts import NO_FAULT, Facts
from .screen import Piece, Row, cells, fitted, padded

#: Keys, as the last row tells them.
KEYS = "q quit   p pause   r reset   f filter"
#: Height from which the road has more rows, and how many it then has.
TALL, MANY = 40, 9
#: Width from which numbers of the pose error have names.
WIDE = 100
#: Width of the names of rows.
LABEL = 11
#: Style of each state of a message.
STATES = {"VALID": "good", "INVALID": "bad"}


class Look(NamedTuple):
    """What a screen is to show.

    Args:
        name: of the bus.
        dbc: name of the DBC.
        at: where the lateral position is told [m].
        span: lateral distance from the car to the edges of the screen [m].
        plus_minus: what stands between a number and its sigma.
        band: characters of the mean and of 1, 2 and 3 sigma.
    """

    name: str
    dbc: str
    at: tuple[float, ...] = (20.0, 40.0)
    span: float = 7.0
    plus_minus: str = "±"
    band: str = "┃▓▒░"


#: What a terminal without UTF-8 shows instead.
ASCII = {"plus_minus": "+-", "band": "|=-."}


class Shown(NamedTuple):
    """What there is to show.

    Args:
        facts: of the moment.
        since: facts from which on counters count, or `NOTHING`.
        before: facts of about a second ago, for rates and cycles.
        changes: time [s] and text of each, the newest last.
        filter: what names of lines and messages contain.
        is_typing: whether the filter is being typed.
        is_paused: whether the picture stands still.
    """

    facts: Facts
    since: Facts
    before: Facts | None = None
    changes: Sequence[tuple[float, str]] = ()
    filter: str = ""
    is_typing: bool = False
    is_paused: bool = False

    def has(self, name: str) -> bool:
        """Return whether the filter lets a name pass."""
        return self.filter.lower() in name.lower()

    def count(self, *path: str) -> int:
        """Return a counter since the reset, by its keys in the facts."""
        return _member(self.facts, path) - _member(self.since, path)

    def per_second(self, *path: str) -> float | None:
        """Return how fast a counter grows; None if that is not known."""
        if self.before is None or not (elapsed := self.facts["t"] - self.before["t"]) > 0:
            return None
        return (_member(self.facts, path) - _member(self.before, path)) / elapsed

    def cycle(self, owner: str) -> float | None:
        """Return the time between records of a message [s]; None if that is not known."""
        rate = self.per_second("messages", owner, "ok")
        return 1 / rate if rate else None


def _member(facts: Any, path: Iterable[str]) -> int:
    for key in path:
        facts = facts.get(key) if facts else None
    return facts or 0


def screen(shown: Shown, look: Look, width: int, height: int) -> list[Row]:
    """Return at most ``height`` rows, none of them wider than ``width``.

    On a small screen there is what fits, by importance.
    """
    xs = sorted({0.0, *look.at})
    if height >= TALL:
        xs = [xs[-1] * k / (MANY - 1) for k in range(MANY)]
    head, lines = _head(shown, look, width), _lines(shown, look, width)
    road, lane = _road(shown, look, xs, width), _lane(shown, look, width)
    rejects, changes = _rejects(shown), _changes(shown)
    messages = _messages(shown, width)
    # in the order of the screen: rows, and importance with the rows it is for
    parts: list[tuple[list[Row], tuple[tuple[int, int], ...]]] = [
        (head, ((0, 2),)),
        (lines, ((1, len(lines)),)),
        (road, ((4, len(road)),)),
        (lane, ((3, len(lane)),)),
        (rejects, ((5, 1), (7, len(rejects)))),
        (changes, ((6, 4), (8, 10), (10, len(changes)))),
        (messages, ((9, len(messages)),)),
    ]
    given = _shares([wanted for _, wanted in parts], height - 1)
    rows: list[Row] = []
    for (part, _), n in zip(parts, given, strict=True):
        rows += part[:n] if part is changes else _some(part, n)
    rows += [[("", "")]] * (height - 1 - len(rows)) + [_keys(shown, width)]
    return [fitted(row, width) for row in rows[-height:]]


def _shares(wanted: Sequence[Sequence[tuple[int, int]]], room: int) -> list[int]:
    """Return how many rows each part gets, the most important wishes first."""
    given = [0] * len(wanted)
    wishes = sorted((rank, k, n) for k, own in enumerate(wanted) for rank, n in own)
    for _, k, n in wishes:
        more = max(0, min(n - given[k], room))
        given[k] += more
        room -= more
    return given


def _some(rows: list[Row], n: int) -> list[Row]:
    """Return the first rows; the last one says how many are missing."""
    if n >= len(rows) or n < 3:
        return rows[:n]
    hidden = len(rows) - n + 1
    return [*rows[: n - 1], [(f"  {hidden} more rows: a taller window", "dim")]]


def _head(shown: Shown, look: Look, width: int) -> list[Row]:
    """Return what and when, and how much there is on the bus."""
    facts = shown.facts
    clock = _clock(facts["t"])
    room = width - cells(clock) - 1
    what = padded(f"{look.name}   {look.dbc}", room)
    traffic = facts.get("traffic") or {}
    frames, lines = shown.per_second("traffic", "frames"), shown.per_second("lines")
    rejects = sum(_reject_counts(shown, is_fault=True).values())
    errors = shown.count("traffic", "error_frames")
    pieces: list[Piece] = []
    if shown.is_paused:
        pieces.append(("PAUSED  ", "warn"))
    if not facts.get("link", {"up": True})["up"]:
        pieces.append(("BUS IS DOWN  ", "bad"))
    load = traffic.get("load")
    pieces += [
        (f"load {_fit(None if load is None else 100 * load, 5, 1):>5} %", ""),
        (f"  {_fit(frames, 5, 0):>5} frames/s", ""),
        (f"  {_fit(lines, 4, 0):>4} lines/s", ""),
        (f"  rejects {rejects}", "bad" if rejects else ""),
        (f"  error frames {errors}", "bad" if errors else ""),
        (f"  frames {shown.count('traffic', 'frames')}  lines {shown.count('lines')}", ""),
    ]
    if shown.filter:
        pieces.insert(0, (f"filter {shown.filter}  ", "warn"))
    return [[(what, "bar"), (f" {clock}", "bar")], _whole(pieces, width)]


def _whole(pieces: list[Piece], width: int) -> Row:
    """Return the first pieces, as many as fit as a whole, but at least one."""
    while len(pieces) > 1 and sum(cells(text) for text, _ in pieces) > width:
        pieces.pop()
    return pieces


def _clock(t: float | None) -> str:
    """Return the time of day of a time [s], or the number if there is none."""
    try:
        return time.strftime("%H:%M:%S", time.localtime(t or 0.0))
    except (OverflowError, ValueError, OSError):
        return f"{t:.3g} s"


class _Column(NamedTuple):
    """A column of the table of lines: ``cell`` gives text and style of a slot."""

    title: str
    width: int
    cell: Callable[[str, Facts], Piece]
    is_right: bool = True


def _lines(shown: Shown, look: Look, width: int) -> list[Row]:
    """Return the table of the lines, with the columns that fit."""
    facts = shown.facts
    columns: list[_Column] = []
    left = width
    for column in _columns(shown, look):
        left -= column.width + bool(columns)
        if left < 0:
            break
        columns.append(column)
    rows: list[Row] = [
        _joined((padded(one.title, one.width, right=one.is_right), "dim") for one in columns)
    ]
    for slot, own in facts["slots"].items():
        if shown.has(_name(slot)):
            each = [(one, *one.cell(slot, own)) for one in columns]
            rows.append(
                _joined((padded(t, one.width, right=one.is_right), s) for one, t, s in each)
            )
    for owner, own in facts["messages"].items():
        if owner not in facts["slots"] and shown.has(_name(owner)):
            rows.append(_record(shown, owner, own, is_wide=width >= WIDE))
    if len(rows) == 1:
        rows += [[(f"  {text}", "warn")] for text in _why_none(shown)]
    return rows


def _columns(shown: Shown, look: Look) -> Iterable[_Column]:
    """Yield the columns, the most important first."""
    yield _Column("LINE", 10, lambda slot, _: (_name(slot), "bold"), is_right=False)
    yield _Column("STATE", 7, lambda _, own: _state(own["state"]), is_right=False)
    yield _Column("USABLE", 8, lambda _, own: _usable(own), is_right=False)
    yield _Column("AGE s", 5, lambda _, own: (_fit(own["age"], 5, 3), ""))
    yield _Column("CYC s", 5, lambda slot, _: (_fit(shown.cycle(slot), 5, 3), ""))
    yield _Column("LOST", 4, lambda slot, _: _lost(shown, slot))
    yield _value(look, "y_off m", 11, lambda line: parameter(line, 0))
    yield _value(look, "beta mrad", 10, lambda line: parameter(line, 1), 1e3, 1)
    for x in look.at:
        yield _value(look, f"y({x:g}) m", 11, lambda line, x=x: place_at(line, x))  # type: ignore[misc]
    yield _value(look, "c0 1/km", 11, lambda line: parameter(line, 2), 1e3)
    yield _value(look, "c1 1/km²", 11, lambda line: parameter(line, 3), 1e6, 1)
    yield _Column("x m", 9, lambda _, own: (_range(own["line"]), ""))
    yield _Column("KIND", 9, lambda _, own: ((own["line"] or {}).get("kind", "-").lower(), ""))
    yield _Column("COVARIANCE", 12, lambda _, own: (_covariance(own["line"]), ""))
    yield _Column("y_off with beta, c0, c1", 23, lambda _, own: (_correlated(own["line"]), ""))


def _value(
    look: Look,
    title: str,
    width: int,
    value: Callable[[Facts], Known | None],
    scale: float = 1.0,
    digits: int = 2,
) -> _Column:
    """Return a column of a number of each line, in a unit of 1 / scale."""

    def cell(slot: str, own: Facts) -> Piece:
        del slot
        known = None if own["line"] is None else value(own["line"])
        return _with_sigma(known, look, width, scale, digits), "" if own["usable"] else "dim"

    return _Column(title, width, cell)


def _with_sigma(
    known: Known | None, look: Look, width: int, scale: float = 1.0, digits: int = 2
) -> str:
    """Return a number and its sigma, with as many digits as fit."""
    if known is None or not math.isfinite(known.value):
        return "-"
    value, sigma = known.value * scale, known.sigma
    if sigma is None:
        return f"{_fit(value, width - len(look.plus_minus) - 1, digits, '+')}{look.plus_minus}?"
    for form in (f".{digits}f", f".{max(0, digits - 1)}f", ".1g", ".0g"):
        text = f"{value:+.{digits}f}{look.plus_minus}{sigma * scale:{form}}"
        if len(text) <= width:
            return text
    half = (width - len(look.plus_minus)) // 2
    return f"{_fit(value, half, digits, '+')}{look.plus_minus}{_fit(sigma * scale, half, digits)}"


def _fit(value: float | None, width: int, digits: int, sign: str = "") -> str:
    """Return a number within a width: with fewer digits, or as a power, or ``#`` as sheets do.

    >>> _fit(0.05, 5, 3), _fit(123.456, 5, 3), _fit(1e300, 5, 3), _fit(float("nan"), 5, 3)
    ('0.050', '123.5', '1e300', '-')
    """
    if value is None or not math.isfinite(value):
        return "-"
    texts = [f"{value:{sign}.{n}f}" for n in range(digits, -1, -1)] if abs(value) < 1e15 else []
    texts.append(f"{value:{sign}.0e}".replace("e+0", "e").replace("e+", "e"))
    return next((text for text in texts if len(text) <= width), "#" * width)


def _name(owner: str) -> str:
    return "pose error" if owner == "pose" else owner.replace("_", " ").lower()


def _state(state: str) -> Piece:
    return state, STATES.get(state, "warn")


def _usable(own: Facts) -> Piece:
    """Return whether a line may be used, or what is first to blame."""
    if own["usable"]:
        return "yes", "good"
    reasons = (
        ("left out", own["left_out"] is not None),
        ("no line", own["line"] is None),
        ("2 send", own["two_senders"]),
        ("stale", own["stale"]),
    )
    return next((text for text, applies in reasons if applies), "no"), "bad"


def _lost(shown: Shown, owner: str) -> Piece:
    if owner not in shown.facts["messages"]:
        return "-", ""
    lost = shown.count("messages", owner, "lost")
    return _fit(lost, 4, 0), "bad" if lost else ""


def _range(line: Facts | None) -> str:
    return "-" if line is None else "..".join(_fit(x, 4, 0) for x in line["x"])


def _covariance(line: Facts | None) -> str:
    if line is None:
        return "-"
    parts = "" if line["mixture"] is None else f" x{len(line['mixture'])}"
    return f"{line['status'].lower()}{parts}"


def _correlated(line: Facts | None) -> str:
    return "-" if line is None else " ".join(f"{_fit(r, 7, 3, '+'):>7}" for r in correlations(line))


def _record(shown: Shown, owner: str, own: Facts, *, is_wide: bool) -> Row:
    """Return the row of a message that is none of one line: of a scene or of the pose error."""
    scene = shown.facts["scene"]
    state, style = _state(own["state"])
    lost, style_of_lost = _lost(shown, owner)
    cells_of_scene = (("", ""), ("", "")) if scene is None else _of_scene(scene)
    pose = None if scene is None else scene["pose"]
    text = ""
    if pose is not None:
        along, across, heading = (_root(pose[k]) for k in (0, 3, 5))
        form = "  sigma: along {}, across {} m, heading {} mrad"
        form = form if is_wide else "  sigma {}, {} m, {} mrad"
        text = form.format(_fit(along, 6, 2), _fit(across, 6, 2), _fit(heading * 1e3, 6, 1))
    (usable, style_of_usable), (age, _) = cells_of_scene
    return _joined(
        (
            (padded(_name(owner), 10), "bold"),
            (padded(state, 7), style),
            (padded(usable, 8), style_of_usable),
            (padded(age, 5, right=True), ""),
            (padded(_fit(shown.cycle(owner), 5, 3), 5, right=True), ""),
            (padded(lost, 4, right=True), style_of_lost),
            *([(text, "")] if text else []),
        )
    )


def _of_scene(scene: Facts) -> tuple[Piece, Piece]:
    return ("yes", "good") if scene["usable"] else ("no", "bad"), (_fit(scene["age"], 5, 3), "")


def _root(variance: float | None) -> float:
    return math.nan if variance is None or variance < 0 else math.sqrt(variance)


def _why_none(shown: Shown) -> list[str]:
    """Return why there is no line."""
    if shown.filter and shown.facts["slots"]:
        return ["no line has a name with the text of the filter"]
    if not shown.facts.get("traffic", {}).get("frames"):
        return ["no frame yet: is the sender on, and are --channel and --bitrate right?"]
    if shown.facts["counts"].get("FOREIGN") == shown.facts["traffic"]["frames"]:
        return ["no frame is of this DBC: is --dbc right?"]
    return ["no line yet: frames of the DBC come, see the rejects"]


def _joined(pieces: Iterable[Piece]) -> Row:
    """Return pieces as a row, with a space between them."""
    row: list[Piece] = []
    for piece in pieces:
        row += [(" ", "")] * bool(row) + [piece]
    return row


def _lane(shown: Shown, look: Look, width: int) -> list[Row]:
    """Return width and centre of the ego lane."""
    found = [(x, lane_at(shown.facts, x)) for x in sorted({0.0, *look.at})]
    rows: list[Row] = []
    for k, name in enumerate(("lane width", "centre")):
        pieces: list[Piece] = [(padded(name, LABEL), "bold")]
        for x, both in found:
            value = "-" if both is None else _with_sigma(both[k], look, 11)
            pieces.append((f"{value:>11} at {x:g} m  ", ""))
        rows.append(_whole(pieces, width))
    return rows


def _road(shown: Shown, look: Look, xs: Sequence[float], width: int) -> list[Row]:
    """Return the road seen from above, the farthest x first, and an axis with the car."""
    label = 6
    n = width - label
    if n < 3:
        return []
    rows: list[Row] = []
    for x in reversed(xs):
        middle = _cross_section(shown, look, x, n)
        rows.append([(padded(f"{x:.3g} m", label), "dim"), *middle])
    axis = [" "] * n
    step = 2.0 if look.span <= 10 else 5.0 * math.ceil(look.span / 50)
    for k in range(-math.ceil(look.span / step), math.ceil(look.span / step) + 1):
        text = "^" if k == 0 else f"{k * step:+g}"
        start = _cell(k * step, look.span, n) - len(text) // 2
        if 0 <= start <= n - len(text):
            axis[start : start + len(text)] = text
    return [*rows, [(padded("y [m]", label), "dim"), ("".join(axis), "dim")]]


def _cell(y: float, span: float, n: int) -> int:
    """Return the cell of a lateral position among n; left is first."""
    return round((1 - max(-1e6, min(1e6, y / span))) / 2 * (n - 1))


def _cross_section(shown: Shown, look: Look, x: float, n: int) -> Row:
    """Return means and bands of the lines at x."""
    marks = [" "] * n
    ranks = [9] * n  # of what stands in a cell; the least counts

    def put(cell: int, rank: int, mark: str) -> None:
        if 0 <= cell < n and rank < ranks[cell]:
            ranks[cell], marks[cell] = rank, mark

    for slot, own in shown.facts["slots"].items():
        line = own["line"]
        known = place_at(line, x) if line and shown.has(_name(slot)) else None
        if known is None or not math.isfinite(known.value):
            continue
        mean = _cell(known.value, look.span, n)
        if not own["usable"]:
            put(mean, 4, ":")  # without a band, as in the page
            continue
        put(min(max(mean, 0), n - 1), 0, look.band[0] if 0 <= mean < n else "<>"[mean > 0])
        for k in (1, 2, 3):
            reach = k * (known.sigma or 0.0)
            first, last = (_cell(known.value + s * reach, look.span, n) for s in (1, -1))
            for cell in range(max(first, 0), min(last, n - 1) + 1):
                put(cell, k, look.band[k])
    return [("".join(marks), "")]


def _reject_counts(shown: Shown, *, is_fault: bool) -> dict[str, int]:
    each = {reason: shown.count("counts", reason) for reason in shown.facts["counts"]}
    return {reason: n for reason, n in each.items() if n and (reason not in NO_FAULT) == is_fault}


def _rejects(shown: Shown) -> list[Row]:
    """Return dropped frames by reason."""
    faults, others = (_reject_counts(shown, is_fault=is_fault) for is_fault in (True, False))
    texts = [", ".join(f"{reason} {n}" for reason, n in own.items()) for own in (faults, others)]
    rows: list[Row] = [
        [(padded("rejects", LABEL), "bold"), (texts[0] or "none", "bad" if faults else "good")]
    ]
    counters = {"lost": 0, "repeated": 0, "wrong_sequence": 0, "errors": 0, "no_new_data": 0}
    for key in counters:
        counters[key] = sum(
            shown.count("messages", owner, key) for owner in shown.facts["messages"]
        )
    text = ", ".join(f"{key.replace('_', ' ')} {n}" for key, n in counters.items())
    rows.append([(padded("records", LABEL), "bold"), (text, "")])
    if others:
        rows.append([(padded("no fault", LABEL), "bold"), (texts[1], "")])
    return rows


def _changes(shown: Shown) -> list[Row]:
    """Return the changes, a title first and the oldest next."""
    rows: list[Row] = [[("CHANGES, the newest first", "dim")]]
    return rows + [
        [(f"{_clock(t)}  {text}", "")] for t, text in reversed(shown.changes) if shown.has(text)
    ]


def _messages(shown: Shown, width: int) -> list[Row]:
    """Return the messages on the bus by CAN ID, in as many columns as fit."""
    title = f"{'CAN ID':<12}{'OF':<12}{'FRAMES':>9}{'BYTES':>7}{'SPACING':>9}   "
    columns = max(1, (width + 3) // len(title))
    texts = []
    for can_id, one in shown.facts.get("traffic", {}).get("messages", {}).items():
        owner = "-" if one["owner"] is None else _name(one["owner"])
        if shown.has(owner) or shown.has(can_id):
            count = shown.count("traffic", "messages", can_id, "frames")
            texts.append(
                f"{can_id:<12}{padded(owner, 11)} {_fit(count, 9, 0):>9}{one['length']:>7}"
                f"{_fit(one['spacing'], 8, 4):>9}   "
            )
    if not texts:
        return []
    n = -(-len(texts) // columns)
    rows: list[Row] = [[((title * min(columns, len(texts))).rstrip(), "dim")]]
    return rows + [[("".join(texts[k::n]).rstrip(), "")] for k in range(n)]


def _keys(shown: Shown, width: int) -> Row:
    """Return the last row: the keys, or the filter that is being typed."""
    if shown.is_typing:
        return [(padded(f"filter: {shown.filter}_   Enter keeps it, Esc does not", width), "bar")]
    keys = KEYS.replace("p pause", "p play ") if shown.is_paused else KEYS
    return [(padded(keys, width), "bar")]
