"""The supervisor in its own process: ticks, signals, and the end of either process."""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Condition, Thread, current_thread, main_thread
from time import monotonic

import pytest

from emulated import until
from flexneedle.errors import DriverError, RefusedError, StoppedError
from flexneedle.geometry.rigid import identity
from flexneedle.interrupts import SIGNALS
from flexneedle.lab.rig.rig_file import DeviceSection
from flexneedle.lab.rig.supervisor import connection, protocol
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.scenario.sections.monitor import MonitorSettings
from stages import rig_file


class RecordingClient(SupervisorClient):
    """Client that keeps all messages that it has received."""

    def _take(self, message):
        super()._take(message)
        self.received = [*getattr(self, "received", []), message]


@pytest.fixture(scope="module")
def make_task(tmp_path_factory, patient):  # noqa: ARG001  no limit of time on a busy machine
    """Return a function that makes a task for motors in memory with a name; their commands are in a file `name`."""
    folder = tmp_path_factory.mktemp("motors")

    def make(name):
        suspended = str(folder / "suspended")
        driver = DeviceSection(
            kind="stages:real_motors", notes=str(folder / name), address=name, suspended=suspended
        )
        rig = rig_file().model_copy(update={"driver": driver, "tracker": DeviceSection(kind="stages:Still")})
        return protocol.SupervisorTask(
            rig, monotonic(), 2, MonitorSettings(references=0), identity(), 0.0, 0.3
        )

    return make


SHARED = f"shared-{os.getpid()}"  # the lock of an address is for the whole machine


@pytest.fixture(scope="module")
def shared(make_task):
    with RecordingClient(make_task(SHARED)) as made:
        made.take_signals()
        yield made


@pytest.fixture
def supervisor(shared):
    """The supervisor that most tests share, reset."""
    shared.stop("the test before")
    shared.reset()
    return shared


def notes_of(client):
    """Return the commands that the motors have received, as (name, is garbage collected, scheduler)."""
    return [line.split() for line in Path(client.rig.driver.settings["notes"]).read_text().splitlines()]


@contextmanager
def handle(number):
    """Handle a signal by doing nothing."""
    before = signal.signal(number, lambda *_: None)
    yield
    signal.signal(number, before)


def test_a_step_is_carried_out_and_ticks_continue(supervisor):
    supervisor.arm()
    at = supervisor.positions["insertion"]
    done = supervisor.step(0.0, {"insertion": 1.0, "guide_y": 0.2}, 0.2)
    assert done.travelled["insertion"] == pytest.approx(1.0, abs=0.02)
    assert done.begun < done.ended <= supervisor.now()
    before = supervisor.report.time
    until(lambda: supervisor.report.time > before)
    assert supervisor.positions["insertion"] == pytest.approx(at + 1.0, abs=0.02)


def test_no_garbage_is_collected_and_the_process_has_priority_where_the_system_permits_it(supervisor):
    supervisor.arm()
    _, collects, scheduler = notes_of(supervisor)[-1]
    assert collects == "False"
    ask = "import os; os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))"
    permitted = subprocess.run([sys.executable, "-c", ask], stderr=subprocess.DEVNULL).returncode == 0
    assert not permitted or int(scheduler) == os.SCHED_RR


def test_the_tip_is_the_median_of_measurements_that_can_still_be_read(supervisor):
    supervisor.read()
    assert supervisor.tip(30.0).point == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert len(supervisor.read()) >= 9


def test_operators_move_axes_and_positions_are_reported_before_the_end_of_a_motion(supervisor):
    """Homing shifts the positions."""
    with pytest.raises(RefusedError, match="jog: refused while idle"):
        supervisor.move_to("guide_y", 1.0)
    supervisor.arm()
    with pytest.raises(RefusedError, match="no axis nose; axes: insertion"):
        supervisor.move_to("nose", 1.0)
    supervisor.move_to("insertion", 2.0)
    supervisor.retract(-1.0)
    supervisor.move_to("rotation", 0.5)
    supervisor.home("rotation")
    ends = [
        before.axes
        for before, message in zip(supervisor.received, supervisor.received[1:], strict=False)
        if isinstance(message, protocol.MotionResult)
    ][-4:]
    at = [(axes["insertion"].position, axes["rotation"].position) for axes in ends]
    assert at == [pytest.approx(one, abs=0.02) for one in ((2.0, 0.0), (-1.0, 0.0), (-1.0, 0.5), (-1.0, 0.0))]


def test_a_stopped_rig_is_reset_before_it_is_armed_again(supervisor):
    supervisor.arm()
    supervisor.stop("the test")
    for refused in (supervisor.arm, lambda: supervisor.step(0.0, {}, 0.2), lambda: supervisor.positions):
        with pytest.raises(StoppedError, match="stopped: the test"):
            refused()
    supervisor.reset()
    supervisor.arm()
    assert supervisor.report.state is SupervisorState.ARMED


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("of_client", [False, True])
def test_a_signal_to_either_process_stops_the_motors_before_the_client_has_handled_it(
    supervisor, number, of_client
):
    supervisor.arm()
    with handle(number):
        os.kill(os.getpid() if of_client else supervisor.pid, number)
        with pytest.raises(StoppedError, match=f"^stopped: signal {number.name}$"):
            supervisor.wait(60.0)


