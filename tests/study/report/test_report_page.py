"""The HTML report: its content, the code that it recommends, and errors for unusable tables."""

import math
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.study_helpers import small
from support.sweep_tables import SETS, USED, N, write

from maplines_can.cli import main
from maplines_can.study.report.page import choices, write_report
from maplines_can.study.report.results import Tables, read_tables
from maplines_can.study.sweep.run import run_study
from maplines_can.values.errors import MissingExtraError, StudyError


class Page(HTMLParser):
    """Elements, text and links of an HTML page."""

    def __init__(self, text: Any) -> None:
        super().__init__()
        self.elements, self.texts, self.links, self._in = list[Any](), list[Any](), list[Any](), ""
        self.feed(text)

    def handle_starttag(self, tag: Any, attrs: Any) -> None:
        self.elements.append((tag, dict(attrs)))
        self._in = tag
        self.links += [value for name, value in attrs if name in ("src", "href", "action", "data")]

    def handle_data(self, data: Any) -> None:
        if self._in not in ("script", "style"):
            self.texts.append(data)

    def text(self) -> Any:
        return " ".join("".join(self.texts).split())


@pytest.fixture(scope="module")
def page(report: Any) -> Any:
    return Page(report.read_text("utf-8"))


@pytest.fixture(scope="module")
def one_set(rows: Any) -> Any:
    """The tables of the first set alone."""
    return {
        name: [row for row in of_table if row.get("set", SETS[0]) == SETS[0]]
        for name, of_table in rows.items()
    }


def test_nothing_is_loaded_from_other_files(page: Any, report: Any) -> None:
    """There is no link and no import, and the content security policy forbids them."""
    assert page.links == []
    style = re.search(r"<style>(.*?)</style>", report.read_text("utf-8"), re.DOTALL)[1]  # type: ignore[index]
    assert "url(" not in style
    assert "@import" not in style
    policy = next(a["content"] for tag, a in page.elements if tag == "meta" and "content" in a)
    assert policy.startswith("default-src 'none'")
    assert not re.search(r"https?:|\*", policy)
    assert report.stat().st_size < 4e6


def test_every_code_set_and_section_is_there(page: Any) -> None:
    """Each code has a toggle, each set and section a figure."""
    toggles = [a["value"] for t, a in page.elements if a.get("data-controls") == "code"]
    assert toggles == USED
    assert [a for t, a in page.elements if t == "h2"] == [{}] * 9
    figures = [a for t, a in page.elements if t == "figure"]
    assert len(figures) == 6 * len(SETS)
    assert all(SETS[int(a["data-set"])] in a["aria-label"] for a in figures)
    assert len([a for t, a in page.elements if t == "table"]) == 3 + 7 * len(SETS)


def test_codes_on_scenes_are_shown_with_their_bits_over_the_joint_limit(page: Any) -> None:
    """For 4 and 8 lines."""
    for text in ("40 scenes of 4 lines", "Cholesky32.0616840308100100 %",
                 "PoseConditional32.06168403081000"):  # fmt: skip
        assert text in page.text()


def test_a_name_is_text_and_never_markup(page: Any, report: Any) -> None:
    """Names of sets, which may be paths, are escaped, also in the script of the plots."""
    assert all(tag not in ("img", "b") for tag, _ in page.elements)
    assert SETS[1] in page.text()
    assert "</script><img" not in report.read_text("utf-8")


def test_the_findings_are_those_of_the_tables(page: Any, folder: Any) -> None:
    """Shares and KL of the first code, bits above the limit, and infinite values."""
    tables = read_tables(folder)
    row = tables.shipped("paper", "Cholesky")
    text = page.text()

    assert f"Cholesky: 0 not definite and 0 overconfident of {2 * N:,} Gaussians." in text
    limit = 34.0 + 5 * math.log2(1e-2 / row["kl_mean"])  # type: ignore[index]
    assert tables.over_limit(row) == pytest.approx(105 - limit)  # type: ignore[arg-type]
    assert f"{105 - limit:.0f} to {107 - limit:.0f}" in text
    assert "No guarantee was broken" in text
    bad = tables.shipped("paper", "LinearNearest")
    assert 0 < bad["not_positive_definite"] < 1  # type: ignore[index]
    assert math.isinf(bad["kl_mean"])  # type: ignore[index]
    assert f"{100 * bad['not_positive_definite']:.3g} %" in text  # type: ignore[index]
    assert "∞" in text
    assert "nan" not in text.lower().replace("finance", "")


