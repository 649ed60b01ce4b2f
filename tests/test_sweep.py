"""The study: figures that add up exactly, chunks that repeat, and results that nothing disturbs."""

import argparse
import contextlib
import json
import math
import multiprocessing
import os
import signal
import subprocess
import sys
from fractions import Fraction
from importlib.metadata import PackageNotFoundError

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta

from maplines_can.cli.study import add_run
from maplines_can.errors import MaplinesError, StudyError
from maplines_can.gaussian import Gaussian
from maplines_can.polyline import Polyline
from maplines_can.propagation import MapError, Quadrature, Refit, SigmaPoints
from maplines_can.scenarios import SCENARIOS, pose
from maplines_can.study import evaluate, road
from maplines_can.study.dbc.record_spec import dbc_writer_for
from maplines_can.study.files import GaussianFile, read_map
from maplines_can.study.metrics import KL_BINS, RATIO_BINS, Figure, Score, kl_terms, share_se
from maplines_can.study.roads import lines_of_roads, random_roads
from maplines_can.study.sets import DrawnChunk, DrawnSet, line_set
from maplines_can.study.sweep.engines import Task, _check_versions, in_processes
from maplines_can.study.sweep.plan import Plan, codec_of, theory
from maplines_can.study.sweep.run import Study, run_study
from maplines_can.study.sweep.tables import SCHEMAS, TABLES, read_table, summary_text

CODES = ("Cholesky", "Sigmas")
NUMBERS = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e150, max_value=1e150)
POSITIVE = st.floats(2.0**-8, 2.0**23)


# ---- figures --------------------------------------------------------------------------


@given(st.lists(st.lists(NUMBERS, max_size=5), min_size=1, max_size=6), st.randoms())
def test_figures_of_chunks_add_up_exactly_in_any_order(chunks, random):
    """Sums, squares, extremes and bins do not depend on the order; sums are exact."""
    figures = [Figure.of(np.array(chunk, dtype=float), RATIO_BINS) for chunk in chunks]
    shuffled = random.sample(figures, len(figures))
    total = sum(figures[1:], figures[0])

    assert total.as_json() == sum(shuffled[1:], shuffled[0]).as_json()
    sums = [np.array(chunk, dtype=float).sum() for chunk in chunks]
    assert Fraction(total.total, 2**1074) == sum(map(Fraction, sums))
    assert total.count == sum(map(len, chunks))


@given(st.lists(NUMBERS, min_size=1, max_size=20))
def test_the_mean_of_single_numbers_is_rounded_once(values):
    """As math.fsum has it."""
    figures = [Figure.of(np.array([value])) for value in values]

    assert sum(figures[1:], figures[0]).mean == float(
        sum(map(Fraction, values)) / Fraction(len(values))
    )


@given(st.lists(POSITIVE | st.sampled_from([0.0, math.inf, math.nan]), max_size=30))
def test_a_figure_survives_its_file(values):
    """Through JSON and back, to the last bit."""
    figure = Figure.of(np.array(values, dtype=float), RATIO_BINS)
    there = Figure.from_json(json.loads(json.dumps(figure.as_json())))

    assert there.as_json() == figure.as_json()
    assert there.count == len(values)


@given(st.lists(POSITIVE, min_size=1, max_size=200), st.floats(0, 1))
def test_quantiles_lie_within_a_bin_of_the_true_ones(values, share):
    """The bins have 2^-9 of an octave; between which two values a quantile lies is a convention."""
    figure = Figure.of(np.array(values), RATIO_BINS)
    low, high = (
        np.quantile(values, share, method=method)
        for method in ("inverted_cdf", "closest_observation")
    )

    assert min(low, high) * (1 - 2**-9) <= figure.quantile(share)
    ordered = np.sort(values)
    nearest = np.searchsorted(ordered, max(low, high), side="right")
    assert figure.quantile(share) <= ordered[min(nearest, len(ordered) - 1)] * (1 + 2**-9)


@pytest.mark.parametrize("bins", [KL_BINS, RATIO_BINS])
def test_each_bin_holds_what_lies_between_its_edges(bins):
    """Also at the edges themselves, and one bit below them."""
    places = np.arange(bins.count)
    edges = np.array([bins.edge(place) for place in range(bins.count + 1)])

    for values in (edges[:-1], np.nextafter(edges[1:], 0), (edges[:-1] + edges[1:]) / 2):
        assert np.array_equal(np.repeat(places, bins.histogram(values)), places)
    assert bins.histogram(np.array([0.0]))[0] == bins.histogram(np.array([np.inf]))[-1] == 1


