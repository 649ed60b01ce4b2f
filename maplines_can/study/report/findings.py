"""What the tables of a sweep say, in sentences and in a few large numbers, as HTML."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from typing import TYPE_CHECKING

from .tables import Row, Tables, number
from .text import swatch

if TYPE_CHECKING:
    from .parts import Look

__all__ = ["findings", "headline"]


def headline(tables: Tables) -> str:
    """The sentence on the first code, and its numbers on each set."""
    code = tables.codes[0]
    rows = [row for set_ in tables.sets if (row := tables.shipped(set_, code))]
    n = sum(row["n"] for row in rows)
    bad, narrow = (
        sum(round(row[c] * row["n"]) for row in rows)
        for c in ("not_positive_definite", "overconfident")
    )
    cards = "".join(_card(tables, row) for row in rows)
    seeds = ", ".join(str(seed) for seed in dict.fromkeys(row["seed"] for row in tables.summary))
    return (
        f"<p><strong>{escape(code)}: {bad:,} not definite and {narrow:,} overconfident of "
        f"{n:,} Gaussians.</strong> Its covariance takes {rows[0]['covariance_bits']} bits, "
        f"a line {rows[0]['classic_frames']} classic CAN frames.</p>\n"
        f'<div class="cards">{cards}</div>\n'
        f'<p class="soft">KL in nat, of the covered target; ± are two standard errors. '
        f"Seed {escape(seeds)}.</p>"
    )


def _card(tables: Tables, row: Row) -> str:
    cells = (
        ("not definite", _percent(row["not_positive_definite"]), row["not_positive_definite"]),
        ("overconfident", _percent(row["overconfident"]), row["overconfident"]),
        (f"KL, mean; 99 %: {number(row['kl_p99'])}", number(row["kl_mean"]), None),
        ("bits over the limit at that KL", tables.over_text(row), None),
    )
    inside = "".join(
        f"<div><dt>{escape(words)}</dt><dd{_class(bad)}>{escape(value)}</dd></div>"
        for words, value, bad in cells
    )
    return (
        f'<section class="card"><h3>{escape(row["code"])} on {escape(row["set"])}, '
        f"n = {row['n']:,}</h3><dl>{inside}</dl></section>"
    )


def findings(tables: Tables, looks: Mapping[str, Look]) -> str:
    """All codes as their DBCs have them, and what else is worth knowing, in sentences."""
    items = "\n".join(f"<li>{text}</li>" for text in _sentences(tables))
    return f'{_board(tables, looks)}\n<ul class="findings">\n{items}\n</ul>'


def _board(tables: Tables, looks: Mapping[str, Look]) -> str:
    """A row for each code, a group of columns for each set."""
    heads = ("not definite", "overconfident", "saturated", "KL, mean", "over the limit")
    groups = "".join(
        f'<th scope="colgroup" colspan="{len(heads)}" data-set="{i}">{escape(set_)}</th>'
        for i, set_ in enumerate(tables.sets)
    )
    columns = "".join(
        f'<th scope="col" data-set="{i}"{_edge(k)}>{words}</th>'
        for i, _ in enumerate(tables.sets)
        for k, words in enumerate(heads)
    )
    lines = []
    for code, look in looks.items():
        cells = [f'<th scope="row">{swatch(look.marker, look.colour)} {escape(code)}</th>']
        known = [row for set_ in tables.sets if (row := tables.shipped(set_, code))]
        cells += [f"<td>{known[0]['covariance_bits']}</td><td>{known[0]['classic_frames']}</td>"]
        for i, set_ in enumerate(tables.sets):
            row = tables.shipped(set_, code)
            if row is None:
                cells.append(f'<td data-set="{i}" colspan="{len(heads)}">none</td>')
                continue
            shares = [row[c] for c in ("not_positive_definite", "overconfident", "saturated")]
            texts = [_percent(value) for value in shares]
            classes = [_class(shares[0]), _class(shares[1]), "", "", ""]
            texts += [number(row["kl_mean"]), tables.over_text(row)]
            cells += [
                f'<td data-set="{i}"{_edge(k)}><span{kind}>{escape(text)}</span></td>'
                for k, (text, kind) in enumerate(zip(texts, classes, strict=True))
            ]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return (
        '<div class="scroll"><table class="board"><thead><tr><td></td>'
        f'<th scope="colgroup" colspan="2">a line</th>{groups}</tr><tr><th scope="col">code</th>'
        f'<th scope="col">bits of the covariance</th><th scope="col">classic frames</th>{columns}'
        f"</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _edge(k: int) -> str:
    return "" if k else ' data-edge=""'


def _class(bad: float | None) -> str:
    return "" if bad is None else ' class="bad"' if bad > 0 else ' class="good"'


def _percent(value: float) -> str:
    return f"{number(100 * value)} %" if value else "0"


def _sentences(tables: Tables) -> Iterator[str]:
    broken = [
        f"{_where(row)}: {words} {_percent(row[column])}"
        for row in tables.summary
        for column, guarantee, words in (
            ("not_positive_definite", "definite_guarantee", "not definite"),
            ("overconfident", "covering_guarantee", "overconfident"),
        )
        if row[guarantee] and row[column] > 0
    ]
    if broken:
        yield f'<strong class="bad">A guarantee is broken.</strong> {"; ".join(broken)}.'
    else:
        yield "No guarantee was broken: not by any code that gives one, at any width."
    shipped = [row for set_ in tables.sets for row in tables.shipped_of(set_)]
    failed = {
        row["code"] for row in shipped if row["not_positive_definite"] + row["overconfident"] > 0
    }
    sound = [code for code in tables.codes if code not in failed]
    if sound:
        yield (
            "Always definite and never overconfident, as their DBCs have them: "
            f"{', '.join(map(escape, sound))}."
        )
    for set_ in tables.sets:
        spent = [
            (over, row)
            for row in tables.summary
            if row["set"] == set_
            and row["overconfident"] == 0
            and (over := tables.over_limit(row)) is not None
        ]
        if spent:
            _, row = min(spent, key=lambda pair: pair[0])
            yield (
                f"Nearest to the limit, of what was never overconfident: {_where(row)} with "
                f"{tables.over_text(row)} bits over it, at a KL of {number(row['kl_mean'])}."
            )
    caveats = {
        str(row["caveat"]): row["set"]
        for row in tables.limit
        if row["part"] == "covariance" and isinstance(row.get("caveat"), str) and row["caveat"]
    }
    for caveat, set_ in caveats.items():
        yield f"Of the limit of {escape(set_)}: {escape(caveat)}."


def _where(row: Row) -> str:
    finer = f" with fields finer by {row['finer_bits']:+d} bit" if row["finer_bits"] else ""
    return f"{escape(row['code'])}{finer} on {escape(row['set'])}"