def test_another_signal_to_the_client_stops_nothing(supervisor):
    supervisor.arm()
    with handle(signal.SIGUSR1):
        os.kill(os.getpid(), signal.SIGUSR1)
        supervisor.wait(0.1)
    assert supervisor.report.state is SupervisorState.ARMED


def test_an_interrupt_while_a_lock_is_taken_leaves_it_unlocked(supervisor, monkeypatch):
    """Otherwise the client could not be closed: the receiving thread would wait for the lock."""
    original, counts = Condition.__enter__, iter(range(100))

    def entered(self):
        found = original(self)
        if current_thread() is main_thread() and next(counts) == 3:
            signal.raise_signal(signal.SIGINT)
        return found

    supervisor.arm()
    monkeypatch.setattr(Condition, "__enter__", entered)
    with pytest.raises(KeyboardInterrupt):
        supervisor.wait(60.0)
    monkeypatch.undo()
    found = []
    thread = Thread(target=lambda: found.append(supervisor.report))
    thread.start()
    thread.join(60.0)
    assert found


def test_a_stop_from_other_threads_ends_a_motion(supervisor):
    supervisor.arm()
    at = supervisor.positions["insertion"]
    threads = [Thread(target=supervisor.request_stop, args=("ROS topic /stop",)) for _ in range(8)]

    def stop_soon():
        until(lambda: supervisor.report.axes["insertion"].position > at + 0.5)
        for thread in threads:
            thread.start()

    other = Thread(target=stop_soon)
    other.start()
    with pytest.raises(StoppedError, match="stopped: ROS topic /stop"):
        supervisor.move_to("insertion", 100.0)
    for thread in (other, *threads):
        thread.join()


def test_a_supervisor_that_hangs_is_an_error(supervisor, monkeypatch):
    supervisor.arm()
    monkeypatch.setattr(connection, "_SILENT_S", 0.5)
    os.kill(supervisor.pid, signal.SIGSTOP)
    try:
        with pytest.raises(DriverError, match="the supervisor has not reported for"):
            supervisor.wait(60.0)
    finally:
        before = supervisor.report.time
        os.kill(supervisor.pid, signal.SIGCONT)
        until(lambda: supervisor.report.time > before)


def test_motors_are_stopped_after_the_computer_was_suspended(supervisor):
    """The monotonic clock stops meanwhile: no heartbeat is missed, and no tick is late."""
    supervisor.arm()
    flag = Path(supervisor.rig.driver.settings["suspended"])
    flag.touch()
    with pytest.raises(StoppedError, match=r"the computer was suspended for 3600\.0 s"):
        supervisor.wait(60.0)
    flag.unlink()


def test_motors_are_moved_by_one_program_at_a_time(shared, make_task, capfd):
    """The second program is refused before it sends a command. What a driver prints is not on standard output."""
    before = notes_of(shared)
    with pytest.raises(DriverError, match=rf"^{SHARED}: in use by pid {os.getpid()} \(.*: end it first$"):
        SupervisorClient(make_task(SHARED))
    assert notes_of(shared) == before
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "the stage is opened\n")


def test_a_dry_run_moves_no_motors_and_a_supervisor_that_is_killed_is_an_error(shared, make_task):
    before = notes_of(shared)
    with SupervisorClient(replace(make_task(SHARED), dry=True)) as dry:
        dry.arm()
        done = dry.step(0.0, {"insertion": 1.0}, 0.2)
        assert done.travelled["insertion"] == pytest.approx(1.0, abs=0.02)
        dry.stop()
        dry.reset()
        os.kill(dry.pid, signal.SIGKILL)
        with pytest.raises(DriverError, match="the supervisor has ended: it was killed"):
            dry.wait(60.0)
    assert notes_of(shared) == before


def test_a_supervisor_that_is_killed_leaves_what_may_still_move_and_what_to_do(make_task):
    with SupervisorClient(make_task(f"killed {os.getpid()}")) as made:
        made.arm()
        os.kill(made.pid, signal.SIGKILL)
        with pytest.raises(
            DriverError, match=r"it was killed; motors may continue for \d+ ms .*insertion by at most "
        ):
            made.wait(60.0)
        assert "press the emergency stop" in str(made.ended)


@pytest.mark.parametrize("how", ["close", "end of the client", "error in the supervisor"])
def test_motors_are_stopped_at_the_end_whatever_it_is(make_task, how):
    wakeup = signal.set_wakeup_fd(-1)
    with SupervisorClient(make_task(f"{how} {os.getpid()}")) as made:
        made.take_signals()
        made.arm()
        made.step(0.0, {"insertion": 1.0}, 0.2)
        assert notes_of(made)[-1][0] == "follow"
        if how == "end of the client":
            made._process.channel.end_sending()
            until(lambda: made.ended == "the controller has ended")
        elif how == "error in the supervisor":
            with pytest.raises(DriverError, match="the supervisor has ended: the supervisor failed: "):
                made.step(0.0, None, 0.2)
    # At once, and once more at the end of the process.
    stops = 1 if how == "error in the supervisor" else 2
    assert [name for name, *_ in notes_of(made)][-1 - stops :] == ["follow"] + ["stop"] * stops
    made.request_stop("too late")
    assert signal.set_wakeup_fd(wakeup) == -1