def test_means_and_errors_are_those_of_numpy():
    """Mean, standard error and root mean square of ordinary numbers."""
    values = np.random.default_rng(1).lognormal(size=1000)
    figure = Figure.of(values[:400]) + Figure.of(values[400:])

    assert figure.mean == pytest.approx(values.mean(), rel=1e-14)
    assert figure.mean_se == pytest.approx(values.std(ddof=1) / np.sqrt(1000), rel=1e-12)
    assert figure.rms == pytest.approx(np.sqrt((values**2).mean()), rel=1e-14)
    assert math.isnan(Figure.of(np.empty(0)).mean)
    assert (Figure.of(np.array([1.0, np.inf])) + figure).mean == np.inf


@pytest.mark.parametrize("share", [0.5, 0.99])
def test_the_error_of_a_quantile_is_that_of_its_sampling(share):
    """Seen on 400 samples of 2000 numbers, and told by each of them, in the mean."""
    samples = np.random.default_rng(2).lognormal(size=(400, 2000))
    told = [Figure.of(sample, RATIO_BINS).quantile_se(share) for sample in samples]

    assert np.mean(told) == pytest.approx(np.quantile(samples, share, axis=1).std(), rel=0.2)


@pytest.mark.parametrize(("count", "n"), [(0, 10), (3, 10), (10, 10), (0, 10**4)])
def test_the_error_of_a_share_is_that_of_laplace(count, n):
    """The standard deviation of the beta distribution; none of n is no certainty."""
    assert share_se(count, n) == pytest.approx(beta(count + 1, n - count + 1).std(), rel=1e-9)


def test_terms_of_the_divergence_add_up_to_it(codec):
    """Against Gaussian.kl."""
    means, covs = road(50, seed=4)
    decoded = codec.decode_batch(codec.encode_batch(means, covs)).cov
    terms = kl_terms(covs, decoded).sum(axis=(1, 2))

    expected = [
        Gaussian(np.zeros(4), S).kl(Gaussian(np.zeros(4), T))
        for S, T in zip(covs, decoded, strict=True)
    ]
    assert terms == pytest.approx(expected, rel=1e-6)


def test_scores_of_parts_add_up_to_that_of_all(codec):
    """All counts and bins, and the sums but for the rounding within a chunk."""
    means, covs = road(300, seed=5)

    def score(rows):
        batch = codec.decode_batch(codec.encode_batch(means[rows], covs[rows]))
        verdict = evaluate(means[rows], covs[rows], batch.mean, batch.cov, codec.resolution)
        return Score.of(verdict, batch.status, batch.accepted, np.zeros(len(batch.mean), bool))

    whole, parts = score(slice(None)), score(slice(100)) + score(slice(100, None))

    assert parts.counts == whole.counts
    for name, figure in whole.figures.items():
        assert parts.figures[name].mean == pytest.approx(figure.mean, rel=1e-13, nan_ok=True)
        assert parts.figures[name].greatest == figure.greatest
        assert np.array_equal(parts.figures[name].histogram, figure.histogram)


# ---- sets -----------------------------------------------------------------------------


@pytest.mark.parametrize("with_map_error", [False, True])
def test_roads_in_bulk_are_those_of_refit_and_sigma_points(with_map_error):
    """Means and covariances, within 1e-6 standard deviations; paper's are nearly singular."""
    roads = random_roads(300, np.random.default_rng(6), with_map_error=with_map_error)
    means, covs = lines_of_roads(roads)

    for i, n in enumerate(roads.number):
        error = MapError(*roads.map_error[i]) if with_map_error else None
        s_x, s_y, s_h = roads.sigma[i]
        ego = pose(s_x, s_y, np.degrees(s_h), roads.correlation[i])
        refit = Refit(Polyline(roads.points[i, :n]), ego.mean, (-1e3, 1e3), error)
        mean, cov = SigmaPoints().moments(refit, ego)
        sigma = np.sqrt(cov.diagonal())
        assert np.abs((means[i] - mean) / sigma).max() < 1e-6
        assert np.abs((covs[i] - cov) / np.outer(sigma, sigma)).max() < 1e-6


def test_a_road_across_the_car_gives_no_line():
    """As Refit refuses it."""
    roads = random_roads(3, np.random.default_rng(0), with_map_error=False)
    roads.points[1] = roads.points[1][:, ::-1] * [0.01, 1.0]
    means, covs = lines_of_roads(roads)

    assert np.isnan(means[1]).all()
    assert np.isnan(covs[1]).all()
    assert np.isfinite(means[[0, 2]]).all()


