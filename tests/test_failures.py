"""Real failures under a real kernel: no wrong line, and all well again.

Run them with ``tools/vcan python3 tools/run.py pytest -m socketcan``. The failures themselves are
those of ``tools/failures.py``.
"""

import shutil
import signal
import socket
import threading
from pathlib import Path

import pytest

from maplines_can.bus.background import Worker

TOOLS = Path(__file__).parents[1] / "tools"


def has_vcan():
    return any(name == "vcan0" for _, name in socket.if_nameindex())


@pytest.fixture(scope="module")
def failures():
    """The tool as a module, with outages no longer than it takes to see them."""
    if not has_vcan():
        pytest.skip("no vcan0 here: run inside tools/vcan")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOOLS)
        import failures

        patch.setattr(failures, "OUTAGE", 0.0)
        patch.setattr(failures, "QUEUES", 1.8)
        yield failures


@pytest.fixture
def row_of(failures):
    """Have a failure happen, with what holds for all of them."""

    def run(name):
        row = failures.run(name)
        assert not row.problem
        assert row.wrong == 0
        assert 0 < row.delivered <= row.sent
        assert row.lines_again <= row.valid_again  # how soon depends on the machine
        return row

    return run


@pytest.mark.socketcan
def test_an_interface_that_goes_down_and_comes_up(row_of):
    """What was not sent and what was not heard is what the counters tell."""
    row = row_of("down")

    assert row.given_up > 0
    assert row.lost == row.sent + row.given_up - row.delivered


@pytest.mark.socketcan
def test_a_sender_that_is_killed_and_starts_anew(row_of):
    """Its first lines are delivered, though their counters start anew."""
    row = row_of("killed")

    assert row.sent - row.delivered == row.timed_out
    assert row.detected is not None


@pytest.mark.socketcan
def test_a_receiver_that_was_stopped_knows_what_it_missed(row_of):
    """The kernel drops what does not fit into its queue; the counters tell how much."""
    row = row_of("stopped")

    assert row.lost == row.sent - row.delivered > 0


@pytest.mark.socketcan
def test_two_senders_on_the_same_slots_are_detected(row_of):
    """They are named on every slot, and no line is made of both."""
    row = row_of("two-senders")

    assert row.detected is not None


@pytest.mark.socketcan
@pytest.mark.skipif(not shutil.which("cansend"), reason="no cansend: apt-get install can-utils")
def test_error_frames_are_counted_and_do_no_harm(row_of):
    """They are not given to the decoder, and no line is lost but by the time-out."""
    row = row_of("error-frames")

    assert row.lost == row.sent - row.delivered == row.timed_out


@pytest.mark.socketcan
def test_can_fd_on_a_classic_interface_ends_with_the_reason(row_of):
    """Both commands end with status 1, and who is on the bus does not notice."""
    row = row_of("no-fd")

    assert "enable it, or open the interface with fd=False" in row.seen
    assert row.lost == row.sent - row.delivered == row.timed_out


@pytest.mark.socketcan
def test_a_clock_that_is_set_back_stops_nothing(row_of, failures):
    """Time stamps go back an hour; a line may time out whose frames come before and after."""
    if not failures.is_guest():
        pytest.skip("this would set the clock of a real machine")
    row = row_of("clock-back")

    assert row.lost == row.sent - row.delivered == row.timed_out


@pytest.fixture
def interruptible():
    """A Python that was started in the background ignores Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_while_waiting_leaves_a_worker_that_is_known_to_run():
    """Who then stops it waits for its end, and counts all that it did."""
    go = threading.Event()
    worker = Worker("test", go.wait)
    worker.start()
    main = threading.main_thread().ident
    ctrl_c = threading.Timer(0.2, lambda: signal.pthread_kill(main, signal.SIGINT))
    ctrl_c.start()

    with pytest.raises(KeyboardInterrupt):
        worker.join(20.0)

    assert worker.alive
    go.set()
    worker.join(20.0)
    assert not worker.alive
    ctrl_c.join()
