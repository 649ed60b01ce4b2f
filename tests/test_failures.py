"""After failures under a real kernel no line is wrong, and all slots recover.

Run these tests with ``tools/vcan python3 tools/run.py pytest -m socketcan``. The failures are
those of ``tools/failures.py``.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.kernel_can import has_vcan

TOOLS = Path(__file__).parents[1] / "tools"


@pytest.fixture(scope="module")
def failures() -> Iterator[Any]:
    """The tool as a module, with short outages."""
    if not has_vcan():
        pytest.skip("no vcan0 here: run inside tools/vcan")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOOLS)
        import failures

        patch.setattr(failures, "OUTAGE", 0.0)
        patch.setattr(failures, "QUEUES", 1.8)
        yield failures


@pytest.fixture
def row_of(failures: Any) -> Any:
    """Cause a failure, check what holds for all of them, and return its row."""

    def run(name: Any) -> Any:
        row = failures.run(name)
        assert not row.problem
        assert row.wrong == 0
        assert 0 < row.delivered <= row.sent
        assert row.lines_again <= row.valid_again  # the times themselves depend on the machine
        assert row.timed_out >= 0
        return row

    return run


def check_only_timed_out(row: Any) -> None:
    """Check that lines were lost by the time-out of the reassembly, and by nothing else.

    A busy machine may suspend the sender within a line, or fill the transmit queue for so long that
    the sender reports lines as given up. The counters of the receiver show exactly these.
    """
    assert row.sent - row.delivered == row.timed_out
    assert row.lost == row.timed_out + row.given_up


@pytest.mark.socketcan
def test_an_interface_that_goes_down_and_comes_up(row_of: Any) -> None:
    """The lines that were not sent or not received are those that the counters report."""
    row = row_of("down")

    assert row.given_up > 0
    assert row.lost == row.sent + row.given_up - row.delivered


@pytest.mark.socketcan
def test_a_sender_that_is_killed_and_restarted(row_of: Any) -> None:
    """Its first lines are delivered, although their counters restart."""
    row = row_of("killed")

    assert row.sent - row.delivered == row.timed_out
    assert row.detected is not None


@pytest.mark.socketcan
def test_a_receiver_that_was_suspended_counts_the_lines_it_missed(row_of: Any) -> None:
    """The kernel drops frames that do not fit into its queue; the counters report all of them."""
    row = row_of("stopped")

    assert row.lost == row.sent - row.delivered > 0


@pytest.mark.socketcan
def test_two_senders_on_the_same_slots_are_detected(row_of: Any) -> None:
    """They are reported on every slot, and no line has frames of both."""
    row = row_of("two-senders")

    assert row.detected is not None


@pytest.mark.socketcan
@pytest.mark.skipif(not shutil.which("cansend"), reason="no cansend: apt-get install can-utils")
def test_error_frames_are_counted_and_cost_no_line(row_of: Any) -> None:
    """They do not reach the decoder."""
    check_only_timed_out(row_of("error-frames"))


@pytest.mark.socketcan
def test_can_fd_on_a_classic_interface_ends_with_the_reason(row_of: Any) -> None:
    """Both commands exit with status 1; others on the bus are not affected."""
    row = row_of("no-fd")

    assert "enable it, or open the interface without --fd" in row.seen
    check_only_timed_out(row)


@pytest.mark.socketcan
def test_a_clock_that_is_set_back_stops_nothing(row_of: Any, failures: Any) -> None:
    """Time stamps go back an hour; a line with frames before and after that may time out."""
    if not failures.is_guest():
        pytest.skip("this would set the clock of a real machine")
    check_only_timed_out(row_of("clock-back"))