@pytest.mark.parametrize("name", ["paper", "road", "adversarial"])
def test_a_chunk_is_a_function_of_its_place_and_size(name):
    """Twice the same; another set, seed, place or size is another chunk."""
    first, again = (DrawnChunk(name, 7, 3, 60).gaussians() for _ in range(2))

    assert np.array_equal(first.mean, again.mean)
    assert np.array_equal(first.cov, again.cov)
    assert len(first.mean) == 60
    others = (DrawnChunk(name, 8, 3, 60), DrawnChunk(name, 7, 4, 60), DrawnChunk("paper", 7, 2, 60))
    for other in others:
        assert not np.isclose(first.mean, other.gaussians().mean).all(axis=1).any()


def test_the_first_chunk_begins_with_the_fixed_scenarios():
    """All their lines, in their order."""
    scene = SCENARIOS["highway"]
    refit = Refit(scene.polylines, scene.ego.mean, scene.window)
    means, covs = SigmaPoints().moments(refit, scene.ego)
    chunk = DrawnChunk("paper", 0, 0, 100).gaussians()

    assert np.array_equal(chunk.mean[: len(means)], means)
    assert np.array_equal(chunk.cov[: len(means)], covs)


def test_the_last_chunk_is_what_is_left():
    """And a file knows its own size."""
    assert DrawnSet("road").sizes(25, 10) == [10, 10, 5]


# ---- files of a user ------------------------------------------------------------------


def triangle(cov):
    """(N, 10) or (N, 6) upper triangles."""
    return cov[:, *np.triu_indices(cov.shape[1])]


def table_of(mean, cov):
    """Columns by name."""
    d = mean.shape[1]
    columns = {f"mean_{i}": mean[:, i] for i in range(d)}
    return columns | {f"cov_{i}{j}": cov[:, i, j] for i in range(d) for j in range(i, d)}


def write_csv(path, mean, cov):
    table = table_of(mean, cov)
    rows = np.column_stack(list(table.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(table), comments="", fmt="%.17g")


def write_parquet(path, mean, cov):
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pa.table(table_of(mean, cov)), path)


WRITERS = {
    "full.npz": lambda path, mean, cov: np.savez(path, mean=mean, cov=cov),
    "packed.npz": lambda path, mean, cov: np.savez_compressed(path, mean=mean, cov=triangle(cov)),
    "columns.npz": lambda path, mean, cov: np.savez(
        path, mean=np.asfortranarray(mean), cov=np.asfortranarray(cov)
    ),
    "table.csv": write_csv,
    "table.parquet": write_parquet,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_of_gaussians_comes_in_chunks(name, tmp_path):
    """The same Gaussians, whatever the form, in chunks of the size asked for."""
    means, covs = road(25, seed=8)
    WRITERS[name](tmp_path / name, means, covs)
    given_set = line_set(str(tmp_path / name))
    chunks = [chunk.gaussians() for chunk in given_set.chunks(1, 10, 0)]

    assert given_set.name == name
    assert given_set.sizes(1, 10) == [10, 10, 5] == [len(chunk.mean) for chunk in chunks]
    assert np.array_equal(np.concatenate([chunk.mean for chunk in chunks]), means)
    assert np.array_equal(np.concatenate([chunk.cov for chunk in chunks]), covs)


def broken(what):
    """Gaussians with one thing wrong in row 3."""
    means, covs = (array.copy() for array in road(5, seed=8))
    if what == "nan":
        means[3, 1] = np.nan
    elif what == "negative":
        covs[3, 0, 0] = -1
    elif what == "asymmetric":
        covs[3, 0, 1] *= 2
    elif what == "indefinite":
        covs[3, 0, 1] = covs[3, 1, 0] = 2 * np.sqrt(covs[3, 0, 0] * covs[3, 1, 1])
    return means, covs


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("nan", "row 3 .from 0. has a number that is not finite"),
        ("negative", "row 3 .* negative variance"),
        ("asymmetric", "row 3 .* not symmetric"),
        ("indefinite", "row 3 .* not positive semidefinite"),
    ],
)
def test_a_row_that_is_no_gaussian_is_named(what, message, tmp_path):
    """Before any work is done."""
    means, covs = broken(what)
    np.savez(tmp_path / "bad.npz", mean=means, cov=covs)

    with pytest.raises(StudyError, match=message):
        line_set(str(tmp_path / "bad.npz"))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", b"", "a file is one of .npz, .csv, .parquet"),
        ("a.npz", b"no archive", "cannot be read"),
        ("a.csv", b"mean_0,mean_1\n1,2\n", "there is no mean_2"),
        ("a.csv", b"", "there is no mean_0"),
        ("a.csv", b"\xff\xfe", "cannot be read"),
        ("a.parquet", b"no table", "cannot be read"),
    ],
)
def test_a_file_that_does_not_serve_is_told_in_one_line(name, content, message, tmp_path):
    """What is wrong with it, not where in our code."""
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    (tmp_path / name).write_bytes(content)

    with pytest.raises(MaplinesError, match=message):
        line_set(str(tmp_path / name))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["1," * 13 + "x"], "row 0"),
        (["1," * 12 + "1"], "names 14 columns, but row 0 has 13"),
        ([], "has no rows"),
    ],
)
def test_a_csv_with_bad_rows_is_refused(rows, message, tmp_path):
    """A word, a missing number, nothing at all."""
    columns = list(table_of(*road(1, seed=0)))
    (tmp_path / "a.csv").write_text("\n".join([",".join(columns), *rows]))

    with pytest.raises(StudyError, match=message):
        GaussianFile.opened(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"mean": np.zeros((3, 4))}, "there is no cov"),
        ({"mean": np.zeros((3, 5)), "cov": np.zeros((3, 5, 5))}, "shape"),
        ({"mean": np.zeros((3, 4)), "cov": np.zeros((2, 4, 4))}, "shape"),
        ({"mean": np.array([["a"] * 4]), "cov": np.zeros((1, 4, 4))}, "numbers"),
    ],
)
def test_arrays_of_other_shapes_are_refused(arrays, message, tmp_path):
    """With the shapes that would do."""
    np.savez(tmp_path / "a.npz", **arrays)

    with pytest.raises(StudyError, match=message):
        GaussianFile.opened(tmp_path / "a.npz")


