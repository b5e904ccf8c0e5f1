"""The line to a controller: its commands, and connections whose replies are in doubt."""

import socket
from contextlib import contextmanager
from time import monotonic

import pytest

from emulated import until
from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.galil.link import Link
from galil_peer import CLOSE, peer

TIMEOUT_S = 0.1
PATIENT_S = 60.0


@contextmanager
def linked(damage=None, farewell=""):
    with peer() as device:
        device.damage = damage
        link = Link("127.0.0.1", device.port)
        link.farewell = farewell
        link.open(monotonic() + PATIENT_S)
        yield link, device
        link.close()


def ask(link, *commands, seconds=PATIENT_S):
    return link.ask(commands, monotonic() + seconds)


def test_commands_are_sent_in_a_line_and_answered_one_by_one():
    with linked() as (link, device):
        found = ask(link, "DPA=7", "TPA", "QQ", "TC1")
    assert device.lines == ["DPA=7;TPA;QQ;TC1"]
    assert [(reply.accepted, reply.data) for reply in found] == [
        (True, ""),
        (True, " 7\r\n"),
        (False, ""),
        (True, " 1 Unrecognized command\r\n"),
    ]


def test_a_host_that_is_not_known_is_refused_in_one_line():
    with pytest.raises(DriverError, match=r"^no-such-host\.invalid:23: unknown host: "):
        Link("no-such-host.invalid", 23)


def test_a_host_with_several_addresses_is_reached_by_ipv4(monkeypatch):
    found = socket.getaddrinfo("::1", 0, type=socket.SOCK_STREAM)
    with peer() as device:
        found += socket.getaddrinfo("127.0.0.1", device.port, type=socket.SOCK_STREAM)
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
        link = Link("both.lab", device.port)
        link.open(monotonic() + PATIENT_S)
        assert ask(link, "TPA")[0].accepted
        link.close()


def test_a_port_where_nothing_listens_is_refused_in_one_line():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    link = Link("127.0.0.1", port)
    problem = "no connection: Connection refused; check the power"
    with pytest.raises(DriverError, match=f"^127.0.0.1:{port}: {problem}"):
        link.open(monotonic() + PATIENT_S)
    with pytest.raises(DriverError, match=f"not connected: {problem}"):
        ask(link, "TPA")


REMEDY = "check the power, the cable and the address of the controller, and start again"


def silent(_line, _true):
    return None


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda _line, true: true[:-1], "no reply in time"),
        (silent, "no reply in time"),
        (lambda _line, _true: CLOSE, "the controller closed the connection"),
        (lambda _line, true: true + b":", "more than the replies to 1 commands"),
        (lambda _line, true: true + b" 5\r\n", "more than the replies"),
        (lambda _line, true: b"\xcd\xd9" + true, "not a reply"),
        (lambda _line, true: b"\x00" + true, "not a reply"),
        (lambda _line, true: true[:-1] + b"?", "data before a refusal"),
        (lambda _line, _true: b" " * 5000, "a reply of more than 4096 bytes"),
    ],
)
def test_a_connection_whose_replies_are_in_doubt_is_used_no_more(damage, problem):
    seconds = TIMEOUT_S if problem == "no reply in time" else PATIENT_S
    with linked(damage) as (link, device):
        with pytest.raises(DriverError, match=f"^127.0.0.1:{device.port}: {problem}.*TPA.*; {REMEDY}$"):
            ask(link, "TPA", seconds=seconds)
        device.damage = None
        asked = len(device.lines)
        with pytest.raises(DriverError, match=f"not connected: {problem}"):
            ask(link, "TPB")
        assert len(device.lines) == asked
        link.open(monotonic() + PATIENT_S)
        assert ask(link, "TPB")[0].data == " 0\r\n"


def test_an_old_reply_is_never_that_to_a_new_command():
    """The late reply to the first query is there before the second one is asked, on the same controller."""
    late = []

    def delayed(_line, true):
        late.append(true)
        return b"".join(late) if len(late) == 2 else None

    with linked(delayed) as (link, device):
        with pytest.raises(DriverError, match="no reply in time"):
            ask(link, "DPA=5", seconds=TIMEOUT_S)
        with pytest.raises(DriverError, match="not connected"):
            ask(link, "TPA")
        device.damage = None
        link.open(monotonic() + PATIENT_S)
        assert ask(link, "TPA")[0].data == " 5\r\n"


@pytest.mark.parametrize(
    ("sent", "problem"), [(b" 17.0000\r\n", "unsolicited.*before TPA"), (b"", "closed the connection")]
)
def test_a_message_or_an_end_between_two_commands_is_noticed_before_the_second_is_sent(sent, problem):
    with socket.create_server(("127.0.0.1", 0)) as listening:
        link = Link("127.0.0.1", listening.getsockname()[1])
        link.open(monotonic() + PATIENT_S)
        controller, _ = listening.accept()
        with controller:
            controller.sendall(sent)
            if not sent:
                controller.shutdown(socket.SHUT_WR)
            until(lambda: link._socket.recv(1, socket.MSG_PEEK) == sent[:1])
            with pytest.raises(DriverError, match=problem):
                ask(link, "TPA")
            assert controller.recv(10) == b""


@pytest.mark.parametrize("damage", [silent, lambda _line, true: true + b"\xff" * 100])
def test_the_farewell_is_sent_on_a_connection_that_fails(damage):
    with linked(damage, farewell="STAB") as (link, device):
        with pytest.raises(DriverError):
            ask(link, "TPA", seconds=TIMEOUT_S)
        until(lambda: device.lines == ["TPA", "STAB"])


def test_without_a_failure_there_is_no_farewell():
    with linked(farewell="STAB") as (link, device):
        ask(link, "TPA")
        link.close()
        link.open(monotonic() + PATIENT_S)
        ask(link, "TPB")
    assert device.lines == ["TPA", "TPB"]


def test_after_the_deadline_nothing_is_sent_and_the_connection_remains():
    with linked() as (link, device):
        with pytest.raises(DriverError, match="no time left for TPA"):
            ask(link, "TPA", seconds=-1.0)
        assert ask(link, "TPB")[0].accepted
        assert device.lines == ["TPB"]


def test_control_characters_of_a_refused_query_are_printed():
    with linked(lambda line, true: true if line == "TC1" else b"?") as (link, device):
        with pytest.raises(DriverError) as refused:
            link.text("\x12\x16", monotonic() + PATIENT_S)
        assert str(refused.value) == f"127.0.0.1:{device.port}: ^R^V refused: 0"
