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
The cases are in bad_input_calls.py and bad_input_commands.py.

Run it in the project's environment: python3 tools/run.py python tools/bad_input.py

Ends with a nonzero status where something is bad.
"""

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
from bad_input_calls import ANSWERED, REFUSED
from bad_input_commands import COMMANDS, QUICK, files
from telling import parser_of

import maplines_can as ml
from maplines_can import bus, propagation, wire
from maplines_can.errors import MaplinesError
from maplines_can.study.dbc.record_spec import DEFAULT

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


# ---- functions -------------------------------------------------------------------------------


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
    parser = parser_of(__doc__)
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