def write_map(path, lines):
    rows = [f"{name},{x},{y}" for name, points in lines.items() for x, y in points]
    path.write_text("\n".join(["line,x,y", *rows]))


@pytest.fixture
def drive(tmp_path):
    """Poses along a straight road of two lines; a third line is far aside, a fourth behind."""
    x = np.arange(0, 300, 2.0)
    straight = {name: np.column_stack([x, 0 * x + y]) for name, y in (("l", 1.8), ("r", -1.8))}
    away = {
        "far": np.column_stack([x, 0 * x + 90]),
        "behind": np.column_stack([x[:9] - 400, x[:9]]),
    }
    write_map(tmp_path / "map.csv", straight | away)
    means = np.column_stack([[50.0, 100.0, 150.0], [0.0, 0.1, -0.1], np.radians([0.0, 1.0, -1.0])])
    covs = np.tile(np.diag([0.3, 0.1, 0.01]) ** 2, (3, 1, 1))
    write_csv(tmp_path / "drive.csv", means, covs)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "transform"), [("sigma-points", SigmaPoints()), ("quadrature", Quadrature())]
)
def test_poses_see_the_lines_of_their_map(name, transform, drive):
    """Those near the road, as Refit and the transform have them."""
    path = str(drive / "drive.csv")
    given_set = line_set(path, map_path=drive / "map.csv", transform=name)
    chunks = [chunk.gaussians() for chunk in given_set.chunks(1, 2, 0)]
    lines, _ = read_map(drive / "map.csv")
    refit = Refit(lines[0], [50.0, 0.0, 0.0], (-20.0, 80.0))
    mean, cov = transform.moments(refit, Gaussian([50.0, 0.0, 0.0], np.diag([0.3, 0.1, 0.01]) ** 2))

    assert given_set.sizes(1, 2) == [2, 1]
    assert [len(chunk.mean) for chunk in chunks] == [4, 2]
    assert chunks[0].mean[0] == pytest.approx(mean)
    assert chunks[0].cov[0] == pytest.approx(cov)


def test_poses_that_see_nothing_make_an_empty_study(drive):
    """With tables and their text, and nothing known."""
    pytest.importorskip("pyarrow")
    write_csv(drive / "lost.csv", np.array([[-900.0, 0, 0]]), np.eye(3)[None] / 100)
    given_set = line_set(str(drive / "lost.csv"), map_path=drive / "map.csv")
    study = small(sets=[given_set], codes=("Cholesky",), fields_n=1, limit_n=1)
    result = tables(run_study(study, drive / "out", jobs=1))

    assert result["summary"][0]["n"] == 0
    assert result["summary"][0]["kl_mean"] is None
    assert "lost.csv: 0 Gaussians" in summary_text(result["summary"], result["terms"])


