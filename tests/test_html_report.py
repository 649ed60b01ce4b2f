"""The HTML report: what is in it, what it refuses, and how it behaves in a browser.

The last part needs Chromium (Debian: chromium) and is skipped without it; CI installs it.
"""

import argparse
import math
import re
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import CHROMIUM, Browser

from maplines_can.cli.report import add_report
from maplines_can.errors import MissingExtraError, StudyError
from maplines_can.line import Status, lateral, lateral_jacobian
from maplines_can.study import LATERAL_X, evaluate, paper
from maplines_can.study.codes import CODES
from maplines_can.study.dbc.covariance_spec import covariance_signals
from maplines_can.study.dbc.record_spec import dbc_writer_for
from maplines_can.study.report.page import write_report
from maplines_can.study.report.tables import COLUMNS, read_tables
from maplines_can.wire import Codec
from maplines_can.wire.message.layout import Layout

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("bokeh")

USED = ["Cholesky", "LinearNearest", "MeanOnly"]
#: A set may be a user's file, and a file may be called anything.
SETS = ["paper", '</script><img src=x onerror="boom()"> & \'"drive.csv']
N = 400
READY = 'document.documentElement?.dataset.ready === "yes" && Bokeh.documents.every(d => d.is_idle)'


def share(name, which):
    p = float(np.mean(which))
    return {name: p, f"{name}_se": math.sqrt(p * (1 - p) / len(which))}


def rows_of(set_, code, finer_bits, mean, cov):
    """The code's own rows of summary and worst; infinities stay as they are."""
    codec = Codec(Layout.from_text(dbc_writer_for(code, finer_bits).dbc(), code))
    batch = codec.decode_batch(codec.encode_batch(mean, cov))
    verdict = evaluate(mean, cov, batch.mean, batch.cov, codec.resolution)
    kl, bits = verdict.kl_covered, sum(s.bits for s in covariance_signals(code, finer_bits))
    row = {"set": set_, "code": code, "finer_bits": finer_bits, "n": len(mean), "seed": 0}
    row |= {"covariance_bits": bits, "record_bits": 8 * codec.layout.record_bytes}
    row |= {"classic_frames": codec.layout.pages, "seconds": 0.1, "gaussians_per_second": 4e3}
    row["definite_guarantee"] = CODES[code].positive_definite
    row["covering_guarantee"] = CODES[code].covering
    row |= share("not_positive_definite", ~verdict.positive_definite)
    row |= share("overconfident", verdict.overconfident)
    row |= share("saturated", batch.status == Status.SATURATED)
    row |= share("out_of_range", batch.status == Status.OUT_OF_RANGE)
    finite = bool(np.isfinite(kl).all())
    se = float(kl.std() / math.sqrt(len(kl))) if finite else None
    row |= {"kl_mean": float(kl.mean()), "kl_mean_se": se, "kl_p50": float(np.median(kl))}
    row |= {"kl_p99": float(np.quantile(kl, 0.99, method="nearest")), "kl_max": float(kl.max())}
    row |= {"kl_untouched_mean": float(verdict.kl.mean()), "kl_untouched_mean_se": None}
    row |= {"kl_before_inflation_mean": None, "kl_theory": None}
    for i, x in enumerate(LATERAL_X):
        error, ratio = np.abs(verdict.lateral_error[:, i]), verdict.sigma_ratio[:, i]
        ratio = ratio[np.isfinite(ratio)]
        row[f"mean_error_rms_{x:g}"] = float(np.sqrt((error**2).mean()))
        row[f"mean_error_max_{x:g}"] = float(error.max())
        row[f"sigma_ratio_min_{x:g}"] = float(ratio.min())
        row[f"sigma_ratio_p50_{x:g}"] = float(np.median(ratio))
        row[f"sigma_ratio_p99_{x:g}"] = float(np.quantile(ratio, 0.99))
    worst = []
    for rank, i in enumerate(np.argsort(-kl)[:2], 1):
        case = {"set": set_, "code": code, "rank": rank, "kl": float(kl[i])}
        case["status"] = Status(int(batch.status[i])).name
        for side, m, S in (("", mean[i], cov[i]), ("decoded_", batch.mean[i], batch.cov[i])):
            case |= {f"{side}mean_{a}": m[a] for a in range(4)}
            case |= {f"{side}cov_{a}{b}": S[a, b] for a in range(4) for b in range(4)}
        worst.append(case)
    return row, worst


