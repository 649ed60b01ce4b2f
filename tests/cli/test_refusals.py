"""What commands refuse: one line that names the option or the file, and says what to do.

`tests/bad_input` has the values that no option takes, and files of random bytes.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.dbcs import edited
from support.drive_files import town
from support.expressions import cases
from support.fixtures import Capture, Patch
from support.xodr_files import document, geometry, lane, road, section

from maplines_can import Codec, Slot, map_scene
from maplines_can.bus import LogWriter
from maplines_can.cli import main
from maplines_can.simulation import scenario
from maplines_can.wire import default_dbc_path

POSE, SCENE = "--dbc maplines-pose.dbc", "--dbc maplines-scene.dbc"
DRIVE = "drive map.xodr --seconds 1 --route 1:0:-1..1:0:-1"
#: Lines of a camera as a table.
HEADER = "t,slot,y_off,beta,c0,c1,sigma_y_off,sigma_beta,sigma_c0,sigma_c1\n"
TEXTS = {
    "broken.toml": "[[message]\n",
    "nowhere.toml": '[[message]]\nname = "Motion"\ndbc = "nowhere.dbc"\n',
    "unknown.toml": '[[message]]\nname = "Motion"\ndbc = "example-car.dbc"\nstart = 5\n',
    "endless.toml": '[[message]]\nname = "Motion"\ndbc = "example-car.dbc"\ncycle_ms = 10\n',
    "other.log": "(1.0) can0 123#00\n",
    "no-rate.csv": "time,speed\n1,2\n",
    "words.csv": "time,speed,yaw_rate\n1,x,0\n",
    "same-time.csv": "time,speed,yaw_rate\n1,1,0\n1,1,0\n",
    "no-time.csv": "time,speed,yaw_rate\n",
    "no-c1.csv": "t,slot,y_off,beta,c0\n1,EGO_LEFT,1,0,0\n",
    "no-cov.csv": HEADER.replace(",sigma_y_off", "") + "1,EGO_LEFT,1,0,0,0,1,1,1\n",
    "slot.csv": HEADER + "1,LEFT,1,0,0,0,1,1,1,1\n",
    "word.csv": HEADER + "1,EGO_LEFT,x,0,0,0,1,1,1,1\n",
    "negative.csv": HEADER + "1,EGO_LEFT,1,0,0,0,-1,1,1,1\n",
    "short.csv": HEADER + "1,EGO_LEFT,1,0,0,0\n",
    "empty-cell.csv": HEADER + "1,EGO_LEFT,,0,0,0,1,1,1,1\n",
    "header.csv": HEADER,
    "zeros.csv": HEADER + "\0" * 5,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with maps, a DBC without a pose error, a log of a scene, and wrong tables."""
    path = tmp_path_factory.mktemp("files")
    for name, text in TEXTS.items():
        (path / name).write_text(text)
    town(path)
    short = road(section(lane(-1)), plan=geometry(length=0.5), length=0.5)
    (path / "short.xodr").write_text(document(short))
    edited(path, (r'BA_ "MapLinePose" .*\n', ""))
    for name in ("drive.blf", "drive.blf.csv"):
        (path / name).touch()
    street = scenario("production")
    scene = map_scene(street.lines, street.ego, correlation_time=5.0)
    codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
    with LogWriter(path / "scene.log", 1000.0) as log:
        for frames in codec.encoder().encode_scene(scene).values():
            for frame in frames:
                log.write(frame, 1000.0)
    assert {Slot.EGO_LEFT, Slot.EGO_RIGHT} <= {line.slot for line in scene.lines}
    return path


