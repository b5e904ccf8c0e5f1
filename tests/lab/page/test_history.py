"""Undo and redo of changes of the session."""

import pytest

from flexneedle.lab.page.requests import OptionsRequest
from flexneedle.lab.page.server import history
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.history import SessionHistory
from flexneedle.lab.page.server.page_session import PageSession
from flexneedle.scenario.files import load_scenario
from page_clients import Client

DEPTH, LATERAL = "target.depth_mm", "target.lateral_mm"


class Edited:
    """A session with its history."""

    def __init__(self):
        self.session, self.steps = PageSession.of("phantom", load_scenario("phantom")), SessionHistory()

    def edit(self, **targets):
        values = {f"target.{name}_mm": value for name, value in targets.items()}
        self.step(self.session.edit_scenario(values), frozenset(values))

    def step(self, after, keys=None):
        self.steps.add(self.session, after, keys)
        self.session = after

    def undo(self):
        self.session = self.steps.undo(self.session)
        return self.depth

    def redo(self):
        self.session = self.steps.redo(self.session)
        return self.depth

    @property
    def depth(self):
        return self.session.scenario.target.depth_mm


@pytest.fixture
def edited():
    return Edited()


def test_edits_of_the_same_keys_are_one_step_until_it_is_closed(edited):
    for depth in (30.0, 31.0, 32.0):
        edited.edit(depth=depth)
    edited.steps.close()
    edited.edit(depth=33.0)
    edited.edit(depth=34.0, lateral=1.0)
    assert [edited.undo() for _ in range(3)] == [33.0, 32.0, 40.0]
    with pytest.raises(Refusal, match="there is nothing to undo"):
        edited.undo()
    assert [edited.redo() for _ in range(3)] == [32.0, 33.0, 34.0]
    with pytest.raises(Refusal, match="there is nothing to redo"):
        edited.redo()


def test_a_new_change_ends_redo_and_an_equal_one_is_no_step(edited):
    edited.edit(depth=30.0)
    edited.undo()
    edited.edit(depth=40.0)  # as it is
    assert (edited.steps.undoes, edited.steps.redoes) == (False, True)
    edited.edit(depth=31.0)
    assert (edited.steps.undoes, edited.steps.redoes) == (True, False)
    edited.undo()
    edited.edit(depth=31.0)  # after an undo it is a step again
    assert edited.undo() == 40.0


def test_options_presets_and_notes_are_restored_with_a_new_revision_and_the_reach_that_is_still_valid(edited):
    edited.step(edited.session.with_options(OptionsRequest(type="options", seed=3)))
    edited.step(edited.session.with_preset("phantom3d"))
    edited.edit(depth=30.0)
    before = edited.session
    edited.undo()
    assert edited.session.revision == before.revision + 1
    assert edited.session.reach_since == before.reach_since
    assert edited.session.describe().changed == []
    edited.undo()
    assert (edited.session.name, edited.session.seed) == ("phantom", 3)
    assert edited.session.reach_since == edited.session.revision == before.revision + 2
    edited.undo()
    assert edited.session.seed == 0


def test_the_number_of_steps_is_limited(edited, monkeypatch):
    monkeypatch.setattr(history, "_MOST", 2)
    for depth in (30.0, 31.0, 32.0):
        edited.edit(depth=depth)
        edited.steps.close()
    assert [edited.undo(), edited.undo(), edited.steps.undoes] == [31.0, 30.0, False]


def test_a_client_in_control_undoes_the_changes_of_all_but_not_during_an_insertion(server):
    with Client(server) as one, Client(server) as other:
        one.steer()
        one.has("session", undoes=False, redoes=False)
        for depth in (35.0, 36.0):
            one.do("edit", values={DEPTH: depth})
        one.do("steer", take=False)
        other.steer().do("edit", values={DEPTH: 37.0})  # another step, since it is another's
        other.do("rest")
        other.do("edit", values={DEPTH: 38.0})
        for depth in (37.0, 36.0, 40.0):
            other.do("undo")
            other.wait(lambda depth=depth: other.newest["session"]["values"][DEPTH] == depth)
        other.has("session", undoes=False, redoes=True)
        assert other.refused("undo") == "there is nothing to undo"
        other.do("undo", redo=True)
        other.wait(lambda: other.newest["session"]["values"][DEPTH] == 36.0)
        session = other.has("session", undoes=True, redoes=True)
        one.has("estimate", revision=session["revision"])  # the same depth was undone before
        other.inserts("paused", paused=True)
        for redo in (False, True):
            assert other.refused("undo", redo=redo).startswith("an insertion runs")
        other.do("stop")
        other.job("insertion", "done")
        other.do("undo", redo=True)
