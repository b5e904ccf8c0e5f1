"""Edits of the page's scenario by peers of OpenIGTLink, between insertions."""

import math

import pytest

from flexneedle.lab.igtl.records import PeerGeometry
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.page_session import PageSession
from flexneedle.lab.page.server.received_edits import ReceivedEdits
from flexneedle.scenario.files import load_scenario
from igtl_messages import MATRIX
from igtl_peers import connected, free_port
from page_clients import STUB, Client, served

IMAGE = ImageRegistration.of_matrix(MATRIX)
SHIFTED = ImageRegistration(IMAGE.rotation, (10.5, -2.25, 30.0))
PATH = PeerGeometry("peer", IMAGE, (1.0, -28.5, -23.0), (1.0, 1.5, -23.0))
SESSION = PageSession.of("phantom3d", load_scenario("phantom3d"))


class Live:
    """No insertion, or one that runs."""

    def __init__(self, runs=False):
        self.runs = runs

    def require_none(self, why):
        if self.runs:
            raise Refusal(f"an insertion runs: {why}")


def edit(*received, session=SESSION, runs=False, radius=math.inf):
    edits = ReceivedEdits(Live(runs), radius)
    for one in received:
        session, _ = edits.edit(session, one)
    return session


def test_a_target_is_edited_with_entry_and_registration():
    found = edit(PATH)
    assert found.revision == SESSION.revision + 1
    assert found.scenario.target.position == pytest.approx((30.0, -1.25, 7.0), abs=1e-9)
    assert found.scenario.entry.lateral_mm == pytest.approx(-1.25, abs=1e-9)
    assert found.scenario.image.translation_mm == IMAGE.translation
    assert edit(PATH, PATH) == found


def test_an_entry_waits_for_the_next_target_and_then_is_edited_as_any():
    entry, *aims = (
        *(PeerGeometry("peer", None, None, (0.0, 2.0, 1.0)),),
        *(PeerGeometry("peer", None, (30.0, y, 0.0)) for y in (1.0, 2.0)),
    )
    edits = ReceivedEdits(Live(), math.inf)
    assert edits.edit(SESSION, entry)[0] is SESSION
    first, _ = edits.edit(SESSION, aims[0])
    assert first.scenario.entry.lateral_mm == 2.0
    second, _ = edits.edit(first.edit_scenario({"entry.lateral_mm": 0.0}), aims[1])
    assert (second.scenario.entry.lateral_mm, second.scenario.target.lateral_mm) == (0.0, 2.0)


def test_a_registration_alone_is_edited_and_another_one_is_refused(capsys):
    (found, other) = (
        edit(PeerGeometry("peer", IMAGE), *more) for more in ((), [PeerGeometry("peer", SHIFTED)])
    )
    assert found.scenario.image.translation_mm == IMAGE.translation
    assert other == found
    assert "peer: refused: registration of the image: differs from [image]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("received", "more", "reason"),
    [
        (PATH, {"runs": True}, "an insertion runs"),
        (PeerGeometry("peer", None, (900.0, 0.0, 0.0)), {}, "target.depth_mm = 900"),
        (PATH, {"session": edit(PeerGeometry("peer", IMAGE)), "radius": 7.0}, "skin_radius_mm less"),
    ],
)
def test_what_cannot_be_edited_is_one_line_and_printed_once(received, more, reason, capsys):
    session = more.get("session", SESSION)
    capsys.readouterr()
    assert edit(received, received, **more) == session
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("flexneedle: peer: refused: ")
    assert reason in line


@pytest.mark.long
def test_a_target_of_a_peer_is_shown_and_undone_on_the_page(tmp_path):
    port = free_port()
    worker = ("flexneedle.lab.page.worker", "insertion", f"127.0.0.1:{port}", "ImageToNeedle")
    with served(tmp_path, "phantom3d", workers=(STUB, worker)) as server, Client(server) as client:
        client.steer()
        with connected(port) as peer:
            peer.send_points(Target=(30.0, 2.0, 1.0))
            client.has("session", revision=2)
            assert client.newest["session"]["values"]["target.depth_mm"] == 30.0
            client.do("undo")
            client.has("session", revision=3)
            assert client.newest["session"]["values"]["target.depth_mm"] != 30.0
