"""What the fuzzer kept is tried again at each run of the tests, without the fuzzer."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CORPUS = ROOT / "tests" / "corpus"
TARGETS = ("decoder", "logs", "dbc")


@pytest.fixture(scope="module")
def targets():
    pytest.importorskip("cryptography")
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import fuzz_targets
    finally:
        sys.path.remove(str(ROOT / "tools"))
    return fuzz_targets


@pytest.mark.parametrize("target", TARGETS)
def test_the_corpus_holds(targets, target):
    """No input raises, and no promise is broken; the first that does is named."""
    told = {}
    for path in sorted((CORPUS / target).iterdir()):
        try:
            for what, n in targets.TARGETS[target](path.read_bytes()).items():
                told[what] = told.get(what, 0) + n
        except Exception as error:
            raise AssertionError(f"{path.relative_to(ROOT)}: {error!r}") from error
    good, bad = {
        "decoder": ("line", "CRC"),
        "logs": ("line", "LogError"),
        "dbc": ("layout", "LayoutError"),
    }[target]
    assert told[good]  # the corpus gets past the first checks
    assert told[bad]


@pytest.mark.parametrize("target", TARGETS)
def test_the_seeds_hold(targets, target):
    """What the fuzzer starts from is read as a whole."""
    seeds = list(targets.SEEDS[target]())
    assert seeds
    for seed in seeds:
        assert len(seed) <= targets.MOST[target]
        targets.TARGETS[target](seed)


def test_a_broken_promise_is_seen(targets, monkeypatch):
    """The fuzzer is not blind: a decoder that loses a frame from its books is a defect."""
    seed = next(targets.SEEDS["decoder"]())
    monkeypatch.setattr(targets.Monitor, "feed", lambda *_, **__: targets.Reason.FOREIGN)

    with pytest.raises(targets.BrokenError, match="accounted for"):
        targets.decoder(seed)


@pytest.mark.parametrize("target", TARGETS)
def test_the_corpus_is_small(target):
    """A clone takes it along."""
    sizes = [path.stat().st_size for path in (CORPUS / target).iterdir()]
    assert 10 < len(sizes) < 200
    assert sum(sizes) < 300_000
