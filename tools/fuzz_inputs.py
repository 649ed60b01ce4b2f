"""Seeds and mutators of the fuzzer, by target; see fuzz.py. They run without the fuzzer too."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from fuzz_targets import SUFFIXES

from maplines_can.generation.dbc.record_spec import DEFAULT, SCENES, WHOLE_SCENES
from maplines_can.study.code_dbcs import dbc_writer_for
from maplines_can.values.line import Slot
from maplines_can.wire.layout.pose_layout import SCENE

# ---- logs --------------------------------------------------------------------------------

#: Replacements for a token of a log.
LOG_TOKENS = (
    *("0", "1", "8", "9", "64", "65", "-1", "0.0", "1e9", "1e308", "1e999", "nan", "inf", "-inf"),
    *("340", "348", "340x", "1FFFFFFF", "FFFFFFFF", "FFFFFFFFF", "340#", "348##0", "#R", "#R8"),
    *("20000080#0000000000000000", "d", "r", "Rx", "Tx", "RxRd", "ErrorFrame", "CANFD", "CAN"),
    *("base hex timestamps absolute", "base dec", "Begin Triggerblock", "End TriggerBlock"),
    *("Begin Triggerblock Mon Feb 30 25:61:61.1 2020", "date Sat Sep 30 15:06:13.191 2017"),
    *(";$FILEVERSION=1.0", ";$FILEVERSION=2.1", ";$STARTTIME=1e999", ";$STARTTIME=0", "ST", "FD"),
    *(";$COLUMNS=N,O,T,I,d,L,D", ";$COLUMNS=N,O,T,B,I,d,R,L,D", "DT", "ER", "RR", "EC", "HW"),
    *("timestamp,arbitration_id,extended,remote,error,dlc,data", "====", "AAAAAAAAAAA=", "can0"),
    *("Statistic:", "// ", "\x1a", "\0", "\r", "\xa0", "\xb2"),
)


# ---- DBCs --------------------------------------------------------------------------------

#: Replacements for a token of a DBC.
DBC_TOKENS = (
    *("0", "1", "2", "3", "4", "7", "8", "15", "16", "31", "32", "62", "63", "64", "65", "255"),
    *("-1", "1e9", "1e308", "1e999", "-1e308", "1e-320", "nan", "0.5", "65536", "4294967295"),
    *("2147483648", "2147484480", "18446744073709551616", "m", "M", "m0", "m1", "m9", "m0M"),
    *(
        "@0+",
        "@0-",
        "@1+",
        "@1-",
        '""',
        '"x"',
        "Page",
        "Page0",
        "Page1",
        "TransferId0",
        "TransferId1",
        "Crc",
    ),
    *("Counter", "YOff", "Beta", "C0", "C1", "Status", "Kind", "XMin", "XMax", "Age", "Mac"),
    *("ComponentIndex", "ComponentCount", "ComponentWeight", "KeyId", "Freshness", "EgoLeft"),
    *("MapLineScene", "SceneCounter", "EgoRight", "Line2", "Line3", "Slot", "OwnTilt", '"Scene"'),
    *("MapLineSlot", "E2EDataId", "SecOCDataId", "GenMsgCycleTime", "VFrameFormat"),
    *("CovarianceCode", '"MeanOnly"', '"Sigmas"', '"Cholesky"', '"Float32Triangle"', "INT"),
    *("FLOAT", "STRING", "ENUM", "HEX", "BO_", "SG_", "BA_", "BA_DEF_", "BA_DEF_DEF_", "VAL_"),
    *("SIG_VALTYPE_", "SG_MUL_VAL_", "CM_", "EV_", "\0", "\xe9"),
)


def short_dbc(code: str, secured: bool = False) -> str:
    """Return a DBC of one slot, without comments and value names."""
    writer = replace(
        DEFAULT,
        pages=dbc_writer_for(code).pages,
        covariance_code=code,
        slots=(Slot.EGO_LEFT,),
        first_secured_can_id=0x350 if secured else None,
    )
    return shortened(writer.dbc())


def scene_dbc() -> str:
    """Return a DBC of whole scenes of three lines."""
    scene = replace(SCENES, places=3, fixed={SCENE: SCENES.fixed[SCENE]})
    return shortened(replace(WHOLE_SCENES, scene=scene).dbc())


def shortened(text: str) -> str:
    """Return a DBC without comments and value names."""
    text = re.sub(r"^(CM_|VAL_) .*?;\n", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"NS_ :.*?BS_:", "BS_:", text, flags=re.DOTALL)
    return re.sub(r"\n\n+", "\n", text).replace("  ", " ")


def dbc_seeds() -> Iterator[bytes]:
    """Yield DBCs of several covariance codes and layouts."""
    for code in ("MeanOnly", "Sigmas", "Cholesky", "Float32"):
        yield short_dbc(code).encode("cp1252")
    only_classic = short_dbc("MeanOnly")
    yield re.sub(r"BO_ 840.*?(?=BO_TX|BA_DEF)", "", only_classic, flags=re.DOTALL).encode()
    yield re.sub(r"@1([+-])", r"@0\1", only_classic).encode()
    yield short_dbc("MeanOnly", secured=True).encode()
    yield scene_dbc().encode()


def mutate_dbc(data: bytes, seed: int) -> bytes:
    """Return a mutated DBC."""
    return mutate(data.decode("cp1252", "replace"), DBC_TOKENS, seed).encode("cp1252", "replace")


def mutate_log(data: bytes, seed: int) -> bytes:
    """Return a mutated log; sometimes only its format changes."""
    text = data[1:].decode("latin-1")
    if seed % 16 == 0 or not data:
        return bytes([seed // 16 % len(SUFFIXES)]) + data[1:]
    return data[:1] + mutate(text, LOG_TOKENS, seed).encode("latin-1")


def mutate(text: str, words: Sequence[str], seed: int) -> str:
    """Return the text with tokens and lines replaced, duplicated, exchanged or removed."""
    rng = random.Random(seed)  # noqa: S311
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if rng.random() < 0.3:
            lines = text.split("\n")
            i, j = (rng.randrange(len(lines)) for _ in range(2))
            what = rng.randrange(4)
            if what == 0:
                del lines[i]
            elif what == 1:
                lines.insert(j, lines[i])
            elif what == 2:
                lines[i], lines[j] = lines[j], lines[i]
            else:
                del lines[min(i, j) : max(i, j)]
            text = "\n".join(lines)
            continue
        tokens = re.split(r'("[^"]*"|[A-Za-z_]\w*|@[01][+-]|-?[\d.]+(?:e-?\d+)?)', text)
        odd = range(1, len(tokens), 2)
        if odd:
            new = rng.choice(words) if rng.random() < 0.7 else tokens[rng.choice(odd)]
            tokens[rng.choice(odd)] = new
        text = "".join(tokens)
    return text


#: Inputs beside those of the corpus, which follow the layout of a DBC.
SEEDS: dict[str, Callable[[], Iterator[bytes]]] = {"dbc": dbc_seeds}
#: Mutators of the targets for which mutated bytes would hardly pass the first check.
MUTATORS: dict[str, Callable[[bytes, int], bytes]] = {"dbc": mutate_dbc, "logs": mutate_log}
#: Maximum length of an input [bytes].
MOST = {"decoder": 1024, "scenes": 1024, "whole-scenes": 1024, "logs": 6144, "dbc": 24_576}
