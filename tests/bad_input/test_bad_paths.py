"""A path that no file can have is one clear error of the kind of the file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import maplines_can as ml
from maplines_can import maps
from maplines_can.bus import LogWriter, key_from_file, read_log, read_signals
from maplines_can.logs.signal_log import read_table
from maplines_can.simulation.truth import TruthWriter, read_truth
from maplines_can.study.files import GaussianFile, read_map
from maplines_can.study.sweep.plan import StudyDirectory
from maplines_can.values.errors import (
    DriveFileError,
    KeyMaterialError,
    LayoutError,
    LogError,
    MapFileError,
    StudyError,
)


def study_directory(path: str) -> StudyDirectory:
    return StudyDirectory(Path(path), {})


def signals(path: str) -> Any:
    return read_signals("drive.log", path, {"speed": "Speed"})


def truth(path: str) -> TruthWriter:
    return TruthWriter(path, [ml.Slot.EGO_LEFT])


OPENERS: list[tuple[Callable[[Any], Any], str, type[Exception]]] = [
    *((maps.load, suffix, MapFileError) for suffix in (".xodr", ".osm", ".csv.gz")),
    *((read_log, s, LogError) for s in ("", ".log", ".asc.gz", ".blf", ".csv", ".db", ".trc")),
    *((lambda path: LogWriter(path, 0.0), suffix, LogError) for suffix in (".log", ".blf")),
    (ml.Codec.from_dbc, ".dbc", LayoutError),
    (signals, ".dbc", LayoutError),
    (read_table, ".toml", DriveFileError),
    (ml.simulation.RecordedDrive.from_csv, ".csv", DriveFileError),
    *((read_truth, suffix, DriveFileError) for suffix in (".csv", ".parquet")),
    *((truth, suffix, DriveFileError) for suffix in (".csv", ".parquet")),
    *((lambda p: GaussianFile.opened(Path(p)), s, StudyError) for s in (".npz", ".csv")),
    (lambda path: read_map(Path(path)), ".csv", StudyError),
    (study_directory, "", StudyError),
    (key_from_file, ".key", KeyMaterialError),
]


@pytest.mark.parametrize("name", ["a\0b", "\0", "folder/a\0", "/dev/null\0"])
@pytest.mark.parametrize(("opener", "suffix", "error"), OPENERS)
def test_a_path_with_a_nul_is_one_clear_error(
    opener: Callable[[Any], Any], suffix: str, error: type[Exception], name: str
) -> None:
    """The operating system would end the path there; the message does not have it as such."""
    with pytest.raises(error) as caught:
        opener(name + suffix)
    text = str(caught.value).lower()
    assert "nul" in text
    assert "\n" not in text
