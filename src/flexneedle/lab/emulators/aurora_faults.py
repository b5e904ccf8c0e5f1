"""Faults of the emulated Aurora."""

from flexneedle.lab.emulators.faults import BYTE, MM, RATIO, SECONDS, FaultKind
from flexneedle.lab.emulators.motion import SENSORS


def _fault_of_sensor(text: str) -> FaultKind:
    return FaultKind(text, SENSORS[0], "sensor", SENSORS)


FAULTS = {
    "missing": _fault_of_sensor("a sensor is not measured (tip, or missing=SENSOR)"),
    "out-of-volume": _fault_of_sensor("a sensor is outside the volume (tip, or out-of-volume=SENSOR)"),
    "partly-out": _fault_of_sensor("a sensor is partly outside the volume (tip, or partly-out=SENSOR)"),
    "broken": _fault_of_sensor("a coil of a sensor is broken (tip, or broken=SENSOR)"),
    "disabled": _fault_of_sensor("a sensor is disabled (tip, or disabled=SENSOR)"),
    "error": FaultKind("every command returns an error (0D, or error=CODE in hexadecimal)", "0D", BYTE),
    "system": FaultKind(
        "the field generator is disconnected (20, or system=BITS of the system status in hexadecimal)",
        "20",
        BYTE,
    ),
    "garbled": FaultKind("a byte of each reply is wrong"),
    "cut": FaultKind("the second half of each reply is lost"),
    "silence": FaultKind("no reply"),
    "delay": FaultKind("replies are delayed (0.2, or delay=SECONDS)", "0.2", SECONDS),
    "frozen": FaultKind("the frame number does not increase"),
    "stuck": _fault_of_sensor(
        "a sensor's values repeat, while the frame number increases (tip, or stuck=SENSOR)"
    ),
    "nan": _fault_of_sensor("the values of a sensor are not numbers (tip, or nan=SENSOR)"),
    "jump": FaultKind("the tip is reported 5 mm from its position (along y, or jump=MM)", "5", MM),
    "indicator": FaultKind("all indicators are high (0.2, or indicator=VALUE)", "0.2", RATIO),
    "unusable": _fault_of_sensor("a sensor cannot be initialised (tip, or unusable=SENSOR)"),
    "pulled": _fault_of_sensor("a sensor is unplugged during the fault (tip, or pulled=SENSOR)"),
    "unplug": FaultKind("the cable is pulled, and plugged in again after the duration"),
}
"""The kinds of fault of the tracker; their times are since tracking first began."""