@pytest.fixture(scope="module")
def rows():
    """What a sweep of three codes over two sets would write."""
    made = {"summary": [], "fields": [], "worst": [], "limit": []}
    for seed, set_ in enumerate(SETS):
        mean, cov = paper(N, seed)
        for code in USED:
            for finer_bits in (0, 1) if code != "MeanOnly" else (0,):
                row, worst = rows_of(set_, code, finer_bits, mean, cov)
                made["summary"].append(row)
                made["worst"] += worst if finer_bits == 0 else []
        for field, cost in (("PivotC0", 1.3), ("RatioC0C1", 2.5), ("Inflation", 1.1)):
            for delta, kl in ((-1, 0.003 * cost), (1, 0.003 / cost)):
                field_row = {"set": set_, "code": "Cholesky", "field": field, "delta_bits": delta}
                field_row |= {"covariance_bits": 105 + delta, "kl_mean": kl, "kl_mean_se": 1e-5}
                made["fields"].append(field_row | {"saturated": 0.0, "lateral_rms_80": 6e-4})
        for part, n, bits in (("all", 14, 62.0), ("covariance", 10, 34.0)):
            for decades, kl in enumerate((1e-2, 1e-3, 1e-4)):
                point = {"set": set_, "part": part, "kl": kl, "entropy_bits": 20.0, "se_bits": 0.5}
                rise = decades * n / 2 * math.log2(10)
                made["limit"].append(point | {"bias_bits": 2.0, "bits": bits + rise})
    return made


def write(folder, rows, **changes):
    folder.mkdir(exist_ok=True)
    for name, of_table in (rows | changes).items():
        pq.write_table(pa.Table.from_pylist(of_table), folder / f"{name}.parquet")
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory, rows):
    return write(tmp_path_factory.mktemp("report") / "sweep", rows)


@pytest.fixture(scope="module")
def report(folder):
    return write_report(folder, folder.parent / "new" / "report.html")


class Page(HTMLParser):
    """Elements, text, and all that could be loaded."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.texts, self.links, self._in = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._in = tag
        self.links += [value for name, value in attrs if name in ("src", "href", "action", "data")]

    def handle_data(self, data):
        if self._in not in ("script", "style"):
            self.texts.append(data)

    def text(self):
        return " ".join("".join(self.texts).split())


@pytest.fixture(scope="module")
def page(report):
    return Page(report.read_text("utf-8"))


# ---- the file ---------------------------------------------------------------------


def test_nothing_is_loaded_from_elsewhere(page, report):
    """No link, no import; and the page itself forbids the browser to."""
    assert page.links == []
    style = re.search(r"<style>(.*?)</style>", report.read_text("utf-8"), re.DOTALL)[1]
    assert "url(" not in style
    assert "@import" not in style
    policy = next(a["content"] for tag, a in page.elements if tag == "meta" and "content" in a)
    assert policy.startswith("default-src 'none'")
    assert not re.search(r"https?:|\*", policy)
    assert report.stat().st_size < 4e6


def test_every_code_set_and_section_is_there(page):
    """Codes with their toggles, sets as their text, a figure a set and section."""
    toggles = [a["value"] for t, a in page.elements if a.get("data-controls") == "code"]
    assert toggles == USED
    assert [a for t, a in page.elements if t == "h2"] == [{}] * 6
    figures = [a for t, a in page.elements if t == "figure"]
    assert len(figures) == 6 * len(SETS)
    assert all(SETS[int(a["data-set"])] in a["aria-label"] for a in figures)
    assert len([a for t, a in page.elements if t == "table"]) == 1 + 7 * len(SETS)


def test_a_name_is_text_and_never_markup(page, report):
    """Of sets, which may be paths, and in the plots' own script too."""
    assert all(tag not in ("img", "b") for tag, _ in page.elements)
    assert SETS[1] in page.text()
    assert "</script><img" not in report.read_text("utf-8")


def test_title_is_escaped(folder, tmp_path):
    text = write_report(folder, tmp_path / "a.html", title="a<b>&").read_text("utf-8")

    assert "<title>a&lt;b&gt;&amp;</title>" in text


