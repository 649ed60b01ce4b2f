"""The HTML report in a browser: skipped without Chromium (Debian: chromium)."""

from collections.abc import Iterator
from typing import Any

import pytest
from support.browser import CHROMIUM, Browser
from support.sweep_tables import SETS

READY = 'document.documentElement?.dataset.ready === "yes" && Bokeh.documents.every(d => d.is_idle)'


@pytest.fixture(scope="module")
def browser(report: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        started.open(report)
        started.wait_for(READY)
        yield started


def painted(browser: Any) -> Any:
    """Return for each plot whether its canvas is not empty."""
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


def model(name: Any, test: Any) -> str:
    """Return JavaScript for the first model of a type that passes a test."""
    return f'[...models()].find(m => m.type === "{name}" && ({test}))'


def test_all_plots_are_drawn_and_no_request_leaves(browser: Any, report: Any) -> None:
    """For each set: two plots along the road and of the worst cases, one in other sections."""
    assert painted(browser) == [True] * 8 * len(SETS)
    assert browser.requests[0] == report.resolve().as_uri()
    assert {url.split(":")[0] for url in browser.requests[1:]} <= {"data", "blob"}
    assert browser.errors == []


def test_a_code_and_a_set_can_be_hidden(browser: Any) -> None:
    """A code hides its curves in all plots, a set its figures."""

    def click(kind: Any, value: Any) -> None:
        browser.run(
            f"""document.querySelector('[data-controls="{kind}"][value="{value}"]').click()"""
        )

    def shown() -> Any:
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


def test_the_choices_change_the_plots(browser: Any) -> None:
    """The lists choose another KL and another worst case."""

    def choose(control: Any, value: Any) -> None:
        browser.run(
            f"""(s => {{ s.value = "{value}"; s.dispatchEvent(new Event("change")); }})
            (document.querySelector('select[data-controls="{control}"]'))"""
        )
        browser.wait_for(READY)

    label = model("LogAxis", "m.axis_label?.startsWith?.('KL of the true Gaussian')")
    assert browser.run(f"{label} === undefined")
    choose("kl", "kl_untouched_mean")
    assert browser.run(f"{label} !== undefined")
    choose("worst", "LinearNearest 2")
    assert browser.run(model("Title", "m.text.startsWith('LinearNearest: KL')") + " !== undefined")
    assert painted(browser) == [True] * 8 * len(SETS)
    assert browser.errors == []


def test_ink_is_light_on_a_dark_page(browser: Any) -> None:
    axes = "models().filter(m => /^(Linear|Log)Axis$/.test(m.type))"
    ink = f"[...new Set({axes}.map(m => m.axis_line_color))]"
    browser.scheme("dark")
    browser.wait_for(f"{ink}[0] === '#e4e4e4'")
    assert browser.run(ink) == ["#e4e4e4"]
    assert browser.run("getComputedStyle(document.body).backgroundColor") == "rgb(21, 23, 26)"
    browser.scheme("light")
    browser.wait_for(f"{ink}[0] === '#222222'")


def test_pictures_of_the_plots_are_printed(browser: Any) -> None:
    """Pictures replace the canvases only while the page is printed."""
    pictures = "[...document.querySelectorAll('img.print')].map(p => p.src.length > 3000)"
    browser.run("dispatchEvent(new Event('beforeprint'))")
    assert browser.run(pictures) == [True] * 9 * len(SETS)
    browser.run("dispatchEvent(new Event('afterprint'))")
    assert browser.run(pictures) == []
    assert browser.errors == []


def test_it_fits_a_phone(browser: Any) -> None:
    """Nothing is wider than the page, and the plots shrink with it."""
    browser.resize(360, 700)
    browser.wait_for("document.documentElement.scrollWidth <= 360")
    plots = "[...document.querySelectorAll('.bk-Figure')].map(p => p.getBoundingClientRect().right)"
    browser.wait_for(f"Math.max(...{plots}) <= 360")
    browser.resize(1300, 900)
