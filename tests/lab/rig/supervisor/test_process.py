"""The supervisor in a process of its own: its ticks, and what happens when it or its client is killed."""

import os
import re
import signal
import subprocess
import sys
import textwrap
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from threading import Condition, Thread, current_thread, main_thread
from time import monotonic

import pytest

from emulated import until
from flexneedle.errors import DriverError, RefusedError, RigError, RunError, StoppedError
from flexneedle.geometry.registration import identity
from flexneedle.interrupts import SIGNALS
from flexneedle.lab.rig.rig_file import DeviceSection
from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.scenario.sections.monitor import MonitorSettings
from stages import rig_file

TESTS = Path(__file__).parents[3]


def task(driver="stages:real_motors", tracker="stages:Still", **settings):
    rig = rig_file().model_copy(
        update={"driver": DeviceSection(kind=driver, **settings), "tracker": DeviceSection(kind=tracker)}
    )
    return protocol.SupervisorTask(rig, monotonic(), 2, MonitorSettings(references=0), identity(), 0.0, 0.3)


@pytest.fixture(autouse=True)
def in_the_folder_of_the_stage(monkeypatch):
    monkeypatch.chdir(TESTS)


@pytest.fixture
def supervisor():
    with SupervisorClient(task()) as made:
        yield made


def test_a_step_is_carried_out_and_ticks_go_on(supervisor):
    supervisor.arm()
    done = supervisor.step(0.0, {"insertion": 1.0, "guide_y": 0.2}, 0.2)
    assert done.travelled["insertion"] == pytest.approx(1.0, abs=0.02)
    assert 0.1 < done.ended - done.begun < 0.25
    assert abs(supervisor.now() - done.ended) < 0.5
    before = supervisor.report.time
    supervisor.wait(0.2)
    assert supervisor.report.time > before + 0.1
    assert supervisor.report.axes["insertion"].position == pytest.approx(1.0, abs=0.02)
    assert len(supervisor.read()) > 5
    assert len(supervisor.read()) < 3


def test_its_process_collects_no_garbage_and_runs_ahead_of_others(tmp_path):
    """Where the system permits it: as root here, else with an rtprio limit."""
    notes = tmp_path / "notes"
    with SupervisorClient(task("stages:reporting_motors", notes=str(notes))) as supervisor:
        supervisor.wait(0.1)
    collects, policy = notes.read_text().split()
    assert collects == "False"
    assert os.geteuid() != 0 or int(policy) == os.SCHED_RR


def test_the_tip_is_the_median_of_measurements_that_can_still_be_read(supervisor):
    found = supervisor.tip(2.0)
    assert len(supervisor.read()) >= 9
    assert found == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


def test_a_tip_that_is_not_measured_is_none():
    with SupervisorClient(task(tracker="stages:Blind")) as supervisor:
        assert supervisor.tip(0.2) is None


def test_operators_move_axes(supervisor):
    with pytest.raises(RefusedError, match="jog: refused while idle"):
        supervisor.move_to("guide_y", 1.0)
    supervisor.arm()
    supervisor.move_to("guide_y", 1.0)
    supervisor.move_to("insertion", 2.0)
    supervisor.retract(-1.0)
    supervisor.home("rotation")
    found = {name: round(axis.position, 1) for name, axis in supervisor.report.axes.items()}
    assert found == {"guide_y": 1.0, "insertion": -1.0, "rotation": 0.0}
    with pytest.raises(RefusedError, match="no axis nose; axes: insertion"):
        supervisor.move_to("nose", 1.0)


def test_the_positions_after_a_motion_are_reported_before_its_end():
    """A home shifts them; who reads them as soon as it has ended gets the new ones."""

    class Received(SupervisorClient):
        def _take(self, message):
            super()._take(message)
            received.append(message)

    received = []
    with Received(task()) as supervisor:
        supervisor.arm()
        supervisor.move_to("rotation", 0.5)
        supervisor.arm()
        supervisor.home("rotation")
    at = None
    for message in received:
        if isinstance(message, protocol.TickReport):
            at = message.axes["rotation"].position
        elif isinstance(message, protocol.MotionResult):
            assert at == pytest.approx(0.5 if message.number == 1 else 0.0, abs=0.02)
    assert [message.number for message in received if isinstance(message, protocol.MotionResult)] == [1, 2]


