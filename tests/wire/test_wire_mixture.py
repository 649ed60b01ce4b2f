"""Encoding of mixtures: complete or rejected, and never overconfident."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from answers import one
from hypothesis import given, settings
from hypothesis import strategies as st
from support.dbcs import default_codec, new_codec

from maplines_can import Gaussian, MapLine, Slot, Status
from maplines_can.study import adversarial, evaluate
from maplines_can.values.mixture import GaussianMixture


def random_mixtures(n: Any, k: Any, seed: Any) -> Any:
    means, covs = adversarial(n * k, seed, at_limit_share=0.02)
    spread = 0.05 * (means - means.reshape(n, k, 4)[:, :1].repeat(k, axis=1).reshape(-1, 4))
    means = means.reshape(n, k, 4)[:, :1] * 0.5 + spread.reshape(n, k, 4)
    weights = np.random.default_rng([seed, 7]).dirichlet(np.full(k, 2.0), n) + 1e-3
    return weights / weights.sum(axis=1, keepdims=True), means, covs.reshape(n, k, 4, 4)


def moments(weights: Any, means: Any, covs: Any) -> Any:
    mean = np.einsum("nk,nki->ni", weights, means)
    d = means - mean[:, None]
    return mean, np.einsum("nk,nkij->nij", weights, covs + d[..., :, None] * d[..., None, :])


@pytest.mark.parametrize("k", [2, 3, 5, 8])
def test_no_component_and_no_mixture_is_overconfident(k: int) -> None:
    """Random mixtures with singular components and weights between the steps."""
    weights, means, covs = random_mixtures(1000, k, seed=k)
    payloads = default_codec().batch.encode_mixtures(weights, means, covs)
    batch = default_codec().batch.decode(payloads.reshape(-1, 32))
    assert batch.accepted.all()
    components = evaluate(
        means.reshape(-1, 4),
        covs.reshape(-1, 4, 4),
        batch.mean,
        batch.cov,
        default_codec().resolution,
    )
    stated = batch.status != Status.OUT_OF_RANGE
    assert components.positive_definite.all()
    assert not components.overconfident[stated].any()
    w = batch.component_weight.reshape(-1, k)
    assert (w.sum(axis=1) == 1).all()
    mean, cov = moments(weights, means, covs)
    decoded = moments(w, batch.mean.reshape(-1, k, 4), batch.cov.reshape(-1, k, 4, 4))
    verdict = evaluate(mean, cov, *decoded, default_codec().resolution)  # type: ignore[call-arg]
    assert not verdict.overconfident[stated.reshape(-1, k).all(axis=1)].any()


def sent_lines(n: Any, k: Any, seed: int = 3) -> Iterator[Any]:
    weights, means, covs = random_mixtures(n, k, seed)
    for w, m, S in zip(weights, means, 1e-3 * covs, strict=True):
        components = tuple(Gaussian(mean, cov) for mean, cov in zip(m, S, strict=True))
        yield MapLine.of_mixture(Slot.CENTRE, GaussianMixture(w, components))


@settings(max_examples=20)
@given(st.integers(0, 2**32), st.sampled_from([2, 3, 8]), st.booleans())
def test_components_of_different_lines_are_not_combined(seed: int, k: Any, fd: bool) -> None:
    """Under loss, duplication and reordering each delivered mixture was sent, and only once."""
    rng = np.random.default_rng(seed)
    codec = new_codec()
    encoder = codec.encoder()
    sent = list(sent_lines(12, k, seed=seed % 1000))
    expected = {}
    stream = []
    for i, line in enumerate(sent):
        frames = encoder.encode(line, fd=fd)
        alone = codec.decoder()
        (line_alone,) = [
            answer
            for frame in frames
            if isinstance(answer := one(alone.feed(frame.can_id, frame.data, 0)), MapLine)
        ]
        expected[line_alone.mixture.means.tobytes()] = i  # type: ignore[union-attr]
        stream += [frame for frame in frames for _ in range(rng.choice([0, 1, 1, 1, 1, 1, 1, 2]))]
    order = np.argsort(np.arange(len(stream)) + rng.uniform(0, 2, len(stream)))
    decoder = codec.decoder()
    got = []
    for i, place in enumerate(order):
        answer = one(decoder.feed(stream[place].can_id, stream[place].data, i * 100_000))
        if isinstance(answer, MapLine):
            got.append(expected[answer.mixture.means.tobytes()])  # type: ignore[union-attr]
    assert got == sorted(set(got))
    assert decoder.frames == (decoder.line_frames + sum(decoder.counts.values()) + decoder.pending)