def test_a_broken_guarantee_and_missing_sections_are_reported(one_set: Any, tmp_path: Path) -> None:
    """A sweep without fields, worst cases, limit and scenes still gives a report."""
    summary = [dict(row) for row in one_set["summary"]]
    summary[0]["overconfident"] = 0.01
    folder = write(tmp_path / "sweep", one_set, summary=summary)
    for name in ("fields", "worst", "limit", "scenes"):
        schema = pq.read_schema(folder / f"{name}.parquet")
        pq.write_table(schema.empty_table(), folder / f"{name}.parquet")
    text = Page(write_report(folder, tmp_path / "a.html").read_text("utf-8")).text()
    assert "A guarantee is broken. Cholesky on paper: overconfident 1 %." in text
    assert text.count("The sweep did not compute this.") == 3
    assert "Scenes: lines of one pose The sweep did not compute this." in text


def test_the_limit_is_linear_in_log_kl(folder: Any) -> None:
    """Inside the table and below it; it is not defined for a large KL."""
    tables = read_tables(folder)

    for kl in (3e-2, 1e-2, 2e-3, 1e-4, 1e-7):
        assert tables.limit_bits("paper", kl) == pytest.approx(34 + 5 * math.log2(1e-2 / kl))
    for kl in (0.2, 0.0, math.inf, math.nan):
        assert tables.limit_bits("paper", kl) is None
    assert tables.limit_bits("another", 1e-3) is None


def test_the_tables_of_a_sweep_are_read(tmp_path: Path) -> None:
    """Sweep and report use the same names of columns."""
    study = small(n=200, chunk_size=200, fields_n=200, scenes_n=1)
    run_study(study, tmp_path / "sweep", jobs=1)
    text = Page(write_report(tmp_path / "sweep", tmp_path / "a.html").read_text("utf-8")).text()
    assert "Cholesky: 0 not definite and 0 overconfident of 200 Gaussians." in text