def test_the_findings_are_those_of_the_tables(page, folder):
    """The first code's shares and KL, bits over the limit, infinities as such."""
    tables = read_tables(folder)
    row = tables.shipped("paper", "Cholesky")
    told = page.text()

    assert f"Cholesky: 0 not definite and 0 overconfident of {2 * N:,} Gaussians." in told
    limit = 34.0 + 5 * math.log2(1e-2 / row["kl_mean"])
    assert tables.over_limit(row) == pytest.approx(105 - limit)
    assert f"{105 - limit:.0f} to {107 - limit:.0f}" in told
    assert "No guarantee was broken" in told
    bad = tables.shipped("paper", "LinearNearest")
    assert 0 < bad["not_positive_definite"] < 1
    assert math.isinf(bad["kl_mean"])
    assert f"{100 * bad['not_positive_definite']:.3g} %" in told
    assert "∞" in told
    assert "nan" not in told.lower().replace("finance", "")


def test_a_broken_guarantee_is_the_first_finding(rows, tmp_path):
    summary = [dict(row) for row in rows["summary"]]
    summary[0]["overconfident"] = 0.01
    folder = write(tmp_path / "sweep", rows, summary=summary)

    told = Page(write_report(folder, tmp_path / "a.html").read_text("utf-8")).text()

    assert "A guarantee is broken. Cholesky on paper: overconfident 1 %." in told


def test_the_limit_is_straight_in_the_logarithm_of_kl(folder):
    """Inside the table, below it, and nothing above where its law holds."""
    tables = read_tables(folder)

    for kl in (3e-2, 1e-2, 2e-3, 1e-4, 1e-7):
        assert tables.limit_bits("paper", kl) == pytest.approx(34 + 5 * math.log2(1e-2 / kl))
    for kl in (0.2, 0.0, math.inf, math.nan):
        assert tables.limit_bits("paper", kl) is None
    assert tables.limit_bits("another", 1e-3) is None


def test_what_a_sweep_left_out_is_said(rows, tmp_path):
    """Without fields, worst cases and limit there is a report all the same."""
    folder = write(tmp_path / "sweep", rows)
    for name in ("fields", "worst", "limit"):
        schema = pq.read_schema(folder / f"{name}.parquet")
        pq.write_table(schema.empty_table(), folder / f"{name}.parquet")

    told = Page(write_report(folder, tmp_path / "a.html").read_text("utf-8")).text()

    assert told.count("The sweep was told to leave this out.") == 2


def test_the_tables_of_a_sweep_are_read(tmp_path):
    """The names of the columns are the same on both sides."""
    from maplines_can.study.sets import line_set
    from maplines_can.study.sweep.plan import Study
    from maplines_can.study.sweep.run import run_study

    study = Study(
        [line_set("paper")], codes=("Cholesky", "Linear"), finer_bits=(0,), n=200, chunk_size=200,
        fields_n=200, limit_n=0,
    )  # fmt: skip
    run_study(study, tmp_path / "sweep", jobs=1)

    told = Page(write_report(tmp_path / "sweep", tmp_path / "a.html").read_text("utf-8")).text()

    assert "Cholesky: 0 not definite and 0 overconfident of 200 Gaussians." in told


# ---- the plots --------------------------------------------------------------------


def test_an_infinite_kl_has_its_place_and_its_share(folder):
    """Marked above the axis, for each width; the finite median of the same code is below."""
    from maplines_can.study.report.parts import looks
    from maplines_can.study.report.plots import kl_plot

    tables = read_tables(folder)
    plot = kl_plot(tables, "paper", looks(tables.codes))
    source = next(
        r.data_source for r in plot.renderers if r.tags == ["code:LinearNearest"]
    )  # its line
    ticks = plot.yaxis[0].major_label_overrides

    assert [ticks[y] for y in source.data["y"]] == ["∞", "∞"]
    assert all(np.isnan(source.data["path"]))
    assert all(re.fullmatch(r"[\d.]+ %", text) for text in source.data["mark"])
    median = source.tags[0]["options"]["kl_p99"]["data"]
    assert len(median["y"]) == 2
    drawn = {tag for r in plot.renderers for tag in r.tags}
    assert drawn == {f"code:{code}" for code in USED}


