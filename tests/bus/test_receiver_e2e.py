"""The E2E state of a slot at a receiver on a bus."""

import threading
import time
from typing import Any

import can
from dbcs import default_codec
from e2e_streams import MS, SLOT, frames

from maplines_can import Codec, MapLine, Receiver, Transmitter
from maplines_can.bus import Sent
from maplines_can.wire import E2EState


def wait_until(condition: Any, timeout: float = 20.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_a_controller_sees_a_slot_become_valid_and_stale(links: Any) -> None:
    """Many threads at once request the newest line: VALID while lines are received, then stale."""
    codec, wrong = Codec.from_dbc(), []
    decoder = codec.decoder(cycle_ms=100)  # and lines at 50 Hz: a busy machine is no fault here
    with Receiver(links[1], decoder, can_ids=codec.can_ids) as receiver:
        stop = threading.Event()

        def control() -> None:
            while not stop.is_set():
                view = receiver.latest(SLOT)
                if view.line is not None and view.age < view.line.age:
                    wrong.append(view)

        threads = [threading.Thread(target=control) for _ in range(3)]
        for thread in threads:
            thread.start()
        with Transmitter(links[0], codec, period=0.02) as transmitter:

            def usable() -> bool:
                transmitter.publish(MapLine.mean_only(SLOT, [1.75, 0, 0, 0]))
                return receiver.latest(SLOT).usable

            wait_until(usable)
        wait_until(lambda: receiver.latest(SLOT).stale)
        wait_until(lambda: receiver.latest(SLOT).state is E2EState.INVALID)
        assert receiver.latest(SLOT).line.gaussian.mean[0] == 1.75  # type: ignore[union-attr]
        stop.set()
        for thread in threads:
            thread.join()
        assert wrong == []
        assert list(receiver.slots()) == [SLOT]


def test_age_is_by_the_clock_of_the_frames(links: Any) -> None:
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
        assert 0 <= view.age - view.line.age < 20.0  # type: ignore[union-attr]
        assert receiver.latest(SLOT, now_ns=view.line.t_ns + 151 * MS).stale  # type: ignore[operator, union-attr]