def test_a_rig_that_is_not_confirmed_is_not_armed(supervisor):
    shown = []

    def refuse(asked):
        shown.append(asked.positions)
        raise RunError("not confirmed")

    with pytest.raises(RunError, match="not confirmed"):
        refuse(supervisor)
    assert shown == [{"insertion": 0.0, "rotation": 0.0, "guide_y": 0.0}]
    assert supervisor.report.state is SupervisorState.IDLE
    supervisor.stop("the test")
    with pytest.raises(StoppedError, match="stopped: the test"):
        refuse(supervisor)
    assert len(shown) == 1


def test_a_stopped_rig_is_reset_before_it_is_armed_again(supervisor):
    supervisor.arm()
    supervisor.stop("the test")
    with pytest.raises(StoppedError, match="stopped: the test"):
        supervisor.step(0.0, {"insertion": 1.0}, 0.2)
    supervisor.reset()
    supervisor.arm()
    assert supervisor.report.state is SupervisorState.ARMED


def test_arming_that_ends_in_a_fault_has_its_reason():
    with (
        SupervisorClient(task(off=-300.0)) as supervisor,
        pytest.raises(DriverError, match=r"insertion: the motor does not follow: 0\.300 mm off"),
    ):
        supervisor.arm()


def test_a_signal_stops_the_motors(supervisor):
    supervisor.arm()
    os.kill(supervisor.pid, signal.SIGTERM)
    with pytest.raises(StoppedError, match="stopped: signal SIGTERM"):
        supervisor.wait(5.0)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_to_the_client_stops_the_motors_before_the_client_has_handled_it(number):
    before = signal.set_wakeup_fd(-1)
    with ExitStack() as stack:
        supervisor = stack.enter_context(SupervisorClient(task()))
        stack.callback(signal.signal, number, signal.signal(number, lambda *_: None))
        supervisor.take_signals()
        supervisor.arm()
        os.kill(os.getpid(), number)
        with pytest.raises(StoppedError, match=f"^stopped: signal {number.name}$"):
            supervisor.wait(5.0)
    assert signal.set_wakeup_fd(before) == -1


def test_another_signal_to_the_client_stops_nothing(supervisor):
    supervisor.take_signals()
    supervisor.arm()
    before = signal.signal(signal.SIGUSR1, lambda *_: None)
    os.kill(os.getpid(), signal.SIGUSR1)
    supervisor.wait(0.1)
    signal.signal(signal.SIGUSR1, before)
    assert supervisor.report.state is SupervisorState.ARMED


def test_an_interrupt_that_falls_on_the_taking_of_a_lock_leaves_it_unlocked(supervisor, monkeypatch):
    """It could not be closed, since the thread that receives would wait for the lock."""
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
    thread.join(5.0)
    assert found


def test_a_stop_from_another_thread_ends_a_motion(supervisor):
    supervisor.arm()
    threads = [Thread(target=supervisor.request_stop, args=("ROS topic /stop",)) for _ in range(8)]
    started = supervisor.report.time

    def stop_soon():
        until(lambda: supervisor.report.axes["insertion"].position > 0.5)
        for thread in threads:
            thread.start()

    other = Thread(target=stop_soon)
    other.start()
    with pytest.raises(StoppedError, match="stopped: ROS topic /stop"):
        supervisor.move_to("insertion", 100.0)
    for thread in (other, *threads):
        thread.join()
    assert supervisor.report.time - started < 5.0
    with pytest.raises(StoppedError, match="stopped: ROS topic /stop"):
        supervisor.arm()


def test_a_stop_after_the_end_does_nothing():
    with SupervisorClient(task()) as made:
        made.arm()
    made.request_stop("too late")
    assert made.report.state is SupervisorState.ARMED


def test_a_supervisor_that_is_killed_is_an_error(supervisor):
    supervisor.arm()
    os.kill(supervisor.pid, signal.SIGKILL)
    with pytest.raises(DriverError, match="the supervisor has ended: it was killed"):
        supervisor.wait(5.0)


def test_motors_are_moved_by_one_program_at_a_time(tmp_path):
    """The second one is refused before it sends anything; the end of the first, however it ends, releases them."""
    file = tmp_path / "calls"
    of_motors = {"driver": "stages:noting_motors", "file": str(file), "address": str(tmp_path)}
    first = SupervisorClient(task(**of_motors))
    with first:
        holder = re.escape(f"{tmp_path}: in use by pid {os.getpid()} (")
        with pytest.raises(DriverError, match=f"^{holder}.*: end it first$"):
            SupervisorClient(task(**of_motors, tracker="stages:missing"))  # which the first one uses
        assert not file.exists()
        with SupervisorClient(replace(task(**of_motors), dry=True)) as dry:
            assert dry.report.state is SupervisorState.IDLE
        with SupervisorClient(task(**(of_motors | {"address": "another"}))):
            pass
        os.kill(first.pid, signal.SIGKILL)
        until(lambda: ended(first.pid))
        with SupervisorClient(task(**of_motors)) as second:
            second.arm()


