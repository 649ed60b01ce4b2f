"""The inputs that the fuzzer has kept run in the tests, without the fuzzer."""

from collections import Counter
from pathlib import Path

import fuzz_inputs
import fuzz_scenes
import fuzz_targets
import pytest

from maplines_can.wire import Decoder, Reason

ROOT = Path(__file__).parents[1]
CORPUS = ROOT / "tests" / "corpus"
TARGETS = fuzz_scenes.ALL_TARGETS


@pytest.mark.parametrize("target", TARGETS)
def test_the_corpus_passes(target: str) -> None:
    """No input raises or breaks an invariant; the error names the first that does."""
    outcomes = Counter[str]()
    for path in sorted((CORPUS / target).iterdir()):
        try:
            outcomes += TARGETS[target](path.read_bytes())
        except Exception as error:
            raise AssertionError(f"{path.relative_to(ROOT)}: {error!r}") from error
    good, bad = {
        "decoder": ("line", "CRC"),
        "scenes": ("scene", "CRC"),
        "whole-scenes": ("scene", "CRC"),
        "logs": ("line", "LogError"),
        "dbc": ("layout", "LayoutError"),
    }[target]
    assert outcomes[good]  # the corpus passes the first checks
    assert outcomes[bad]


def test_the_seeds_pass() -> None:
    """The inputs beside those of the corpus fit into the maximum length and pass."""
    seeds = list(fuzz_inputs.SEEDS["dbc"]())
    assert seeds
    for seed in seeds:
        assert len(seed) <= fuzz_inputs.MOST["dbc"]
        TARGETS["dbc"](seed)


def test_a_broken_invariant_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A decoder that does not count a frame is a defect."""
    one = max((CORPUS / "decoder").iterdir(), key=lambda path: path.stat().st_size)
    monkeypatch.setattr(Decoder, "feed", lambda *_, **__: Reason.FOREIGN)

    with pytest.raises(fuzz_targets.InvariantError, match="accounted for"):
        fuzz_targets.decoder(one.read_bytes())