def test_worst_cases_are_the_lines_and_their_bands(folder):
    """l(x) and 3 sigma to first order; where a variance is negative there is a cross."""
    from maplines_can.cli.trip_text.cases import worst_key, worst_plots

    tables = read_tables(folder)
    keys = [worst_key(row) for row in tables.worst if row["set"] == "paper"]
    plot, less = worst_plots(tables, "paper", keys)
    options = plot.renderers[0].data_source.tags[0]["options"]
    for row in (row for row in tables.worst if row["set"] == "paper"):
        data = options[worst_key(row)]["data"]
        for side, prefix in (("true", ""), ("decoded", "decoded_")):
            mean = np.array([row[f"{prefix}mean_{i}"] for i in range(4)])
            S = np.array([[row[f"{prefix}cov_{i}{j}"] for j in range(4)] for i in range(4)])
            x = np.asarray(data["x"], dtype=float)
            J = lateral_jacobian(mean, x)
            variance = np.sum((J @ S) * J, axis=1)
            np.testing.assert_allclose(data[side], lateral(mean, x), rtol=1e-5, atol=1e-5)
            half = (data[f"{side}_high"] - data[f"{side}_low"]) / 2
            seen = variance > 0
            np.testing.assert_allclose(half[seen], 3 * np.sqrt(variance[seen]), rtol=1e-3)
            if side == "decoded":
                np.testing.assert_array_equal(np.isfinite(data["lost"]), variance < 0)
    relative = less.renderers[0].data_source.data
    np.testing.assert_array_equal(relative["true"], 0)


def test_fields_stand_by_what_a_bit_less_costs(folder):
    """The dearest on top."""
    from maplines_can.cli.trip_text.cases import fields_plot

    plot = fields_plot(read_tables(folder), "paper", ["Cholesky"])

    assert plot.y_range.factors == ["Inflation", "PivotC0", "RatioC0C1"]


# ---- errors -----------------------------------------------------------------------


def damaged(folder, how):
    path = folder / "summary.parquet"
    if how == "folder":
        return folder / "nowhere"
    if how == "missing":
        path.unlink()
    elif how == "corrupt":
        path.write_bytes(path.read_bytes()[:-100])
    elif how == "text":
        path.write_text("set,code\n")
    elif how == "columns":
        pq.write_table(pq.read_table(path).drop_columns(["kl_mean", "n"]), path)
    elif how == "empty":
        pq.write_table(pq.read_schema(path).empty_table(), path)
    return folder


@pytest.mark.parametrize(
    ("how", "words"),
    [
        pytest.param("folder", "there is no such folder", id="folder-missing"),
        pytest.param("missing", r"summary\.parquet: is missing", id="table-missing"),
        pytest.param("corrupt", r"summary\.parquet: cannot be read as Parquet", id="cut-short"),
        pytest.param("text", r"summary\.parquet: cannot be read as Parquet", id="not-parquet"),
        pytest.param("columns", r"summary\.parquet: lacks the columns n, kl_mean", id="columns"),
        pytest.param("empty", r"summary\.parquet: has no rows", id="no-rows"),
    ],
)
def test_what_cannot_be_reported_is_refused(rows, tmp_path, how, words):
    """In one sentence with the file's name, and nothing is written."""
    folder = damaged(write(tmp_path / "sweep", rows), how)

    with pytest.raises(StudyError, match=words):
        write_report(folder, tmp_path / "out" / "report.html")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("package", ["bokeh", "pyarrow"])
def test_without_the_extra_its_name_is_told(monkeypatch, folder, tmp_path, package):
    for name in [n for n in sys.modules if n.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, package, None)

    with pytest.raises(MissingExtraError, match=r'pip install "maplines_can\[study\]"'):
        write_report(folder, tmp_path / "report.html")


def test_the_command(folder, tmp_path, capsys):
    """Arguments go where they belong; each column that is read has been named."""
    parser = argparse.ArgumentParser()
    add_report(parser.add_subparsers())
    out = tmp_path / "report.html"
    arguments = parser.parse_args(["report", str(folder), "--out", str(out), "--title", "mine"])

    assert arguments.run(arguments) == 0
    assert "<h1>mine</h1>" in out.read_text("utf-8")
    assert "report.html: " in capsys.readouterr().err
    assert all(len(set(columns)) == len(columns) for columns in COLUMNS.values())


# ---- in a browser -----------------------------------------------------------------