def test_item_12_the_page_leads_with_the_choice_and_defines_its_terms(
    one_set: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Outliers do not reach the headline; each plot has a legend; the title is escaped."""
    summary = [each | ({"kl_mean": 1.9e10} if each["code"] == "Cholesky" else {})
               for each in one_set["summary"]]  # fmt: skip
    folder = write(tmp_path / "sweep", one_set, summary=summary)
    out = tmp_path / "a.html"
    assert main(["study", "report", str(folder), "--out", str(out), "--title", "a<b>&"]) == 0
    assert "a.html: " in capsys.readouterr().err
    for tag in ("title", "h1"):
        assert f"<{tag}>a&lt;b&gt;&amp;</{tag}>" in out.read_text("utf-8")
    page = Page(out.read_text("utf-8"))
    text = page.text()
    assert text.index("Which code to choose") < text.index("choose Cholesky") < text.index("Terms")
    head = text[: text.index("The numbers")]
    assert "1.9e+10" not in head
    assert "KL, median" in head
    assert "KL, 99 %" in head
    for term in ("Map line", "Covariance", "Set", "paper", "DBC", "Covered target", "KL", "nat",
                 "Saturated", "Limit", "Not definite", "Overconfident"):  # fmt: skip
        assert term in page.texts
    assert sum(1 for tag, a in page.elements if tag == "p" and a.get("class") == "key") >= 4


# ---- errors -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda path: path.unlink(), r"summary\.parquet: is missing"),
        (lambda path: path.write_bytes(path.read_bytes()[:-100]), "cannot be read as Parquet"),
        (lambda path: path.write_text("set,code\n"), "cannot be read as Parquet"),
        (lambda path: pq.write_table(pq.read_table(path).drop_columns(["kl_mean", "n"]), path),
         "lacks the columns n, kl_mean"),
        (lambda path: pq.write_table(pq.read_schema(path).empty_table(), path), "has no rows"),
    ],
    ids=["missing", "cut-short", "not-parquet", "columns", "no-rows"],
)  # fmt: skip
def test_unusable_tables_raise(rows: Any, tmp_path: Path, damage: Any, words: str) -> None:
    """The message names the file, and nothing is written."""
    damage(write(tmp_path / "sweep", rows) / "summary.parquet")
    with pytest.raises(StudyError, match=words):
        write_report(tmp_path / "sweep", tmp_path / "out" / "report.html")
    with pytest.raises(StudyError, match="there is no such folder"):
        write_report(tmp_path / "nowhere", tmp_path / "out" / "report.html")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("package", ["bokeh", "jinja2", "pyarrow"])
def test_a_missing_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, folder: Any, tmp_path: Path, package: str
) -> None:
    for name in [n for n in sys.modules if n.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, package, None)

    with pytest.raises(MissingExtraError, match=r'pip install -e "\.\[study\]"'):
        write_report(folder, tmp_path / "report.html")


# ---- the choice of a code -----------------------------------------------------------------------


def row(code: str, frames: int, kl: float, **more: Any) -> dict[str, Any]:
    """Return what the choice reads of a row of the summary."""
    return {
        "set": "road",
        "code": code,
        "finer_bits": 0,
        "classic_frames": frames,
        "covariance_bits": 25 * frames,
        "not_positive_definite": 0.0,
        "overconfident": 0.0,
        "definite_guarantee": False,
        "covering_guarantee": False,
        "kl_p99": kl,
    } | more


def chosen(*rows: dict[str, Any]) -> list[tuple[str, str]]:
    tables = Tables(list(rows), [], [], [], [])
    return [(choice.advice, choice.reason) for choice in choices(tables)]


def test_item_12_the_least_kl_of_the_valid_codes_is_chosen() -> None:
    """A code that is overconfident is not valid, however small its KL; the reason names both."""
    ((advice, reason),) = chosen(
        row("Good", 4, 0.01, definite_guarantee=True, covering_guarantee=True),
        row("Wide", 4, 3.0),
        row("Narrow", 4, 1e-9, overconfident=0.25),
        row("Broken", 4, 1e-9, not_positive_definite=0.5),
        row("Nothing", 4, 40.0, covariance_bits=0),
    )
    assert advice == "For 4 classic CAN frames choose Good: 100 bits for the covariance."
    assert "by construction" in reason
    assert "a KL up to 0.01 nat, as if all four standard deviations were 5.2 % too large" in reason
    assert "the least of the valid codes: 3 nat with Wide." in reason
    assert "Narrow is overconfident for up to 25 % of the Gaussians" in reason
    assert "Broken is not positive definite for up to 50 % of the Gaussians" in reason
    assert "Nothing sends no covariance" in reason


def test_item_12_the_worst_set_decides() -> None:
    """A code that is valid on one set only is not chosen, nor one that is better on one set."""
    ((advice, _),) = chosen(
        row("Even", 4, 0.02),
        row("Even", 4, 0.02, set="paper"),
        row("Uneven", 4, 0.001),
        row("Uneven", 4, 0.5, set="paper"),
        row("Invalid", 4, 0.001),
        row("Invalid", 4, 0.001, set="paper", overconfident=1e-4),
        row("Missing", 4, 0.0001),
    )
    assert advice.startswith("For 4 classic CAN frames choose Even:")


def test_item_12_there_is_a_choice_where_it_changes() -> None:
    """None where no code is valid; more frames only if they improve the KL."""
    advice = [
        text
        for text, _ in chosen(
            row("Bad", 1, 1.0, overconfident=0.1),
            row("Good", 4, 0.01),
            row("Good", 5, 0.001, finer_bits=2),
            row("Late", 6, 0.1),
        )
    ]
    assert advice == [
        "For 1 classic CAN frame choose none.",
        "For 4 classic CAN frames choose Good: 100 bits for the covariance.",
        "For 5 classic CAN frames choose Good with 2 bits more in each field: 125 bits for the "
        "covariance.",
    ]


@pytest.mark.parametrize("kl", [math.nan, math.inf])
def test_a_kl_that_is_not_finite_is_the_worst(kl: float) -> None:
    ((advice, _),) = chosen(row("Endless", 4, kl), row("Good", 4, 9.0))
    assert "choose Good" in advice
