"""The E2E state of a slot at a receiver on a bus."""

import re
import threading
import time
from pathlib import Path

import can
import pytest
from dbcs import default_codec
from e2e_streams import MS, SLOT, frames

import maplines_can as ml
from maplines_can import Codec, Link, MapLine, Receiver, Transmitter
from maplines_can.bus import Sent
from maplines_can.wire import E2EState


@pytest.fixture
def links():
    channel = f"e2e-{time.monotonic_ns()}"
    with (
        Link(interface="virtual", channel=channel) as one,
        Link(interface="virtual", channel=channel) as other,
    ):
        yield one, other


def wait_until(condition, timeout=20.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_a_controller_sees_a_slot_become_valid_and_stale(links):
    """Many threads at once request the newest line: VALID while lines are received, then stale."""
    codec, wrong = Codec.from_dbc(), []
    decoder = codec.decoder(cycle_ms=100)  # and lines at 50 Hz: a busy machine is no fault here
    with Receiver(links[1], decoder, can_ids=codec.can_ids) as receiver:
        stop = threading.Event()

        def control():
            while not stop.is_set():
                view = receiver.latest(SLOT)
                if view.line is not None and view.age < view.line.age:
                    wrong.append(view)

        threads = [threading.Thread(target=control) for _ in range(3)]
        for thread in threads:
            thread.start()
        with Transmitter(links[0], codec, period=0.02) as transmitter:
            transmitter.publish(MapLine.mean_only(SLOT, [1.75, 0, 0, 0]))
            wait_until(lambda: receiver.latest(SLOT).usable)
        wait_until(lambda: receiver.latest(SLOT).stale)
        wait_until(lambda: receiver.latest(SLOT).state is E2EState.INVALID)
        assert receiver.latest(SLOT).line.gaussian.mean[0] == 1.75
        stop.set()
        for thread in threads:
            thread.join()
        assert wrong == []
        assert list(receiver.slots()) == [SLOT]


def test_age_is_by_the_clock_of_the_frames(links):
    """Also if the time stamps of the adapter start at power-up."""
    with Receiver(links[1], default_codec().decoder()) as receiver:
        start = time.monotonic()
        for counter in range(2):  # one alone may be of a backlog
            time.sleep(0.25 * counter)
            for frame in frames(counter):
                message = can.Message(
                    timestamp=12.5 + time.monotonic() - start,
                    arbitration_id=frame.can_id,
                    data=frame.data,
                    is_extended_id=False,
                )
                assert links[0].send(message) is Sent.OK
            assert receiver.get(20.0) is not None
        view = receiver.latest(SLOT)
        assert 0 <= view.age - view.line.age < 20.0
        assert receiver.latest(SLOT, now_ns=view.line.t_ns + 151 * MS).stale


def test_the_example_of_the_readme_runs(links, capsys):
    """On the in-process bus, with a sender."""
    readme = (Path(__file__).parents[2] / "README.md").read_text()
    (code,) = (c for c in re.findall(r"```python\n(.*?)```", readme, re.S) if "latest(" in c)
    channel = links[0].name.split()[1]
    socketcan = 'interface="socketcan", channel="vcan0"'
    assert socketcan in code
    code = code.replace(socketcan, f'interface="virtual", channel="{channel}"')
    codec = Codec.from_dbc()
    with Transmitter(links[0], codec, period=0.02) as transmitter:
        transmitter.publish(MapLine.mean_only(SLOT, [1.75, 0, 0, 0]))
        exec(code, {"ml": ml, "codec": codec})  # noqa: S102
    assert "VALID" in capsys.readouterr().out
