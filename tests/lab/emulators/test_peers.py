"""Independent clients find, set up and read the emulator: ndicapi's Python module, scikit-surgerynditracker."""

import numpy as np
import pytest

from emulated import emulated, emulator
from flexneedle.lab.emulators.motion import SENSORS, sensor_pose

ndicapy = pytest.importorskip("ndicapy")


def opened(path):
    assert ndicapy.ndiProbe(path) == ndicapy.NDI_OKAY
    device = ndicapy.ndiOpen(path)
    for command in ("INIT:", "COMM:50000", "PHSR:02"):
        ndicapy.ndiCommand(device, command)
    handles = [ndicapy.ndiGetPHSRHandle(device, n) for n in range(ndicapy.ndiGetPHSRNumberOfHandles(device))]
    for handle in handles:
        ndicapy.ndiCommand(device, f"PINIT:{handle:02X}")
        ndicapy.ndiCommand(device, f"PENA:{handle:02X}D")
    ndicapy.ndiCommand(device, "TSTART:")
    return device, [bytes([handle]) for handle in handles]


@pytest.fixture(scope="module")
def device():
    """The path of a tracker with two sensors, and its orders: ndicapi 3.7.6 cannot decode a binary reply about more."""
    with emulator("--sensors", "2") as started:
        yield started


@pytest.mark.parametrize("command", ["BX", "TX"])
def test_ndicapi_reads_poses_and_frame_numbers(device, command):
    frame = getattr(ndicapy, f"ndiGet{command}Frame")
    transform = getattr(ndicapy, f"ndiGet{command}Transform")
    line, handles = opened(device[0])
    ndicapy.ndiCommand(line, f"{command}:0801")
    read = [(frame(line, handle), transform(line, handle)) for handle in handles]
    ndicapy.ndiCommand(line, "TSTOP:")
    ndicapy.ndiClose(line)
    for name, (number, values) in zip(SENSORS[:2], read, strict=True):
        true = sensor_pose(name, number, 0)
        np.testing.assert_allclose(values[4:7], true.position, atol=0.0051)
        np.testing.assert_allclose(values[:4], true.orientation, atol=5.1e-5)
        np.testing.assert_allclose(values[7], true.indicator, atol=5.1e-5)


def test_ndicapi_reads_missing_sensors_and_errors(device):
    device[1]("fault missing")
    line, (handle, _) = opened(device[0])
    ndicapy.ndiCommand(line, "BX:0801")
    assert ndicapy.ndiGetBXTransform(line, handle) == "MISSING"
    with pytest.raises(OSError, match="invalid while in the current mode"):
        ndicapy.ndiCommand(line, "PHSR:02")
    ndicapy.ndiClose(line)


@pytest.mark.parametrize(
    ("firmware", "sensors"),
    [("AURORA Rev 008", 4), pytest.param("AURORA Rev 009", 2, marks=pytest.mark.slow)],
)
def test_scikit_surgerynditracker_tracks(firmware, sensors):
    """It reads text from revision 8 and binary from later ones."""
    peer = pytest.importorskip("sksurgerynditracker.nditracker")
    with emulated("--firmware", firmware, "--sensors", str(sensors)) as path:
        tracker = peer.NDITracker({"tracker type": "aurora", "serial port": path, "use quaternions": True})
        tracker.start_tracking()
        ports, _, numbers, poses, quality = tracker.get_frame()
        tracker.stop_tracking()
        tracker.close()
    assert ports == [10, 11, 12, 13][:sensors]
    for name, number, measured, indicator in zip(SENSORS, numbers, poses, quality, strict=False):
        true = sensor_pose(name, int(number), 0)
        np.testing.assert_allclose(measured[0], (*true.orientation, *true.position), atol=0.0051)
        np.testing.assert_allclose(indicator, true.indicator, atol=5.1e-5)