@pytest.mark.parametrize(
    ("command", "words"),
    cases(
        # What is missing, and what does not go together
        ("receive", "--interface and --channel"),
        ("receive --interface socketcan", "--channel can0"),
        ("receive --scenes --interface virtual", "--scenes needs --json"),
        ("design --frames 4 --keep-mean --range y_off=9", "must not be given with --keep-mean"),
        ("demo --components auto --max-load 0.08", "4 lines with 4 components take 8.64 %"),
        ("demo --pose-error --components 3", "--components 3 does not go with --pose-error"),
        (f"demo {POSE} --components auto", "receiver splits that itself"),
        ("send --interface virtual --pose-error --components 2", "leave out --components"),
        ("demo --correlation-time 3", f"add --pose-error, or take {POSE}"),
        ("demo --pose-error --max-load 0.05", "4 lines and the pose error take up to 11.9 %"),
        ("demo --pose-error --dbc edited.dbc", "edited.dbc has no message of the pose error"),
        ("decode --scenes --dbc edited.dbc none.log", "--scenes: .*edited.dbc has no message"),
        (f"demo {SCENE} --components 2", "--components 2 does not go with"),
        (f"send --interface virtual {SCENE} --components auto", "a receiver splits that itself"),
        (f"demo --lines 4 --max-load 0.005 {SCENE}", r"and the pose error take up to 0\.814 %"),
        (f"demo --lines 8 --max-load 0.01 {SCENE}", r"and the pose error take up to 1\.63 %"),
        # Names: the one that may be meant, or those there are
        ("decode nofile.blf", "did you mean drive.blf?"),
        (f"consume steer drvie.blf {POSE}", r"did you mean drive.blf\?"),
        ("accuracy drive.bfl.csv drive.blf", "did you mean drive.blf.csv?"),
        ("decode x/a.log", "'maplines drive --as-fast-as-possible --record x/a.log'"),
        ("decode --dbc=maplines-poes.dbc drive.blf", r"did you mean maplines-pose.dbc\?"),
        ("decode --dbc x/a.dbc drive.blf", "this package has maplines.dbc"),
        ("decode unknown.toml", "format '.toml' is unknown"),
        ("drive twon.xodr --record a.log", r"did you mean town.xodr\?"),
        ("map x/a.osm", "this package has town.xodr"),
        ("receive --interface sockcan --channel can0", r"did you mean socketcan\?"),
        ("receive --interface xyz", "python-can has canalystii"),
        # maplines map
        ("map unknown.toml", "a map is one of: OpenDRIVE"),
        ("map .", "Is a directory"),
        ("map --projection x", "leave out --projection"),
        ("map --plot a.xyz", "xyz"),
        # maplines drive
        ("drive --as-fast-as-possible", "add --record FILE"),
        (f"{DRIVE} --route 1..9", "--route 1..9: .*neither a lane nor a road '9'"),
        (f"{DRIVE} --route 1", "--route must be A..B"),
        (f"{DRIVE} --route 1:0:1..1:0:-1", "--route .*no route"),
        ("drive short.xodr", r"chosen at random on short.xodr .* 0.5 m, but .*; give another --se"),
        ("drive short.xodr --route 1..1", r"--route 1\.\.1: .* 0.5 m, but .*; choose other lanes"),
        (f"{DRIVE} --record a.txt", r"a.txt.*'.txt'.*\.log, \.asc"),
        (f"{DRIVE} --record /no/a.log", r"/no/a\..*No such file"),
        (f"{DRIVE} --truth /no/a.csv", "/no/a.csv.*No such file"),
        (f"{DRIVE} --truth a.json", r"a.json.*\.csv or \.parquet"),
        (f"{DRIVE} --as-fast-as-possible --channel x", "leave out --interface"),
        (f"{DRIVE} --interface warp", "warp"),
        (f"{DRIVE} --window 80 -4", " --window must be MIN < MAX .*, got 80 -4"),
        ("drive map.xodr --drive none.abc --record a.log", "none.abc.*looked for in"),
        ("drive map.xodr --drive a.blf", "a.blf: a bus log needs --signals"),
        ("drive map.xodr --drive a.blf --signals s.toml", "needs --signals-dbc"),
        ("drive map.xodr --drive a.csv --signals-dbc a.dbc", "needs --signals"),
        ("drive map.xodr --drive a.csv --truth ./a.csv", "a.csv would overwrite"),
        (f"{DRIVE} --signals s.toml", "give its log by --drive"),
        (f"{DRIVE} --scan", "--scan is a sensor of --localise"),
        (f"{DRIVE} --localise --sigma 1,1,1", "gives the errors of the pose"),
        (f"{DRIVE} --localise --correlation-time 3", "gives the errors of the pose"),
        (f"drive {POSE} --components 2", "maplines-pose.dbc: lines are sent with"),
        (f"drive {POSE} --max-load 0.05", "take up to 9.72 % of the bus at 20 Hz"),
        (f"{DRIVE} --components 8 --lines 8 --max-load 0.3", "64 components take .* a higher --ma"),
        (f"{DRIVE} --as-fast-as-possible --faults flood=100000", "flood=100000 takes 2.7e.03 %"),
        # maplines consume
        ("consume fusion --camera x.csv", "--camera needs LOG"),
        ("consume check --camera scene.log", "--camera needs LOG"),
        (f"consume check scene.log --simulate --camera-dbc x {POSE}", "is that of --camera"),
        ("consume fusion --simulate --speed 10", "--simulate has a car of its own"),
        ("consume fusion --simulate --camera-channel can1", "--simulate has a car of its own"),
        ("consume fusion x.log", "there is no such file"),
        ("consume fusion scene.log --motion none.csv", "none.csv"),
        ("consume fusion scene.log --camera-channel can1", "--camera-channel is a bus"),
        ("consume fusion --camera-dbc maplines.dbc", "leave it out"),
        ("consume fusion --motion x.csv", "--motion needs LOG"),
        ("consume fusion --signals-channel can1", "--signals-channel is that of --signals"),
        ("consume fusion scene.log --signals x.toml", "go together"),
        ("consume fusion scene.log --signals x --signals-dbc y --speed 1", "leave it out"),
        (f"consume fusion scene.log --camera none.csv {POSE}", "none.csv"),
        (f"consume fusion scene.log --camera none.parquet {POSE}", "none.parquet"),
        (f"consume fusion other.log {POSE}", "no scene"),
        (f"consume fusion other.log --motion no-rate.csv {POSE}", "yaw_rate"),
        (f"consume fusion other.log --motion words.csv {POSE}", "could not convert"),
        (f"consume fusion other.log --motion same-time.csv {POSE}", "increasing time"),
        (f"consume fusion other.log --motion no-time.csv {POSE}", "increasing time"),
        (f"consume fusion scene.log --camera no-c1.csv {POSE}", "has no column c1"),
        (f"consume fusion scene.log --camera no-cov.csv {POSE}", "no column cov_y_off"),
        (f"consume fusion scene.log --camera slot.csv {POSE}", "row 1: slot must be one of EGO_L"),
        (f"consume fusion scene.log --camera word.csv {POSE}", "row 1: could not convert"),
        (f"consume fusion scene.log --camera negative.csv {POSE}", "row 1: "),
        (f"consume fusion scene.log --camera short.csv {POSE}", "has no line"),
        (
            f"consume fusion scene.log --camera empty-cell.csv {POSE}",
            "1 row without a finite value",
        ),
        (f"consume fusion scene.log --camera header.csv {POSE}", "has no line"),
        (f"consume fusion scene.log --camera zeros.csv {POSE}", "zeros.csv"),
        # maplines restbus
        ("restbus", "CONFIG is missing"),
        ("restbus broken.toml --seconds 1", "is not valid TOML"),
        ("restbus nowhere.toml --seconds 1", "nowhere.dbc"),
        ("restbus unknown.toml --seconds 1", r"unknown key 'start'; did you mean 'start_ms'\?"),
        ("restbus endless.toml --virtual-time", "--virtual-time needs an end; give --seconds"),
    ),
)
def test_it_is_refused(
    command: str, words: str, folder: Path, capsys: Capture, monkeypatch: Patch
) -> None:
    """Status 1, in terms of the options and not of Python's arguments, without a traceback."""
    monkeypatch.chdir(folder)
    for variable in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_CONFIG"):
        monkeypatch.delenv(variable, raising=False)
    assert main(command.split()) == 1
    err = capsys.readouterr().err
    (error,) = [line for line in err.splitlines() if "error:" in line]
    assert re.search(words, err), err
    assert error.startswith("maplines: error: ")
    assert "Traceback" not in err
    assert not re.search(r"(interface|channel|fd)=|\b(max|keep|finer)_[a-z]+", err)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("demo --rat 5", "maplines demo: error: .*did you mean --rate?"),
        ("receive --channell=vcan0", "maplines receive: error: .*did you mean --channel?"),
        ("send --key car.key", "maplines send: error: .*did you mean --key"),
        ("study run --out d --sed 1", r"maplines study run: error: .*did you mean --seed\?"),
        ("study production --mark", r"maplines study production: error: .*mean --markdown\?"),
        ("demoo", r"maplines: error: .*did you mean demo\?"),
        ("study rum", r"maplines study: error: .*did you mean run\?"),
        ("demo --scenario highwai", r"maplines demo: error: .*did you mean highway\?"),
        ("receive --xyz", "maplines receive: error: .*'maplines receive --help' lists all options"),
        ("scenarios extra", "maplines scenarios: error: .*'maplines scenarios --help' lists"),
        ("--verion", "maplines: error: .*COMMAND"),
        ("", "maplines: error: .*see 'maplines --help'"),
        ("demo --correlation-time 0", "--correlation-time.*: must be"),
        ("decode --csv --scenes none.log", "--scenes.*: not allowed"),
        ("drive --sigma=1,2", "--sigma"),
        ("drive --sigma=a,b,c", "--sigma"),
        ("drive --sigma=-1,0,0", "--sigma"),
        ("drive --sigma=1,1,inf", "--sigma"),
    ],
)
def test_item_11_wrong_usage_is_an_error_of_its_command(
    command: str, words: str, capsys: Capture
) -> None:
    """Status 2; the one line names the command and the closest option, and no usage follows."""
    with pytest.raises(SystemExit, match="2"):
        main(command.split())
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(words, line), line
