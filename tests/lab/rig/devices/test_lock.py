"""One program at a time has a set of motors; a program that ends, however it ends, has none."""

import os
import signal
import stat
import subprocess
import sys

import pytest

from bench_rig import Motors
from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices import lock
from flexneedle.lab.rig.devices.galil.motors import factory
from flexneedle.lab.rig.devices.lock import describe_program, hold_motors, lock_file
from flexneedle.lab.rig.devices.opening import address_of
from flexneedle.lab.rig.rig_file import DeviceSection
from galil_peer import peer

HOLDING = """
import sys
from pathlib import Path
from flexneedle.lab.rig.devices import lock
lock.FOLDER = Path(sys.argv[1])
with lock.hold_motors("10.0.0.1:23", lock.describe_program()):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "FOLDER", tmp_path)
    return tmp_path


def refusal(address):
    with pytest.raises(DriverError) as caught, hold_motors(address, "another"):
        pass
    return str(caught.value)


def test_motors_that_are_held_are_refused_with_their_holder_in_one_line():
    with hold_motors("10.0.0.1:23", "pid 7 (flexneedle insert\nphantom)"):
        line = refusal("10.0.0.1:23")
        assert line == r"10.0.0.1:23: in use by pid 7 (flexneedle insert\nphantom): end it first"
        with hold_motors("10.0.0.1:24", "another"):
            pass
    with hold_motors("10.0.0.1:23", "pid 8"):  # a shorter text than that before
        assert refusal("10.0.0.1:23") == "10.0.0.1:23: in use by pid 8: end it first"


def test_a_program_that_is_killed_holds_nothing(folder):
    command = [sys.executable, "-c", HOLDING, str(folder)]
    other = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        assert refusal("10.0.0.1:23").startswith(f"10.0.0.1:23: in use by pid {other.pid} (-c {folder}): ")
    finally:
        other.send_signal(signal.SIGKILL)
        other.communicate()
    assert lock_file("10.0.0.1:23").read_text().startswith(f"pid {other.pid} ")
    with hold_motors("10.0.0.1:23", describe_program()):
        assert lock_file("10.0.0.1:23").read_text() == describe_program()


def test_the_file_is_for_all_users(monkeypatch):
    """Whatever the umask is. Linux refuses O_CREAT on another user's file in /tmp, also if it may be written."""
    before = os.umask(0o077)
    try:
        with hold_motors("10.0.0.1:23", "one"):
            pass
    finally:
        os.umask(before)
    assert stat.S_IMODE(lock_file("10.0.0.1:23").stat().st_mode) == 0o666
    kept = os.open

    def protected(path, flags, *more):
        if flags & os.O_CREAT:
            raise PermissionError(13, "Permission denied")
        return kept(path, flags, *more)

    monkeypatch.setattr(os, "open", protected)
    with hold_motors("10.0.0.1:23", "two"):
        assert lock_file("10.0.0.1:23").read_text() == "two"


def test_a_file_that_is_no_lock_is_an_error_and_is_not_followed(folder):
    (folder / "precious").write_text("precious")
    lock_file("10.0.0.1:23").symlink_to(folder / "precious")
    assert "the lock of 10.0.0.1:23 cannot be opened: " in refusal("10.0.0.1:23")
    assert (folder / "precious").read_text() == "precious"


def test_motors_have_the_address_of_their_driver_else_its_kind_and_settings():
    part = DeviceSection(kind="mylab:open_stage", port="/dev/ttyACM0", axes=2)
    motors = Motors()
    assert address_of(part, motors) == 'mylab:open_stage {"axes": 2, "port": "/dev/ttyACM0"}'
    motors.address = "/dev/ttyACM0"
    assert address_of(part, motors) == "/dev/ttyACM0"


def test_a_controller_has_one_address_by_any_of_its_names():
    with peer() as device:
        found = set()
        for host in ("127.0.0.1", "localhost"):
            with factory({"address": f"{host}:{device.port}"}, ["A"]) as motors:
                found.add(address_of(DeviceSection(kind="galil"), motors))
    assert found == {f"127.0.0.1:{device.port}"}
