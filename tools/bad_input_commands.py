"""The commands of bad_input.py, and the files that they are given."""

import re

import numpy as np

import maplines_can as ml
from maplines_can.study.dbc.record_spec import DEFAULT

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
        demo --dbc /dev/zero
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
        demo --faults script=/dev/zero
        demo --faults script={d}/half-range.faults
        demo --faults script={d}/huge.faults
        demo --faults flood=1,flood_ids=0-0x20000000
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
        receive --cycle-ms 0
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
        decode {d}/good.log --cycle-ms nan
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
        "half-range.faults": "loss 1-\n",
        "huge.faults": f"wrong_id 1 0x{'f' * 400}\n",
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
