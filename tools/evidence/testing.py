"""Assertions for tests of controllers: how often they find what is wrong, and false alarms."""

from __future__ import annotations

import contextlib
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import ndtri

from maplines_can import Codec, Gaussian, MapLine, Slot
from maplines_can.testing import Bench, SendingNode, assert_consistent, assert_protected

from .figures import Share
from .harness import DOCS, evidence, progress

Array = NDArray[np.float64]

#: Standard deviations that are 20 % too small.
SMALL = 0.8
PERIOD = 0.05
#: Lines that a controller averages as if their errors were independent.
AVERAGED = 4
OUTAGES = "loss=1@24.0-25.5+48.0-49.5"
#: Time for which errors last [s], and its share of the variance; the rest is white.
LASTING = {
    "nothing": (0.0, 1.0),
    "0.25 s": (0.25, 1.0),
    "0.5 s": (0.5, 1.0),
    "1 s": (1.0, 1.0),
    "3 s": (3.0, 1.0),
    "12 s": (12.0, 1.0),
    "60 s": (60.0, 1.0),
    "12 s, 30 % of the variance": (12.0, 0.3),
    "12 s, 10 % of the variance": (12.0, 0.1),
}


def verdict(check: Callable[..., object], *arguments: Any, **options: Any) -> str:
    """Return whether an assertion passes, fails, or says that the run is too short."""
    try:
        check(*arguments, **options)
    except AssertionError:
        return "fails"
    except ValueError as error:
        if "too short" not in str(error):
            raise
        return "too short"
    return "passes"


def lasting(rng: np.random.Generator, n: int, d: int, time: float, share: float) -> Array:
    """Return (n, d) errors of variance 1, of which a share lasts for a time [s]."""
    noise = rng.standard_normal((2, n, d))
    rho = math.exp(-PERIOD / time) if time else 0.0
    noise[0, 1:] *= math.sqrt(1 - rho**2)
    long = lfilter([1.0], [1.0, -rho], noise[0], axis=0)
    return np.asarray(math.sqrt(share) * long + math.sqrt(1 - share) * noise[1])


@evidence(runs=30, seconds=(10.0,))
def errors(
    runs: int = 2000, seconds: tuple[float, ...] = (60.0, 10.0), seed: int = 0
) -> dict[str, Any]:
    """Count runs of Gauss-Markov errors that assert_consistent fails, at 20 Hz.

    Right ones (false alarms), and those whose standard deviations are 20 % too small (found). The
    rows are of the time for which errors last.
    """
    result: dict[str, Any] = {}
    cases = [(s, name) for s in seconds for name in LASTING]
    for number, (length, name) in enumerate(progress(cases, "errors")):
        row: dict[str, float] = {}
        n = round(length / PERIOD)
        for d in (1, 4):
            rng = np.random.default_rng([seed, number, d])
            verdicts = {1.0: Counter[str](), SMALL: Counter[str]()}
            for _ in range(runs):
                error = lasting(rng, n, d, *LASTING[name])
                for factor, own in verdicts.items():
                    cov = np.broadcast_to(factor**2 * np.eye(d), (n, d, d))
                    own[verdict(assert_consistent, (error, cov), np.zeros((n, d)))] += 1
            of = f"{d} variable{'s' * (d > 1)}"
            row[f"{of}, false alarms"] = Share(verdicts[1.0]["fails"] / runs, runs)
            row[f"{of}, too short"] = Share(verdicts[1.0]["too short"] / runs, runs)
            row[f"{of}, found"] = Share(verdicts[SMALL]["fails"] / runs, runs)
        result[f"{length:g} s, errors last for {name}"] = row
    return result


@evidence(runs=20, seconds=(60.0,))
def named(
    runs: int = 500, seconds: tuple[float, ...] = (60.0, 300.0), seed: int = 0
) -> dict[str, Any]:
    """Measure whether assert_consistent finds the bias and the scale that it says it finds.

    Each is the median of those named in runs of one variable without a fault; then it is injected
    into as many other runs. "found" is the share of the runs that fail, or are too short to pass.
    """
    result: dict[str, Any] = {}
    cases = [(s, name) for s in seconds for name in LASTING]
    for number, (length, name) in enumerate(progress(cases, "named")):
        n = round(length / PERIOD)
        rng = np.random.default_rng([seed, number, 2])
        cov, truth = np.ones((n, 1, 1)), np.zeros((n, 1))

        def drawn() -> Array:
            return lasting(rng, n, 1, *LASTING[name])  # noqa: B023

        seen = []
        for _ in range(runs):
            with contextlib.suppress(AssertionError, ValueError):
                seen.append(assert_consistent((drawn(), cov), truth))
        if not seen:
            continue
        bias, scale = (
            float(np.median([getattr(one, of) for one in seen]))
            for of in ("bias_found", "scale_found")
        )
        found = Counter[str]()
        for _ in range(runs):
            of_bias, of_scale = drawn() + bias, scale * drawn()
            found["bias"] += verdict(assert_consistent, (of_bias, cov), truth) != "passes"
            found["scale"] += verdict(assert_consistent, (of_scale, cov), truth) != "passes"
        result[f"{length:g} s, errors last for {name}"] = {
            "bias [sigma]": bias,
            "bias, found": Share(found["bias"] / runs, runs),
            "sigmas too small by": 1 - 1 / scale,
            "scale, found": Share(found["scale"] / runs, runs),
        }
    return result