def test_a_device_that_does_not_open_is_the_reason():
    with pytest.raises(
        DriverError, match=r"^driver stages:real_motors: ValueError: could not convert .*stages"
    ):
        SupervisorClient(task(position="nowhere"))


def test_what_a_driver_prints_is_kept_from_standard_output(capfd):
    """There `insert --json` prints its result."""
    with SupervisorClient(task(driver="stages:printing_motors")):
        pass
    found = capfd.readouterr()
    assert found.out == ""
    assert "opens the stage\nposition of the stage:\n" in found.err


def test_a_supervisor_that_hangs_is_an_error(supervisor):
    supervisor.arm()
    os.kill(supervisor.pid, signal.SIGSTOP)
    try:
        with pytest.raises(DriverError, match="the supervisor has not reported for"):
            supervisor.wait(5.0)
    finally:
        os.kill(supervisor.pid, signal.SIGCONT)


def test_a_motion_longer_than_the_heartbeat_is_kept_alive_by_its_client(supervisor):
    supervisor.arm()
    supervisor.move_to("insertion", 9.0)
    assert supervisor.report.axes["insertion"].position == pytest.approx(9.0, abs=0.02)


def test_after_a_suspended_computer_nothing_goes_on_by_itself():
    """The monotonic clock stands still meanwhile: no heartbeat is missed, and no tick late."""
    with SupervisorClient(task("stages:suspended_motors")) as supervisor:
        supervisor.arm()
        with pytest.raises(StoppedError, match=r"the computer was suspended for 3600\.0 s"):
            supervisor.step(0.0, {"insertion": 1.0}, 0.2)
        supervisor.stop()
        assert 0.3 < supervisor.report.axes["insertion"].position < 0.6


def test_motors_of_a_dry_run_get_no_command(tmp_path):
    made = replace(task("stages:noting_motors", file=str(tmp_path / "calls")), dry=True)
    with SupervisorClient(made) as supervisor:
        supervisor.arm()
        done = supervisor.step(0.0, {"insertion": 1.0}, 0.2)
        assert done.travelled["insertion"] == pytest.approx(1.0, abs=0.02)
        supervisor.stop()
    assert not (tmp_path / "calls").exists()


@pytest.mark.parametrize("how", ["close", "kill"])
def test_motors_are_stopped_at_the_end_whatever_it_is(tmp_path, how):
    file = tmp_path / "calls"
    script = tmp_path / "client.py"
    script.write_text(textwrap.dedent(ENDING.format(tests=str(TESTS), file=str(file), how=how)))
    client = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    pid = int(client.stdout.readline())
    if how == "kill":
        client.kill()
    client.wait()
    client.stdout.close()
    until(lambda: ended(pid))
    calls = file.read_text().split()
    assert "follow" in calls
    assert calls[-1] == "stop"


def ended(pid):
    """Whether a process has ended."""
    try:
        return "Z" in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]
    except OSError:
        return True


ENDING = """
import sys
from threading import Condition, Thread, current_thread, main_thread
sys.path.insert(0, {tests!r})
from lab.rig.supervisor.test_process import task
from flexneedle.errors import FlexneedleError
from flexneedle.lab.rig.supervisor.client import SupervisorClient

made = SupervisorClient(task("stages:noting_motors", file={file!r}))
made.arm()
made.step(0.0, {{"insertion": 1.0}}, 0.2)
print(made.pid, flush=True)
if {how!r} == "close":
    made.close()
else:
    made.move_to("insertion", 100.0, 1.0)
"""


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"driver": "nonesuch"}, r'driver.kind = "nonesuch": must be one of'),
        ({"tracker": "stages:nonesuch"}, r'tracker.kind = "stages:nonesuch": stages has no nonesuch'),
    ],
)
def test_a_rig_that_cannot_be_opened_is_refused_with_its_reason(given, why):
    with pytest.raises((DriverError, RigError), match=why):
        SupervisorClient(task(**given))