def test_poses_need_a_map(drive):
    """And say so."""
    with pytest.raises(StudyError, match="give the lines of their map with --map"):
        line_set(str(drive / "drive.csv"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n1,2", "there is no line"),
        ("line,x,y\n", "has no points"),
        ("line,x,y\na,1,2\na,b,2", "line 3"),
        ("line,x,y\na,1,2\na,1", "line 3"),
        ("line,x,y\na,1,2\nb,1,2", "line 'a'"),
        ("line,x,y\na,1,2\na,1,3\nb,1,2\nb,3,2\na,4,4", "two places"),
        ("line,x,y\na,1,2\na,inf,3", "line 'a'"),
    ],
)
def test_a_map_that_does_not_serve_is_refused(text, message, tmp_path):
    """With the line of the file or the name of the map's line."""
    (tmp_path / "map.csv").write_text(text)

    with pytest.raises(StudyError, match=message):
        read_map(tmp_path / "map.csv")


def test_there_is_no_such_set():
    """The names of those that there are."""
    with pytest.raises(StudyError, match="sets are paper, road, hostile"):
        line_set("moon")


# ---- widths ---------------------------------------------------------------------------


def test_a_single_field_is_wider_over_the_same_range():
    """And all others stay; of the mean too."""

    def fields(contract):
        return {spec.name: spec for page in contract.pages for spec in page}

    plain = fields(dbc_writer_for("Cholesky"))
    for name in ("RatioC0C1", "YOff"):
        wider = fields(dbc_writer_for("Cholesky", 0, {name: 1}))
        assert wider[name].bits == plain[name].bits + 1
        assert wider[name].range[0] == plain[name].range[0]
        assert wider[name].factor == plain[name].factor / 2
        assert {**wider, name: None} == {**plain, name: None}
    with pytest.raises(ValueError, match="field_bits must be of YOff"):
        dbc_writer_for("Cholesky", 0, {"Crc": 1})


def test_the_theory_of_equal_steps_is_the_one_of_the_notes():
    """10 steps^2 / 24 for ten equal steps; here the weighted sum of the default's."""
    terms = theory(codec_of(Plan("Cholesky")))

    assert len(terms) == 10
    assert terms["RatioC0C1"] == pytest.approx((1 / 32) ** 2 / 24)
    assert terms["PivotYOff"] == pytest.approx((0.034 * math.log(2)) ** 2 / 12)
    assert theory(codec_of(Plan("Sigmas"))) == {}


# ---- the run --------------------------------------------------------------------------


def small(**changes):
    settings_ = {"codes": CODES, "finer_bits": (0,), "n": 400, "chunk_size": 50, "fields_n": 0}
    return Study(**{"sets": [DrawnSet("road")], "limit_n": 0, "seed": 3, **settings_, **changes})