@pytest.fixture(scope="module")
def browser(report, tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        started.open(report)
        started.wait_for(READY)
        yield started


def painted(browser):
    """For each plot, whether it looks otherwise than an empty one."""
    return browser.run(
        """[...document.querySelectorAll("figure .bk-Figure")].map(plot =>
            [...plot.shadowRoot.querySelector(".bk-Canvas").shadowRoot.querySelectorAll("canvas")]
            .some(c => {
                const empty = Object.assign(document.createElement("canvas"), {
                    width: c.width, height: c.height,
                });
                return c.width > 100 && c.toDataURL() !== empty.toDataURL();
            }))
        """
    )


def model(name, test):
    """JavaScript for the first model of a kind that passes a test."""
    return f'[...models()].find(m => m.type === "{name}" && ({test}))'


def test_all_plots_are_drawn_and_no_request_leaves(browser, report):
    """Two plots each of the road and the worst cases, one of the others, for each set."""
    assert painted(browser) == [True] * 8 * len(SETS)
    assert browser.requests[0] == report.resolve().as_uri()
    assert {url.split(":")[0] for url in browser.requests[1:]} <= {"data", "blob"}
    assert browser.errors == []


def test_a_code_and_a_set_can_be_hidden(browser):
    """Its curves in all plots; the figures of the set."""

    def click(kind, value):
        browser.run(
            f"""document.querySelector('[data-controls="{kind}"][value="{value}"]').click()"""
        )

    def shown():
        return browser.run(
            "models().filter(m => m.tags.includes('code:Cholesky')).map(m => m.visible)"
        )

    assert set(shown()) == {True}
    click("code", "Cholesky")
    assert set(shown()) == {False}
    click("code", "Cholesky")
    assert set(shown()) == {True}
    click("set", 1)
    visible = "[...document.querySelectorAll('figure')].filter(f => f.offsetHeight > 0).length"
    assert browser.run(visible) == 6
    click("set", 1)
    browser.wait_for(READY)
    assert browser.run(visible) == 6 * len(SETS)
    assert browser.errors == []


def test_the_choices_change_the_plots(browser):
    """Another quantity of the KL, another worst case."""

    def choose(control, value):
        browser.run(
            f"""(s => {{ s.value = "{value}"; s.dispatchEvent(new Event("change")); }})
            (document.querySelector('select[data-controls="{control}"]'))"""
        )
        browser.wait_for(READY)

    label = model("LinearAxis", "m.axis_label?.startsWith?.('KL against the untouched')")
    assert browser.run(f"{label} === undefined")
    choose("kl", "kl_untouched_mean")
    assert browser.run(f"{label} !== undefined")
    choose("worst", "LinearNearest 2")
    assert browser.run(model("Title", "m.text.startsWith('LinearNearest: KL')") + " !== undefined")
    assert painted(browser) == [True] * 8 * len(SETS)
    assert browser.errors == []


def test_ink_is_light_on_a_dark_page(browser):
    ink = "[...new Set(models().filter(m => m.type === 'LinearAxis').map(m => m.axis_line_color))]"
    browser.scheme("dark")
    browser.wait_for(f"{ink}[0] === '#e4e4e4'")
    assert browser.run(ink) == ["#e4e4e4"]
    assert browser.run("getComputedStyle(document.body).backgroundColor") == "rgb(21, 23, 26)"
    browser.scheme("light")
    browser.wait_for(f"{ink}[0] === '#222222'")


def test_pictures_of_the_plots_are_printed(browser):
    """In place of canvases as wide as the screen, and only for as long."""
    pictures = "[...document.querySelectorAll('img.print')].map(p => p.src.length > 3000)"
    browser.run("dispatchEvent(new Event('beforeprint'))")
    assert browser.run(pictures) == [True] * 8 * len(SETS)
    browser.run("dispatchEvent(new Event('afterprint'))")
    assert browser.run(pictures) == []
    assert browser.errors == []


def test_it_fits_a_phone(browser):
    """Nothing is wider than the page, and the plots shrink with it."""
    browser.resize(360, 700)
    browser.wait_for("document.documentElement.scrollWidth <= 360")
    plots = "[...document.querySelectorAll('.bk-Figure')].map(p => p.getBoundingClientRect().right)"
    browser.wait_for(f"Math.max(...{plots}) <= 360")
    browser.resize(1300, 900)
