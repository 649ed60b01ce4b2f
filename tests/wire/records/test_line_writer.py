"""Writer of one line: the bits of a batch, whatever the line and the DBC."""

from collections import Counter
from typing import Any

import numpy as np
import pytest
from c_layouts import with_slots
from c_lines import awkward_lines
from hypothesis import given
from hypothesis import strategies as st
from random_dbc import LIMIT_SEED, random_dbc
from scene_layouts import layout_of
from strategies import covariances, mild_lines

from maplines_can.values.errors import EncodeError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import Kind, MapLine, Slot, Status
from maplines_can.values.mixture import GaussianMixture
from maplines_can.wire import Codec
from maplines_can.wire.layout.message_layout import Layout
from maplines_can.wire.layout.signals import PARAMETER_SIGNALS
from maplines_can.wire.records import complete_writer
from maplines_can.wire.records.complete_format import CompleteFormat
from maplines_can.wire.records.complete_writer import CompleteWriter
from maplines_can.wire.records.line_writer import LineWriter

DEFAULT = layout_of("maplines.dbc")
LAYOUTS = [
    pytest.param(DEFAULT, id="maplines"),
    pytest.param(layout_of("maplines-secoc.dbc"), id="secoc"),
    *(
        pytest.param(Layout.from_text(random_dbc(seed)), id=f"random-{seed}")
        for seed in (0, 2, 3, 5, LIMIT_SEED)
    ),
]


def lines_of(codec: Codec, n: int, seed: int) -> list[MapLine]:
    """Motorways, awkward covariances, means beyond the message, singular ones, tiny and huge."""
    arrays, lines = awkward_lines(codec, n, seed), []
    for i in range(n):
        try:
            gaussian = Gaussian(arrays.means[i], arrays.covs[i])
        except ValueError:
            continue  # indefinite
        x_range = {"x_min": arrays.x_min[i], "x_max": arrays.x_max[i]}
        kind, status = Kind(arrays.kind[i]), Status(arrays.status[i])
        line = MapLine(
            Slot(arrays.slot[i]), gaussian, kind, age=arrays.age[i], status=status, **x_range
        )
        lines.append(line)
    return lines


def of_batch(codec: Codec, lines: list[MapLine], counters: list[int]) -> Any:
    """Their records, from arrays."""
    names = ("slot", "kind", "x_min", "x_max", "age", "status")
    return codec.batch.encode(
        [line.gaussian.mean for line in lines],
        [line.gaussian.cov for line in lines],
        counter=counters,
        **{name: [getattr(line, name) for line in lines] for name in names},
    )


def writer_of(codec: Codec) -> LineWriter:
    return LineWriter(codec.layout, CompleteFormat(codec.layout, codec.covariance))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_lines_are_written_as_in_a_batch(layout: Layout) -> None:
    """One line at a time has the bits of many; those that need arrays are left to them."""
    codec = Codec(layout)
    lines, modulus = lines_of(codec, 1500, seed=1), 2 ** layout["Counter"].length
    counters = [i % modulus for i in range(len(lines))]
    expected, writer = of_batch(codec, lines, counters), writer_of(codec)
    statuses: Counter[int] = Counter()
    for line, counter, record in zip(lines, counters, expected, strict=True):
        written = writer.write(line, counter)
        means = zip(PARAMETER_SIGNALS, line.gaussian.mean, strict=True)
        assert (written is None) == any(layout[name].nearest(y).clipped for name, y in means)
        if written is not None:
            assert written == record.tobytes()
            statuses[int(codec.batch.decode(record[None], line.slot).status[0])] += 1
    assert sum(statuses.values()) > len(lines) / 2
    assert statuses.keys() == {0, 1, 2, 3, 4, 5}


@given(
    mild_lines(),
    covariances(),
    st.tuples(st.floats(-150, 150), st.floats(0, 200) | st.just(0.0)),
    st.floats(0, 100) | st.just(np.inf),
    st.sampled_from([*Status]),
    st.integers(0, 15),
)
def test_any_line_is_written_as_in_a_batch(
    mean: Any, cov: Any, x_range: Any, age: float, status: Status, counter: int
) -> None:
    """Any valid range and age, and any covariance, singular ones included."""
    codec, (x_min, length) = Codec(DEFAULT), x_range
    line = MapLine(Slot.ROUTE, Gaussian(mean, cov), Kind.KERB, x_min, x_min + length, age, status)
    (expected,) = of_batch(codec, [line], [counter])

    assert writer_of(codec).write(line, counter) == expected.tobytes()


def test_few_lines_have_the_frames_of_many(monkeypatch: Any) -> None:
    """Lines that fit between others that do not and mixtures, of one slot and of several."""
    codec = Codec(DEFAULT)
    gaussians = [Gaussian([y, 0, 0, 0], np.eye(4) * 1e-6) for y in (-0.5, 0.5)]
    mixture = MapLine.of_mixture(Slot.CENTRE, GaussianMixture([0.5, 0.5], gaussians))
    plain = [MapLine(slot, gaussians[0]) for slot in (Slot.CENTRE, Slot.ROUTE)]
    far = MapLine(Slot.CENTRE, Gaussian([1e3, 0, 0, 0], np.eye(4)))
    lines = [plain[0], mixture, plain[0], plain[1], far, mixture, plain[0]]
    assert len(lines) <= complete_writer.FEW
    encoder = codec.encoder()
    one_by_one = [encoder.encode(line) for line in lines]
    few, following = codec.encoder(), codec.encoder()
    assert few.encode_lines(lines) == one_by_one
    monkeypatch.setattr(complete_writer, "FEW", 0)
    assert following.encode_lines(lines) == one_by_one
    assert few.encode(plain[0]) == following.encode(plain[0])


def test_a_slot_that_the_layout_lacks_raises() -> None:
    """The message has the slot, for one line as for many."""
    fewer = Codec(with_slots(DEFAULT, Slot.CENTRE))
    with pytest.raises(EncodeError, match="no message for slot 7"):
        fewer.encoder().encode(MapLine.mean_only(Slot.ROUTE, np.zeros(4)))


def test_a_stated_line_is_the_one_that_is_sent() -> None:
    """The raw mean and range of a scene are those of the record, if nothing is clipped."""
    codec = Codec(DEFAULT)
    form = CompleteFormat(DEFAULT, codec.covariance)
    writer, lines = CompleteWriter(DEFAULT, form), lines_of(codec, 1000, seed=2)
    records = of_batch(codec, lines, [0] * len(lines))
    slots = [line.slot for line in lines]
    batch = codec.batch.decode(records, slots)
    raw, _ = form.packer.unpack(records, DEFAULT.data_ids(slots, len(lines)))
    stated = [writer.raw_mean_and_range(line) for line in lines]
    assert 100 < sum(of_line is not None for of_line in stated) < len(lines) - 100
    for i, of_line in enumerate(stated):
        if of_line is not None:
            assert of_line == {name: int(raw[name][i]) for name in of_line}
            assert batch.x_min[i] < batch.x_max[i]