@evidence(runs=30, risks=(0.01,))
def levels(
    runs: int = 2000, risks: tuple[float, ...] = (1e-5, 1e-3, 0.01, 0.1), seed: int = 0
) -> dict[str, Any]:
    """Count runs of 60 s that assert_protected fails: right levels, and those 20 % too low."""
    result: dict[str, Any] = {}
    cases = [(risk, name) for risk in risks for name in LASTING]
    for number, (risk, name) in enumerate(progress(cases, "levels")):
        rng, n = np.random.default_rng([seed, number]), round(60 / PERIOD)
        level, found = np.full(n, -ndtri(risk / 2)), Counter[str]()
        for _ in range(runs):
            error = lasting(rng, n, 1, *LASTING[name])[:, 0]
            for way, factor in (("false alarms", 1.0), ("found", SMALL)):
                own = verdict(assert_protected, factor * level, error, risk)
                found[way] += own == "fails"
        result[f"risk {risk:g}, errors last for {name}"] = {
            way: Share(found[way] / runs, runs) for way in ("false alarms", "found")
        }
    return result


def of_page() -> dict[str, Any]:
    """Return the names that the examples of docs/testing.md define."""
    text = (DOCS / "testing.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    for file, code in re.findall(r"```py\n# (\w+\.py)\n(.*?)```", text, re.DOTALL):
        if not file.startswith("test_"):
            exec(compile(code, file, "exec"), names)  # noqa: S102 - an example of our own page
    return names


def right(lines: list[MapLine], _: MapLine | None) -> MapLine | None:
    """Return the line that the controller of the page returns."""
    return lines[-1] if lines else None


def independent(lines: list[MapLine], _: MapLine | None) -> MapLine | None:
    """Return the mean of the last lines, as if their errors were independent."""
    last = lines[-AVERAGED:]
    if not last:
        return None
    mean = np.mean([line.gaussian.mean for line in last], axis=0)
    cov = sum(line.gaussian.cov for line in last) / len(last) ** 2
    return MapLine(Slot.EGO_LEFT, Gaussian(mean, cov), x_max=last[-1].x_max)


def stale(_: list[MapLine], newest: MapLine | None) -> MapLine | None:
    """Return the newest line, whether it may be used or not."""
    return newest


def overconfident(lines: list[MapLine], _: MapLine | None) -> MapLine | None:
    """Return the newest line with standard deviations that are too small."""
    if not lines:
        return None
    own = lines[-1].gaussian
    return MapLine(Slot.EGO_LEFT, Gaussian(own.mean, SMALL**2 * own.cov), x_max=lines[-1].x_max)


#: Controllers, by what they do.
CONTROLLERS = {
    "right": right,
    "takes the last four lines as independent": independent,
    "uses stale lines": stale,
    "is 20 % overconfident": overconfident,
}


def cycles(page: dict[str, Any], seconds: float, seed: int) -> Iterator[tuple[str, Any, Array]]:
    """Yield what each controller returns in each cycle of a drive, and the true y."""
    codec = Codec.from_dbc()
    with Bench() as bench:
        controller, sender = page["Controller"](bench.open()), SendingNode(bench, codec)
        sender.faults = OUTAGES
        usable: list[MapLine] = []
        for lines, y in page["drive"](seconds, seed=seed):
            sender.send(lines)
            now_ns = bench.clock.now_ns
            line = controller.step(now_ns)
            usable = [*usable[1 - AVERAGED :], line] if line is not None else []
            newest = controller.decoder.latest(Slot.EGO_LEFT, now_ns).line
            for name, answer in CONTROLLERS.items():
                if (estimate := answer(usable, newest)) is not None:
                    yield name, estimate, y
            bench.run_for(PERIOD)
        sender.close()


@evidence(runs=2)
def controllers(runs: int = 100, seconds: float = 60.0, seed: int = 0) -> dict[str, Any]:
    """Count runs of the test of docs/testing.md that pass and fail, by controller.

    A car weaves along a winding road for a minute, with two outages of the sender of 1.5 s, in
    virtual time; its pose error lasts for half a second.
    """
    page, result = of_page(), {name: Counter[str]() for name in CONTROLLERS}
    for run in progress(range(runs), "runs", runs):
        estimates: dict[str, list[MapLine]] = {name: [] for name in CONTROLLERS}
        truth: dict[str, list[Array]] = {name: [] for name in CONTROLLERS}
        for name, estimate, y in cycles(page, seconds, seed + run):
            estimates[name].append(estimate)
            truth[name].append(y)
        for name, own in result.items():
            own[verdict(assert_consistent, estimates[name], truth[name], x=page["X"])] += 1
    return {
        name: {way: Share(own[way] / runs, runs) for way in ("passes", "fails", "too short")}
        for name, own in result.items()
    }