def tables(directory):
    """All tables without the times."""
    result = {name: read_table(directory, name) for name in TABLES}
    for row in result["summary"]:
        del row["seconds"], row["gaussians_per_second"]
    return result


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The tables of the small study, made in one go in this process."""
    pytest.importorskip("pyarrow")
    return tables(run_study(small(), tmp_path_factory.mktemp("study"), jobs=1))


def test_the_summary_is_what_judging_all_at_once_gives(undisturbed):
    """The chunks through the codec and judge by hand."""
    chunks = [DrawnChunk("road", 3, i, 50).gaussians() for i in range(8)]
    means, covs = (np.concatenate(arrays) for arrays in zip(*chunks, strict=True))
    codec = codec_of(Plan("Cholesky"))
    batch = codec.decode_batch(codec.encode_batch(means, covs))
    verdict = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
    row = undisturbed["summary"][0]

    assert (row["set"], row["code"], row["finer_bits"], row["n"]) == ("road", "Cholesky", 0, 400)
    assert row["kl_mean"] == pytest.approx(verdict.kl_covered.mean(), rel=1e-12)
    assert row["kl_max"] == verdict.kl_covered.max()
    assert row["kl_p50"] == pytest.approx(np.median(verdict.kl_covered), rel=0.02)
    assert row["sigma_ratio_p99_80"] == pytest.approx(
        np.quantile(verdict.sigma_ratio[:, 3], 0.99), rel=0.005
    )
    assert row["not_positive_definite"] == row["overconfident"] == row["out_of_range"] == 0
    assert (row["covariance_bits"], row["record_bits"], row["classic_frames"]) == (105, 256, 4)
    assert row["kl_theory"] == pytest.approx(sum(theory(codec).values()))


def test_the_worst_cases_are_the_worst(undisturbed):
    """Five of each code, in order, with all that is known of them."""
    worst = [row for row in undisturbed["worst"] if row["code"] == "Cholesky"]
    kl = [row["kl"] for row in worst]

    assert [row["rank"] for row in worst] == [1, 2, 3, 4, 5]
    assert kl == sorted(kl, reverse=True)
    assert kl[0] == undisturbed["summary"][0]["kl_max"]
    cov = np.array([worst[0][f"cov_{i}{j}"] for i in range(4) for j in range(4)]).reshape(4, 4)
    decoded = np.array(
        [worst[0][f"decoded_cov_{i}{j}"] for i in range(4) for j in range(4)]
    ).reshape(4, 4)
    assert np.linalg.eigvalsh(decoded - cov)[0] > -1e-15
    assert worst[0]["status"] == "FULL"


def test_tables_have_the_columns_that_are_told(undisturbed):
    """Even where a table has no row."""
    for name, rows in undisturbed.items():
        for row in rows:
            assert row.keys() | {"seconds", "gaussians_per_second"} >= SCHEMAS[name].keys()
    assert undisturbed["limit"] == undisturbed["fields"] == []
    assert "Cholesky" in summary_text(undisturbed["summary"], undisturbed["terms"])


def test_means_that_met_the_end_of_their_range_are_apart(tmp_path):
    """Their error is no rounding; the covariance covers it."""
    pytest.importorskip("pyarrow")
    means, covs = road(50, seed=8)
    means[7, 0] = 33.0
    np.savez(tmp_path / "mine.npz", mean=means, cov=covs)
    study = small(sets=[line_set(str(tmp_path / "mine.npz"))], codes=("Cholesky",))
    row = tables(run_study(study, tmp_path / "out", jobs=1))["summary"][0]

    assert row["clipped"] == row["saturated"] == 0.02
    assert row["clipped_error_max_80"] == pytest.approx(1, abs=0.01)
    assert row["mean_error_max_80"] < 0.005
    assert row["overconfident"] == 0


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_interrupted_study_goes_on_to_the_same_result(jobs, undisturbed, tmp_path):
    """Ctrl-C in the middle; what was done is not done again."""

    def interrupt(done, total):
        if done >= 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(small(), tmp_path / "out", jobs=jobs, progress=interrupt)
    assert multiprocessing.active_children() == []
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "chunks").iterdir()}
    assert 2 <= len(kept) < 8

    assert undisturbed == tables(run_study(small(), tmp_path / "out", jobs=1))
    assert kept.items() <= {path: path.stat().st_mtime_ns for path in kept}.items()


def test_a_study_that_is_done_is_not_done_again(undisturbed, tmp_path):
    """Only its tables are written anew, to the last byte."""
    out = tmp_path / "out"
    run_study(small(), out, jobs=1)
    before = {path.name: path.read_bytes() for path in out.glob("*.parquet")}
    seen = []
    run_study(small(), out, jobs=1, progress=lambda *progress: seen.append(progress))

    assert seen == [(400, 400)]
    assert before == {path.name: path.read_bytes() for path in out.glob("*.parquet")}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 4}, "there seed is 3, and now 4"),
        ({"n": 401}, "there n is 400"),
        ({"codes": ("Cholesky",)}, "there codes is"),
        ({"sets": [DrawnSet("paper")]}, "there sets is"),
    ],
)
def test_another_study_in_the_same_directory_is_refused(changes, message, tmp_path):
    """What differs is told, and nothing is touched."""
    pytest.importorskip("pyarrow")
    run_study(small(n=50), tmp_path / "out", jobs=1)
    manifest = (tmp_path / "out" / "study.json").read_text()
    (tmp_path / "out" / "study.json").write_text(manifest.replace('"n": 50', '"n": 400'))

    with pytest.raises(StudyError, match=message):
        run_study(small(**changes), tmp_path / "out", jobs=1)


def test_a_directory_of_other_things_is_refused(tmp_path):
    """A study does not mix with what it does not know."""
    pytest.importorskip("pyarrow")
    (tmp_path / "thesis.tex").touch()

    with pytest.raises(StudyError, match="holds other things"):
        run_study(small(), tmp_path, jobs=1)


def test_a_damaged_result_is_named(tmp_path):
    """With the cure."""
    pytest.importorskip("pyarrow")
    run_study(small(n=50), tmp_path / "out", jobs=1)
    path = tmp_path / "out" / "chunks" / "0-000000.json.gz"
    path.write_bytes(path.read_bytes()[:100])

    with pytest.raises(StudyError, match=r"0-000000.json.gz: cannot be read .* delete it"):
        run_study(small(n=50), tmp_path / "out", jobs=1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n": 0}, "n must be 1 or more"),
        ({"codes": ("Morse",)}, "there is no code 'Morse'"),
        ({"codes": ("Cholesky", "Cholesky")}, "different"),
        ({"finer_bits": (-9,)}, "Cholesky with -9 bits"),
        ({"codes": ("Float32",), "finer_bits": (1,)}, "add 0"),
        ({"sets": [DrawnSet("road"), DrawnSet("road")]}, "different names"),
        ({"sets": []}, "one or more"),
    ],
)
def test_a_study_that_makes_no_sense_is_refused(changes, message):
    """At once."""
    with pytest.raises(StudyError, match=message):
        small(**changes)


def test_a_killed_process_changes_nothing(undisturbed, tmp_path):
    """Each process dies once in the middle, its work is done by another."""
    killed = []

    def kill(done, total):
        if done and not killed:
            for child in multiprocessing.active_children():
                os.kill(child.pid, signal.SIGKILL)
                killed.append(child.pid)

    result = tables(run_study(small(), tmp_path / "out", jobs=2, progress=kill))

    assert killed
    assert undisturbed == result


class Deadly(Task):
    """A task that kills whoever takes it, as the kernel does when memory is short."""

    key, weight = "deadly", 1

    def content(self):
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_task_that_kills_each_process_is_given_up(monkeypatch):
    """With advice, and not for ever tried again."""
    monkeypatch.setattr("maplines_can.study.sweep.engines.DEATHS", 1)

    with pytest.raises(StudyError, match=r"died 2 times in a row; make chunks smaller"):
        list(in_processes(iter([Deadly()]), 1))


def test_fields_terms_and_limits(tmp_path):
    """A bit more in a field costs no divergence; theory holds; a limit of too few is refused."""
    pytest.importorskip("pyarrow")
    study = small(
        codes=("Cholesky",), finer_bits=(0, 2), n=1700, chunk_size=850, fields_n=850, limit_n=1700
    )
    result = tables(run_study(study, tmp_path / "out", jobs=1))
    fields = {(row["field"], row["delta_bits"]): row for row in result["fields"]}
    limits = {(row["part"], row["kl"]): row for row in result["limit"]}
    fine = result["summary"][1]

    assert len(fields) == 2 * (4 + 11)
    more, less = fields["RatioC0C1", 1], fields["RatioC0C1", -1]
    assert more["kl_change_mean"] < -5 * more["kl_change_mean_se"] < 0
    assert less["kl_change_mean"] > 5 * less["kl_change_mean_se"] > 0
    assert fields["C1", 1]["lateral_rms_80"] < fields["C1", -1]["lateral_rms_80"]
    assert fine["finer_bits"] == 2
    error = 4 * fine["kl_before_inflation_mean_se"] / fine["kl_theory"]
    assert fine["kl_before_inflation_mean"] / fine["kl_theory"] == pytest.approx(1, abs=error)
    assert {row["field"] for row in result["terms"]} == theory(codec_of(Plan("Cholesky"))).keys()
    assert limits["covariance", 1e-4]["bits"] > limits["covariance", 1e-3]["bits"] > 20
    assert limits["all", 1e-3]["bits"] is None
    assert "draw more" in limits["all", 1e-3]["caveat"]


def test_a_file_and_poses_in_one_study(drive):
    """Taken whole, whatever n is."""
    pytest.importorskip("pyarrow")
    means, covs = road(25, seed=8)
    np.savez(drive / "mine.npz", mean=means, cov=covs)
    sets = [
        line_set(str(drive / "mine.npz")),
        line_set(str(drive / "drive.csv"), map_path=drive / "map.csv"),
    ]
    study = small(sets=sets, codes=("Cholesky",), n=1, chunk_size=10)
    summary = tables(run_study(study, drive / "out", jobs=2))["summary"]

    assert [(row["set"], row["n"]) for row in summary] == [("mine.npz", 25), ("drive.csv", 6)]
    np.savez(drive / "mine.npz", mean=means[::-1], cov=covs[::-1])
    changed = small(
        sets=[line_set(str(drive / "mine.npz")), sets[1]], codes=("Cholesky",), n=1, chunk_size=10
    )
    with pytest.raises(StudyError, match="there sets is"):
        run_study(changed, drive / "out", jobs=1)


# ---- a cluster ------------------------------------------------------------------------


@contextlib.contextmanager
def dask_process(*arguments):
    """A process of Dask's command line, and all that it says."""
    command = [sys.executable, "-m", *arguments, "--host", "127.0.0.1", "--no-dashboard"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_killed_dask_worker_changes_nothing(undisturbed, tmp_path):
    """A scheduler, two workers, one of them killed while it has work: the same to the last bit."""
    distributed = pytest.importorskip("distributed")
    scheduler_module, worker_module = (
        "distributed.cli.dask_scheduler",
        "distributed.cli.dask_worker",
    )
    killed = []
    with contextlib.ExitStack() as stack:
        scheduler = stack.enter_context(dask_process(scheduler_module, "--port", "0"))
        said = iter(scheduler.stderr.readline, "")
        address = next(line.split()[-1] for line in said if "Scheduler at:" in line)
        worker = (worker_module, address, "--nthreads", "1", "--no-nanny")
        workers = [stack.enter_context(dask_process(*worker)) for _ in range(2)]
        watcher = stack.enter_context(distributed.Client(address))
        watcher.wait_for_workers(2, timeout=30)
        pids = watcher.run(os.getpid)
        victim = next(name for name, pid in pids.items() if pid == workers[0].pid)

        def kill(done, total):
            if done and not killed and watcher.processing()[victim]:
                os.kill(pids[victim], signal.SIGKILL)
                assert workers[0].wait() == -signal.SIGKILL
                killed.append(done)

        result = tables(run_study(small(), tmp_path / "out", scheduler=address, progress=kill))

    assert killed
    assert killed[0] < 400
    assert undisturbed == result


@pytest.mark.parametrize("there", [{"tcp://a": "0.0.1"}, PackageNotFoundError])
def test_workers_of_another_version_are_refused(there):
    """Their results would be of another program."""

    class Client:
        def run(self, _function, package):
            if isinstance(there, dict):
                return there
            raise there(package)

    with pytest.raises(StudyError, match=r"need maplines_can .*; they have (0.0.1|none)"):
        _check_versions(Client(), "tcp://b")


def test_a_scheduler_that_is_not_there_is_told(tmp_path, monkeypatch):
    """In one line, with its address."""
    pytest.importorskip("distributed")
    pytest.importorskip("pyarrow")
    monkeypatch.setattr("maplines_can.study.sweep.engines.PATIENCE", 0.2)

    with pytest.raises(StudyError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9"):
        run_study(small(), tmp_path / "out", scheduler="tcp://127.0.0.1:9")


# ---- the command ----------------------------------------------------------------------


def command(*arguments):
    parser = argparse.ArgumentParser(prog="maplines")
    seen = []

    @contextlib.contextmanager
    def bar(unit):
        yield lambda done, total: seen.append((done, total))

    add_run(parser.add_subparsers(), bar)
    parsed = parser.parse_args(["run", *map(str, arguments)])
    return parsed.run(parsed), seen


SMALL = ("--code", "Cholesky", "--finer", "-1", "0", "--set", "road", "--n", "2e2", "--jobs", 1)


def test_the_command_prints_what_came_out(tmp_path, capsys, monkeypatch):
    """A table for people, rows for machines; the second time nothing is done again."""
    pytest.importorskip("pyarrow")
    monkeypatch.setattr("maplines_can.cli.study.DEFAULTS", {"fields_n": 0, "limit_n": 0})
    status, seen = command("--out", tmp_path / "out", *SMALL)
    text = capsys.readouterr().out

    assert status == 0
    assert seen == [(0, 200), (200, 200)]
    assert "road: 200 Gaussians" in text
    assert "over its theory" in text
    status, seen = command("--out", tmp_path / "out", *SMALL, "--json")
    rows = json.loads(capsys.readouterr().out)
    assert status == 0
    assert seen == [(200, 200)]
    assert [(row["code"], row["finer_bits"]) for row in rows] == [("Cholesky", -1), ("Cholesky", 0)]


def test_the_help_teaches(capsys):
    """Sets, files, tables and how to go on."""
    with pytest.raises(SystemExit):
        command("--help")
    text = capsys.readouterr().out

    for word in ("paper", "road", "cov_00", "Parquet", "dask scheduler", "goes on"):
        assert word in text


@pytest.mark.parametrize(
    "arguments", [("--n", "0"), ("--n", "1.5"), ("--finer", "99"), ("--code", "Morse")]
)
def test_wrong_usage_is_told(arguments, tmp_path, capsys):
    """By argparse, with status 2."""
    with pytest.raises(SystemExit, match="2"):
        command("--out", tmp_path / "out", *arguments)
    assert arguments[0] in capsys.readouterr().err
