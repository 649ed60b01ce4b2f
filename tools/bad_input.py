#!/usr/bin/env python3
"""What bad input gives: every command and every public function, by running them.

    bad_input.py               the table, for people
    bad_input.py --json        for machines
    bad_input.py --markdown    write docs/bad-input.md
    bad_input.py --quick       the functions, and a few of the commands
    bad_input.py --only WORDS  the cases whose name or group has these words

Good is: a command ends with a nonzero status and one line that says what is wrong; a function
raises a ValueError, a TypeError or an error of the package. What is answered instead of raised,
such as frames from a bus, is listed with its answer. Bad is a traceback, a warning, silence.

Run it in the project's environment: python3 tools/run.py python tools/bad_input.py

Ends with a nonzero status where something is bad.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

import maplines_can as ml
from maplines_can import bus, propagation, wire
from maplines_can.errors import MaplinesError
from maplines_can.wire.signals import DEFAULT

ROOT = Path(__file__).resolve().parents[1]
#: Longest that a command may take, and a scenario that ends by itself [s].
PATIENCE = 60


class Row(NamedTuple):
    """One case and what came of it."""

    group: str
    case: str
    gives: str
    status: str  #: "refused", "answered"; "foreign words", "DEFECT" with what is wrong

    @property
    def is_bad(self):
        """Whether it is a defect."""
        return self.status.startswith("DEFECT")


# ---- functions: each case is what a caller would write -------------------------------------

REFUSED = {
    "Gaussian": """
        Gaussian([nan, 0], eye(2))
        Gaussian([inf, 0], eye(2))
        Gaussian([], zeros((0, 0)))
        Gaussian([[0.0]], [[1.0]])
        Gaussian([0, 0], [[1, 2], [2, 1]])
        Gaussian([0, 0], [[1, 0.5], [0.4, 1]])
        Gaussian([0, 0], [[1, nan], [nan, 1]])
        Gaussian([0, 0], [[inf, 0], [0, 1]])
        Gaussian([0, 0], [[-1, 0], [0, 1]])
        Gaussian([0, 0], [[0, 0.1], [0.1, 1]])
        Gaussian([0, 0], eye(3))
        Gaussian("no", eye(2))
        Gaussian([0, 0], None)
        Gaussian([0, 1j], eye(2))
        one.sample(-1)
        one.mahalanobis([0, 0, 0])
        Gaussian([0.0], [[0.0]]).mahalanobis([1.0])
        one.kl(Gaussian([0.0, 0, 0, 0], zeros((4, 4))))
        one.kl(Gaussian([0.0], [[1.0]]))
        one.wasserstein(Gaussian([0.0], [[1.0]]))
        one.coverage([[0, 0, 0, 0]], mass=2)
        one.coverage([[0, 0, 0, 0]], mass=nan)
        one.coverage(zeros((0, 4)))
        one.marginal([7])
        nearest_covariance([[1, nan], [nan, 1]])
        nearest_covariance([[-1, 0], [0, 1]])
        nearest_covariance([[1, 0.5], [0.4, 1]])
        nearest_covariance([1, 2, 3])
    """,
    "GaussianMixture": """
        GaussianMixture([], [])
        GaussianMixture([1.0], [])
        GaussianMixture([0.5, 0.6], [one, one])
        GaussianMixture([nan, 0.5], [one, one])
        GaussianMixture([-0.5, 1.5], [one, one])
        GaussianMixture([0.5, 0.5], [one, Gaussian([0.0], [[1.0]])])
        GaussianMixture([1.0], [None])
    """,
    "MapLine": """
        MapLine(9, one)
        MapLine(None, one)
        MapLine(0, one, kind=99)
        MapLine(0, one, status=-1)
        MapLine(0, Gaussian([0.0], [[1.0]]))
        MapLine(0, None)
        MapLine(0, one, x_min=80, x_max=0)
        MapLine(0, one, x_max=nan)
        MapLine(0, one, x_max="far")
        MapLine(0, one, age=-1)
        MapLine(0, one, age=inf)
        MapLine.mean_only(0, [nan, 0, 0, 0])
        MapLine.mean_only(0, [0, 0, 0])
        MapLine.with_sigma(0, [0, 0, 0, 0], [nan, 1, 1, 1])
        MapLine.with_sigma(0, [0, 0, 0, 0], [-1, 1, 1, 1])
        MapLine.with_sigma(0, [0, 0, 0, 0], [1, 1])
        MapLine.of_mixture(0, None)
        MapLine(0, one, t_ns=nan)
        lateral([0, 0, 0], 1.0)
        lateral_jacobian([0, 0, 0], 1.0)
        moved([0, 0, 0, 0], [0, 0, 1.57], (0, 80))
        moved([0, 0, 0, 0], [nan, 0, 0], (0, 80))
        moved([0, nan, 0, 0], [0, 0, 0], (0, 80))
        moved([0, 0, 0, 0], [0, 0, 0], (80, 0))
        moved([0, 0, 0, 0], [0, 0, 0], (nan, 80))
        moved([0, 0, 0, 0], [0, 0, 0], (0, inf))
        moved([0, 0, 0, 0], [0, 0, 0], (0, 80), points=3)
        moved([0, 0, 0], [0, 0, 0], (0, 80))
        moved([0, 0, 0, 0], [0, 0], (0, 80))
    """,
    "Polyline, an empty map": """
        Polyline([])
        Polyline([[0, 0]])
        Polyline([[0, 0, 0], [1, 1, 1]])
        Polyline([[0, 0], [nan, 1]])
        Polyline([[0, 0], [inf, 1]])
        Polyline("road")
        Polyline(None)
        road.resampled(0)
        road.resampled(nan)
        road.resampled(-1)
        road.resampled(1e-12)
        road.window([0, 0], 0, 80)
        road.window([0, 0, nan], 0, 80)
        scenario("moon")
        scenario(None)
        scenario([])
    """,
    "Refit": """
        Refit([], [0, 0, 0], (-20, 80))
        Refit(None, [0, 0, 0], (-20, 80))
        Refit(road, [0, 0], (-20, 80))
        Refit(road, [nan, 0, 0], (-20, 80))
        Refit(road, [0, 0, 0], (80, -20))
        Refit(road, [0, 0, 0], (nan, 80))
        Refit(road, [0, 0, 0], (0, 3))
        Refit(road, [1e9, 0, 0], (-20, 80))
        Refit(road, [0, 0, 1.57], (-20, 80))
        Refit(Polyline([[0, 0], [1, 0]]), [0, 0, 0], (-20, 80))
        Refit(Polyline([[5, 1]] * 9), [0, 0, 0], (-20, 80))
        refit([0, 0, 1.57])
        refit([0, 0])
        refit([nan, 0, 0])
        MapError(point_sigma=-1)
        MapError(offset_sigma=nan)
        MapError(heading_sigma=inf)
        MapError("bad")
        total_least_squares([])
        total_least_squares([[0, 0]])
        total_least_squares([[0, nan]] * 9)
        robust([[0, 0]])
        robust(road.points, scale=0)
        robust(road.points, scale=nan)
        TotalLeastSquares(None)
        Robust(refit, scale=-1)
    """,
    "Transforms": """
        Linear(step=0)
        Linear(step=nan)
        Linear(step=inf)
        SigmaPoints(alpha=0)
        SigmaPoints(alpha=nan)
        SigmaPoints(beta=nan)
        SigmaPoints(kappa=-9)(refit, ego)
        SigmaPoints(kappa=nan)(refit, ego)
        SigmaPoints()(refit, one)
        SigmaPoints()(refit, None)
        SigmaPoints()(lambda x: x[:1], ego)
        SigmaPoints()(lambda x: x * nan, ego)
        Quadrature(order=0)
        Quadrature(order=65)
        Quadrature(order=2.5)
        MonteCarlo(n=1)
        MonteCarlo(n=nan)
        MonteCarlo(n=10.5)(refit, ego)
        MonteCarlo(n=100, seed=-1)(refit, ego)
        MonteCarlo(n=100)(lambda x: x * nan, ego)
        Mixture(0)
        Mixture(9)
        Mixture(2.5)
        Mixture(None)
        Mixture(3)(lambda x: x * nan, ego)
        Mixture(3).split(ego, direction=[1, 0])
        Mixture(3).split(ego, direction=[nan, 0, 0])
        bend(lambda x: x * nan, ego)
        part_counts([2.0])
        part_counts([nan])
        part_counts([0.5], tolerance=0)
        part_counts([0.5, 0.5], budget=1)
        Transform()
    """,
    "Motion": """
        Motion(nan, 0)
        Motion(0, inf)
        Motion("fast", 0)
        Motion(1, 0, cov=[[1, 2], [2, 1]])
        Motion(1, 0, cov=[[1]])
        Motion.with_sigma(1, 0, (nan, 1))
        Motion.with_sigma(1, 0, (1,))
        Motion(1, 0).over(nan)
        Motion(1, 0).over(1, time_sigma=-1)
        carried(one, one, (0, 80))
        carried(ego, ego, (0, 80))
        carried(one, ego, (80, 0))
        line_at(line, 0, Motion(1, 0))
        line_at(received, 10**12, Motion(1, 0))
        line_at(received, nan, Motion(1, 0))
        line_at(received, 0, one)
        line_at(received, 0, ego, time_sigma=1)
        pose_time_ns(line)
    """,
    "Codec": """
        Codec.from_dbc("nowhere.dbc")
        Codec.from_dbc("/")
        Codec.from_dbc(7)
        Codec(None)
        Codec(layout, "key")
        codec.encode_batch([[nan, 0, 0, 0]])
        codec.encode_batch([[0, 0, 0]])
        codec.encode_batch([0, 0, 0, 0])
        codec.encode_batch([[0, 0, 0, 0]], [eye(3)])
        codec.encode_batch([[0, 0, 0, 0]], [eye(4) * nan])
        codec.encode_batch([[0, 0, 0, 0]], [full((4, 4), inf)])
        codec.encode_batch([[0, 0, 0, 0]], [-eye(4)])
        codec.encode_batch([[0, 0, 0, 0]], [asymmetric])
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], slot=9)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], slot=0.5)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], kind=9)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], status=9)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], status=nan)
        codec.encode_batch([[0, 0, 0, 0]], status=1)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], x_min=9, x_max=0)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], x_max=nan)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], age=-1)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], age=inf)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], counter=0.5)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], counter=nan)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], counter=[1, 2])
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], component_index=3, component_count=2)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], component_count=9)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], component_weight=0)
        codec.encode_batch([[0, 0, 0, 0]], [eye(4)], component_weight=nan)
        codec.encode_mixtures([[0.5, 0.6]], zeros((1, 2, 4)), [[eye(4)] * 2])
        codec.encode_mixtures([0.5, 0.5], zeros((2, 4)), [eye(4)] * 2)
        codec.encode_mixtures([[0.5, 0.5]], zeros((1, 3, 4)), [[eye(4)] * 2])
        codec.encode_mixtures([[nan, 0.5]], zeros((1, 2, 4)), [[eye(4)] * 2])
        codec.encode_mixtures([[1 / 40] * 40], zeros((1, 40, 4)), [[eye(4)] * 40])
        codec.encode_mixtures([[1.0]], zeros((1, 1, 4)), [[eye(4)]], colour=3)
        codec.decode_batch(zeros((1, 31), dtype="u1"))
        codec.decode_batch(zeros((1, 32)))
        codec.decode_batch(b"bytes")
        codec.decode_batch(zeros((1, 32), dtype="u1"), slot=9)
        codec.decode_one(bytes(32), 9)
        codec.decode_one(None, 0)
        codec.encode(None)
        codec.encode_lines([None])
        codec.frames(zeros(32, dtype="u1"), 9)
        codec.decoder(timeout_ms=0)
        codec.decoder(timeout_ms=nan)
        codec.decoder(timeout_ms="long")
        codec.decoder(cycle_ms=0)
        codec.decoder(cycle_ms=inf)
        codec.decoder(e2e=E2EConfig(max_delta_counter=127).max_delta_counter)
        E2EConfig(window_size_valid=0)
        E2EConfig(min_ok_state_valid=11)
        E2EConfig(max_delta_counter=200)
        E2EConfig(min_ok_state_init=nan)
        monitor.latest(9, 0)
        monitor.latest(0, nan)
    """,
    "DBCs": """
        dbc()
        dbc("VERSION")
        dbc(without="YOff")
        dbc(without="PivotC0")
        dbc(without="Burst2")
        dbc(replace=("Page M", "Page"))
        dbc(replace=("Page M", "Leaf M"))
        dbc(replace=("C0 m1", "C0 m9"))
        dbc(replace=("Counter m0 : 16|8@1", "Counter m0 : 8|8@1"))
        dbc(replace=("Crc m0 : 0|16@1", "Crc m0 : 7|16@0"))
        dbc(replace=("Crc m0 : 0|16", "Crc m0 : 1|16"))
        dbc(replace=("YOff m0 : 24|16@1- (0.0009765625,0)", "YOff m0 : 24|16@1- (0,0)"))
        dbc(replace=("YOff m0 : 24|16@1- (0.0009765625,0)", "YOff m0 : 24|16@1- (nan,0)"))
        dbc(replace=("YOff m0 : 24|16", "YOff m0 : 24|17"))
        dbc(replace=("EgoLeft: 8", "EgoLeft: 7"))
        dbc(replace=('"MapLineSlot" BO_ 832 0', '"MapLineSlot" BO_ 832 99'))
        dbc(replace=('"E2EDataId" BO_ 832 19776', '"E2EDataId" BO_ 832 70000'))
        dbc(replace=('"CovarianceCode" "Cholesky"', '"CovarianceCode" "Zip"'))
        dbc(replace=('"CovarianceCode" "Cholesky"', '"CovarianceCode" "Float32"'))
        dbc(replace=("BO_ 833 EgoRight:", "BO_ 832 EgoRight:"))
        dbc(replace=('"MapLineSlot" BO_ 833 1', '"MapLineSlot" BO_ 833 0'))
        dbc(replace=("BA_ \\"MapLineSlot\\"", "BA_ \\"Slot\\""))
        dbc("\\0\\xff binary")
    """,
    "Security": """
        Key(b"short")
        Key(bytes(16))
        Key(bytes(range(16)), key_id=256)
        Key("0123456789abcdef")
        Key(None)
        Key.from_hex("xyz")
        Key.from_hex("")
        Authenticator()
        Authenticator(key, window_ns=0)
        Authenticator(key, not_before=-1)
        Authenticator(key, Key(bytes(range(1, 17))))
        Authenticator("key")
        Authenticator(key).use(9)
        Authenticator(key).retire(1)
        Codec(layout, Authenticator(key))
        Codec.from_dbc(authenticator=Authenticator(key)).encode(line, fd=True)
        Codec.from_dbc(authenticator=Authenticator(key, clock=lambda: 1)).encode(line)
        key_from_file("nowhere.key")
        key_from_file("/")
        key_from_env("NO_SUCH_VARIABLE")
    """,
    "Bus": """
        Link(interface="warp")
        Link(interface="socketcan", channel="nocan9")
        Link(interface="virtual", bitrate="fast", faults="loss")
        Link(None)
        Transmitter(link, codec, period=0)
        Transmitter(link, codec, period=nan)
        Transmitter(link, codec, period=1e9)
        Transmitter(link, codec, count=0)
        Transmitter(link, codec).publish(None)
        Transmitter(link, codec).publish(line, t_pose_ns=0)
        Transmitter(link, codec).publish(line, t_pose_ns=nan)
        Receiver(link, codec.decoder(), queue_size=0)
        Receiver(link, codec.decoder(), queue_size=nan)
        Receiver(link, codec.decoder()).latest(9)
        Receiver(link, codec.decoder(), on_line=print).get()
        frame_bits(9)
        frame_bits(-1)
        frame_bits(nan)
        frame_bits(65, is_fd=True)
        frame_time(frame, 0)
        frame_time(frame, nan)
        frame_time(frame, inf)
        bus_load([frame], 0, 500_000)
        bus_load([frame], nan, 500_000)
        bursts_within(0, [frame], 1, 500_000)
        bursts_within(nan, [frame], 1, 500_000)
        bursts_within(0.5, [], 1, 500_000)
        Faults(loss=2)
        Faults(loss=nan)
        Faults(loss="often")
        Faults(seed=0.5)
        Faults(flip=0.6, garbage=0.6)
        Faults(direction="up")
        Faults(flood_ids=())
        Faults(script=["loss 3"])
        Faults.parse("")
        Faults.parse("loss")
        Faults.parse("loss=x")
        Faults.parse("los=0.1")
        Faults.parse("loss=0.1,loss=0.2")
        Faults.parse("script=/nowhere/plan")
        Action.parse("loss 0")
        Action.parse("loss 3 1")
        Action.parse("flip 3 0.5")
        Mischief(None)
        read_log("nowhere.log")
        read_log("/etc/passwd")
        read_log("drive.mf4")
        read_log(None)
    """,
}

#: What a bus or a file sends, and what a line may be, is answered: nothing is raised.
ANSWERED = {
    "Answers": """
        decoder.feed(0x340, b"", 0)
        decoder.feed(0x340, bytes(7), 0)
        decoder.feed(0x340, bytes(64), 0)
        decoder.feed(0x348, bytes(32), 0)
        decoder.feed(0x348, b"\\xff" * 64, 0)
        decoder.feed(0x7FF, bytes(8), 0)
        decoder.feed(-1, bytes(8), 0)
        decoder.feed(2**40, bytes(8), 0)
        decoder.feed(0x340, bytes(8), -(10**30))
        decoder.feed(0x340, bytes(8), 0, is_extended=True)
        codec.decode_one(bytes(32), Slot.EGO_LEFT)
        status(codec.encode_batch([[0, 0, 0, 0]], [indefinite * 1e-6]))
        status(codec.encode_batch([[0, 0, 0, 0]], [zeros((4, 4))]))
        status(codec.encode_batch([[1e300, 0, 0, 0]], [eye(4)]))
        status(codec.encode_batch([[0, 0, 0, 0]], [eye(4) * 1e300]))
        status(codec.encode_batch([[0, 0, 0, 0]], [eye(4) * 1e-300]))
        status(codec.encode_batch(zeros((0, 4)), zeros((0, 4, 4))))
        codec.encode_lines([])
        codec.decode_batch(zeros((0, 32), dtype="u1")).accepted
        monitor.latest(0, -(10**30)).stale
        road.window([1e9, 0, 0], 0, 80)
        road.window([0, 0, 0], 80, 0)
        codec.decode_one(bytes(31), Slot.EGO_LEFT)
        codec.decode_one(bytes(33), Slot.EGO_LEFT)
        refit([[nan, 0, 0]])
        refit([[0, 0, 1.57]])
        part_counts([])
        Mischief(Faults(loss=1)).apply(frame)
        dbc(replace=("YOff m0 : 24|16@1", "YOff m0 : 31|16@0"), carriers="classic")
    """
}


def namespace():
    """What the cases may use."""
    names = {name: getattr(ml, name) for name in ml.__all__}
    names |= {name: getattr(propagation, name) for name in propagation.__all__}
    names |= {name: getattr(wire, name) for name in wire.__all__}
    names |= {name: getattr(bus, name) for name in bus.__all__}
    codec = ml.Codec.from_dbc()
    cov = np.diag([0.1, 0.01, 1e-3, 1e-4]) ** 2
    one, ego = ml.Gaussian([1.75, 0, 0, 0], cov), ml.Gaussian([0, 0, 0], np.eye(3) * 1e-4)
    asymmetric, indefinite = np.eye(4), np.eye(4)
    asymmetric[0, 1] = indefinite[0, 1] = indefinite[1, 0] = 2.0
    road = ml.Polyline([[x, 2.0] for x in range(-20, 100, 5)])
    line = ml.MapLine(0, one)
    names |= {
        "nan": np.nan,
        "inf": np.inf,
        "eye": np.eye,
        "full": np.full,
        "zeros": np.zeros,
        "codec": codec,
        "layout": codec.layout,
        "one": one,
        "ego": ego,
        "road": road,
        "asymmetric": asymmetric,
        "indefinite": indefinite,
        "line": line,
        "dbc": _dbc,
        "received": ml.MapLine(0, one, t_ns=0),
        "refit": ml.Refit(road, [0, 0, 0], window=(-20, 80)),
        "decoder": codec.decoder(),
        "monitor": ml.Monitor(codec.decoder()),
        "frame": ml.Frame(1, bytes(8)),
        "link": ml.Link(interface="virtual", channel="bad-input"),
        "status": lambda payloads: [ml.Status(s).name for s in codec.decode_batch(payloads).status],
    }
    try:
        names["key"] = wire.Key(bytes(range(16)))
    except MaplinesError:
        names["key"] = None
    return names


def _dbc(text="", *, without=None, replace=None, carriers="both"):
    """The codec of a spoilt DBC."""
    if without or replace:
        text = DEFAULT.dbc()
        if carriers == "classic":  # the messages that say the same otherwise
            text = re.sub(r"BO_ \d+ \w+Fd:.*?\n\n", "", text, flags=re.DOTALL)
            text = re.sub(r"^(?:CM_|BA_|VAL_)[^\n]*? (84[0-7]) [^;]*;\n", "", text, flags=re.M)
    if without:
        text = re.sub(rf"(?m)^ SG_ {without} .*\n", "", text)
        text = re.sub(rf"(?m)^(?:CM_ SG_|VAL_) \d+ {without} [^;]*;\n", "", text)
    if replace:
        old, new = replace
        if old not in text:
            raise AssertionError(f"the DBC has no {old!r}")
        text = text.replace(old, new)
    codec = ml.Codec(wire.Layout.from_text(text, "the DBC"))
    return f"a codec of {len(codec.layout.channels)} slots"


def functions(only=""):
    """Rows of all calls."""
    names = namespace()
    with names["link"]:
        for cases, wanted in ((REFUSED, "refused"), (ANSWERED, "answered")):
            for group, text in cases.items():
                for case in filter(None, map(str.strip, text.splitlines())):
                    if only in f"{group} {case}":
                        yield called(group, case, names, wanted)


def called(group, case, names, wanted):
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            value = eval(case, dict(names))  # noqa: S307 - our own cases
            if hasattr(value, "__next__"):
                value = list(value)
    except Warning as error:
        return Row(group, case, _told(error), "DEFECT: a warning")
    except (ValueError, TypeError, MaplinesError) as error:
        status = "refused" if _is_ours(error) else "refused, in foreign words"
        return Row(group, case, _told(error), status if wanted == "refused" else "DEFECT: raised")
    except AttributeError as error:  # an object of another class: a matter for type checkers
        return Row(group, case, _told(error), "refused, in foreign words")
    except Exception as error:  # noqa: BLE001 - any other is the finding
        return Row(group, case, _told(error), "DEFECT: of another kind")
    gives = _printable(str(value))
    return Row(group, case, gives[:120], "answered" if wanted == "answered" else "DEFECT: taken")


def _told(error):
    return _printable(f"{type(error).__name__}: {error}")


def _printable(text):
    """In one line, with nothing that a page cannot hold."""
    text = " ".join(text.replace(f"{ROOT}{os.sep}", "").split())
    return "".join(c if c.isprintable() else "?" for c in text)


def _is_ours(error):
    """Whether the package says it, or Python or numpy from inside."""
    trace = error.__traceback__
    while trace.tb_next:
        trace = trace.tb_next
    return "maplines_can" in trace.tb_frame.f_code.co_filename


# ---- commands --------------------------------------------------------------------------------


#: In these {d} is a folder with bad files, {f} a good file where a folder should be.
COMMANDS = {
    "maplines": """

        fly
        --rate
    """,
    "maplines demo": """
        demo --scenario moon
        demo --rate 0
        demo --rate nan
        demo --rate 1e9
        demo --lines 0
        demo --lines nine
        demo --components 9
        demo --max-load 2
        demo --map-error -1
        demo --seconds 0
        demo --seconds inf
        demo --bitrate 0
        demo --components auto --bitrate 1
        demo --max-load 0.001
        demo --dbc {d}/nowhere.dbc
        demo --dbc {d}
        demo --dbc {d}/empty.dbc
        demo --dbc {d}/binary.dbc
        demo --dbc {d}/missing-signal.dbc
        demo --dbc {d}/overlap.dbc
        demo --dbc {d}/big-endian.dbc
        demo --dbc {d}/other-mux.dbc
        demo --interface warp
        demo --interface socketcan --channel nocan9
        demo --seconds 0.1 --plot {d}/no/such/a.png
        demo --seconds 0.1 --plot {f}/a.png
        demo --seconds 0.1 --plot /dev/full
        demo --seconds 0.1 --plot a.xyz
        demo --faults loss=2
        demo --faults what
        demo --faults script={d}/nowhere
        demo --faults script={d}/binary.dbc
        demo --key-file {d}/nowhere
        demo --key-file {d}/short.key
        demo --key-file {d}/open.key
        demo --key-file {d}
        demo --key-file 999:{d}/good.key
        demo --key-env NO_SUCH_VARIABLE
        demo --key-file {d}/good.key --dbc {d}/good.dbc
        demo --seconds 0.1 > /dev/full
        demo --seconds 0.1 --json > /dev/full
    """,
    "maplines send": """
        send --count 0
        send --count x
        send --rate -1
        send --interface warp
        send --interface socketcan --channel nocan9
        send --interface virtual --fd --dbc {d}/classic-only.dbc --count 1
        send --interface virtual --dbc {d}/missing-signal.dbc
        send --interface virtual --components auto --max-load 0.001
        send --interface virtual --key-env NO_SUCH_VARIABLE
        send --interface virtual --faults flood=-1
        send --interface virtual --count 1 --rate 1000 > /dev/full
    """,
    "maplines receive": """
        receive --timeout 0
        receive --timeout nan
        receive --count -1
        receive --interface warp
        receive --interface socketcan --channel nocan9
        receive --interface virtual --dbc {d}/binary.dbc
        receive --interface virtual --key-file {d}/short.key
        receive --interface virtual --count 1 --timeout 0.1
    """,
    "maplines decode": """
        decode
        decode {d}/nowhere.log
        decode {d}
        decode {d}/good.dbc
        decode {d}/binary.log
        decode {d}/binary.asc
        decode {d}/binary.blf
        decode {d}/binary.csv
        decode {d}/binary.trc
        decode {d}/binary.db
        decode {d}/binary.mf4
        decode {d}/binary.log.gz
        decode {d}/folder.log
        decode {d}/torn.log
        decode {d}/good.log --dbc {d}/overlap.dbc
        decode {d}/good.log --key-file {d}/short.key
        decode {d}/good.log > /dev/full
        decode {d}/good.log --csv > /dev/full
    """,
    "maplines figures": """
        figures
        figures --out {d}/f --samples 1
        figures --out {d}/f --seed -1
        figures --out {f}/figures --samples 1000
        figures --out /proc/figures --samples 1000
        figures --out {d}/f --dbc {d}/nowhere.dbc
    """,
    "maplines truth": """
        truth --scenario moon
        truth --samples 10
        truth --samples 1e99
        truth --format pdf
        truth --dbc {d}/missing-signal.dbc --samples 1000
        truth --scenario production --samples 1000 > /dev/full
    """,
    "maplines scenarios": """
        scenarios --csv
        scenarios extra
        scenarios > /dev/full
        scenarios --json > /dev/full
    """,
    "maplines study run": """
        study
        study run
        study run --out {d}/s --n 0
        study run --out {d}/s --n nan
        study run --out {d}/s --code Zip
        study run --out {d}/s --finer 99
        study run --out {d}/s --finer -8 --n 100 --set road --code Cholesky
        study run --out {d}/s --set nowhere
        study run --out {d}/s --set {d}/binary.npz
        study run --out {d}/s --set {d}/binary.parquet
        study run --out {d}/s --set {d}/empty.csv
        study run --out {d}/s --set {d}/header.csv
        study run --out {d}/s --set {d}/nan.csv
        study run --out {d}/s --set {d}/words.csv
        study run --out {d}/s --set {d}/columns.csv
        study run --out {d}/s --set {d}/indefinite.csv --n 100 --code Cholesky --finer 0 --jobs 1
        study run --out {d}/s --set {d}/asymmetric.npz
        study run --out {d}/s --set {d}/shapes.npz
        study run --out {d}/s --set {d}/poses.csv
        study run --out {d}/s --set {d}/poses.csv --map {d}/nowhere.csv
        study run --out {d}/s --set {d}/poses.csv --map {d}/header.csv
        study run --out {d}/s --set {d}/poses.csv --map {d}/one-point.csv
        study run --out {d}/s --set {d}/poses.csv --map {d}/empty.csv
        study run --out {d}/s --set {d}/poses.csv --map {d}/map.csv --window 80 -20
        study run --out {d}/s --set {d}/poses.csv --map {d}/map.csv --window nan 80
        study run --out {f}
        study run --out {f}/s --set road --n 100
        study run --out /proc/s --set road --n 100
        study run --out {d} --set road --n 100
        study run --out {d}/s --scheduler nowhere --set road --n 100
        study run --out {d}/s --jobs 0
    """,
    "maplines study report": """
        study report
        study report {d}/nowhere --out {d}/r.html
        study report {d} --out {d}/r.html
        study report {f} --out {d}/r.html
        study report {d}/tables --out {d}/r.html
    """,
    "maplines study production": """
        study production --n 1
        study production --n x
        study production --seed -1
        study production --csv --json
        study production --n 100 > /dev/full
    """,
    "maplines design": """
        design
        design --frames 0
        design --frames 1 --n 100 --set road --out {d}/x.dbc
        design --frames 999
        design --max-kl 0
        design --max-kl nan
        design --max-kl 1e-300 --n 100 --set road --out {d}/x.dbc
        design --frames 4 --n 1
        design --frames 4 --seed -1 --out {d}/x.dbc
        design --frames 4 --set nowhere
        design --frames 4 --set {d}/binary.npz
        design --frames 4 --set {d}/poses.csv
        design --frames 4 --range y_off=-1 --n 100 --out {d}/x.dbc
        design --frames 4 --range y_off=nan --n 100 --out {d}/x.dbc
        design --frames 4 --range width=3
        design --frames 4 --sigma y_off=0 --n 100 --out {d}/x.dbc
        design --frames 4 --max-lateral nan --n 100 --out {d}/x.dbc
        design --frames 4 --max-saturated 2 --n 100 --out {d}/x.dbc
        design --frames 4 --out design.txt
        design --frames 4 --n 100 --set road --out {f}/x.dbc
        design --frames 4 --n 100 --set road --out {d}/no/such/x.dbc
    """,
}
#: Enough to see each way in which a command ends.
QUICK = ("fly", "demo --dbc {d}/overlap.dbc", "decode {d}/torn.log", "study run --out {f}")


def files(folder):
    """Bad files of each kind."""
    frames = ml.Codec.from_dbc().encode(ml.MapLine.mean_only(0, [1.75, 0, 0, 0]))
    text = DEFAULT.dbc()
    put = {
        "a-file": "a file\n",
        "good.dbc": text,
        "empty.dbc": "",
        "missing-signal.dbc": re.sub(r"(?m)^ SG_ YOff .*\n", "", text),
        "overlap.dbc": text.replace("Counter m0 : 16|8@1", "Counter m0 : 8|8@1"),
        "big-endian.dbc": text.replace("Crc m0 : 0|16@1", "Crc m0 : 7|16@0"),
        "other-mux.dbc": text.replace("Page M", "Leaf M"),
        "classic-only.dbc": re.sub(r'(?m)^BA_ "MapLineSlot" BO_ 84[0-7] .*\n', "", text),
        "short.key": "00ff\n",
        "open.key": bytes(range(16)).hex(),
        "good.key": bytes(range(16)).hex(),
        "good.log": "".join(f"(1000.0) can0 {f.can_id:X}#{f.data.hex()}\n" for f in frames),
        "torn.log": "(1000.0) can0 340#00000000000000\n(1000.1) can0 34\n",
        "empty.csv": "",
        "header.csv": "mean_0,mean_1,mean_2,mean_3\n",
        "words.csv": _csv(4, "wide"),
        "nan.csv": _csv(4, "nan"),
        "columns.csv": "a,b\n1,2\n",
        "indefinite.csv": _csv(4, "2"),
        "poses.csv": _csv(3, "0.0"),
        "one-point.csv": "line,x,y\n0,1,2\n",
        "map.csv": "line,x,y\n" + "".join(f"0,{x},2\n" for x in range(-20, 100, 5)),
    }
    for name, content in put.items():
        (folder / name).write_text(content)
        (folder / name).chmod(0o600)
    (folder / "open.key").chmod(0o644)
    junk = np.random.default_rng(1).bytes(500)
    for suffix in (
        "dbc",
        "log",
        "asc",
        "blf",
        "csv",
        "trc",
        "db",
        "mf4",
        "log.gz",
        "npz",
        "parquet",
    ):
        (folder / f"binary.{suffix}").write_bytes(junk)
    for name in ("folder.log", "tables"):
        (folder / name).mkdir()
    (folder / "tables" / "summary.parquet").write_bytes(junk)
    wrong = np.broadcast_to(np.eye(4), (5, 4, 4)).copy()
    np.savez(folder / "shapes.npz", mean=np.zeros((5, 3)), cov=wrong)
    wrong[:, 0, 1] = 0.5
    np.savez(folder / "asymmetric.npz", mean=np.zeros((5, 4)), cov=wrong)


def _csv(n, off):
    """Gaussians with this in place of the first correlation."""
    pairs = [(i, j) for i in range(n) for j in range(i, n)]
    head = [f"mean_{i}" for i in range(n)] + [f"cov_{i}{j}" for i, j in pairs]
    row = ["0"] * n + [off if p == (0, 1) else "1e-4" if p[0] == p[1] else "0" for p in pairs]
    if off == "2":
        row = [value.replace("1e-4", "1") for value in row]
    return "\n".join([",".join(head), *[",".join(row)] * 200]) + "\n"


def commands(quick, only=""):
    """Rows of all commands."""
    with tempfile.TemporaryDirectory(prefix="bad-input-") as name:
        folder = Path(name)
        files(folder)
        for group, text in COMMANDS.items():
            for case in map(str.strip, text.splitlines()[1:-1]):
                if (case in QUICK or not quick) and only in f"{group} {case}":
                    yield run(group, case, folder)


def run(group, case, folder):
    line = case.format(d=folder, f=folder / "a-file")
    words, full, _ = line.partition(" > ")
    environment = {**os.environ, "MPLBACKEND": "agg", "PYTHONWARNINGS": "default"}
    command = [sys.executable, "-m", "maplines_can.cli", *words.split()]
    with open("/dev/full", "w") if full else tempfile.TemporaryFile("w+") as out:
        try:
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                cwd=folder,
                env=environment,
                timeout=PATIENCE,
                check=False,
            )
        except subprocess.TimeoutExpired as late:
            text = (late.stderr or b"").decode(errors="replace").strip().splitlines()
            return Row(group, f"maplines {case}", " ".join(text[-1:]), "DEFECT: does not end")
    told = [_printable(row) for row in done.stderr.replace(str(folder), "DIR").splitlines() if row]
    errors = [row for row in told if re.search(r"\berror:", row)] or told[-1:]
    gives = f"{done.returncode}: {errors[-1] if errors else 'nothing'}"
    status = "refused"
    if "Traceback" in done.stderr or "Exception ignored" in done.stderr:
        gives, status = f"{done.returncode}: {told[-1]}", "DEFECT: a traceback"
    elif done.returncode < 0 or done.returncode > 2:
        status = f"DEFECT: ends with {done.returncode}"
    elif not done.returncode:
        status = "DEFECT: ends with 0"
    elif "Warning" in done.stderr:
        status = "DEFECT: a warning"
    elif not told:
        status = "DEFECT: silence"
    elif len(errors) > 1:
        status = f"DEFECT: {len(errors)} lines of errors"
    case = case.replace("{d}", "DIR").replace("{f}", "DIR/a-file")
    return Row(group, f"maplines {case}".strip(), gives, status)


# ---- the table -------------------------------------------------------------------------------


def markdown(rows):
    text = [
        "# Bad input",
        "",
        "What every command and every public function makes of bad input. Written by "
        "`python tools/bad_input.py --markdown`, which runs each case.",
        "",
        "A command ends with status 1 (2 for wrong usage) and one line that says what is wrong. A "
        "function raises a `ValueError`, a `TypeError` or an error of the package; *in foreign "
        "words* means that Python or numpy says it, from inside. What comes from a bus is "
        "answered, not raised.",
        "",
        f"{len(rows)} cases, {sum(row.is_bad for row in rows)} of them defects.",
    ]
    group = None
    for row in rows:
        if row.group != group:
            group = row.group
            text += ["", f"## {group}", "", "| case | what it gives | status |", "|---|---|---|"]
        cells = (f"`{row.case}`", row.gives, row.status)
        text.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(text) + "\n"


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="for machines")
    parser.add_argument("--markdown", action="store_true", help="write docs/bad-input.md")
    parser.add_argument("--quick", action="store_true", help="the functions and a few commands")
    parser.add_argument("--only", default="", metavar="WORDS", help="cases that have these words")
    arguments = parser.parse_args(argv)
    rows = [*commands(arguments.quick, arguments.only), *functions(arguments.only)]
    if arguments.json:
        print(json.dumps([row._asdict() for row in rows], indent=2))
    elif arguments.markdown:
        page = ROOT / "docs" / "bad-input.md"
        page.write_text(markdown(rows))
        print(f"{page.relative_to(ROOT)}: {len(rows)} cases")
    else:
        for row in rows:
            print(f"{row.status:<28} {row.case:<70} {row.gives[:160]}")
    bad = [row for row in rows if row.is_bad]
    print(f"{len(rows)} cases, {len(bad)} defects", file=sys.stderr)
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
