"""Progress: a bar in a terminal, plain lines elsewhere, never on stdout."""

import io
import sys

from flexneedle.cli import progress as progress_module
from flexneedle.cli.progress import Progress


class Terminal(io.StringIO):
    """A stderr that reports to be a terminal."""

    def isatty(self):
        return True


def show_all():
    with Progress() as progress:
        progress.begin("Planning")
        for done in range(1, 11):
            progress.show("Planning", done, 10, f"cost {done}")
        progress.finish("Planning")


def test_without_a_terminal_there_are_a_few_plain_lines(capsys):
    show_all()
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == ["Planning …", *(f"Planning {k}0%: cost {k}" for k in (2, 4, 6, 8, 10))]


def test_without_a_terminal_there_is_a_line_at_least_every_minute(capsys, monkeypatch):
    now = 0.0
    monkeypatch.setattr(progress_module, "monotonic", lambda: now)
    with Progress() as progress:
        for done in range(100):
            now += 25.0
            progress.show("Inserting", done, 1000, f"{done} of 1000")
    message = capsys.readouterr().err.splitlines()[1:]
    assert message[:3] == ["Inserting 0%: 2 of 1000", "Inserting 0%: 5 of 1000", "Inserting 1%: 8 of 1000"]
    assert len(message) == 33


def test_in_a_terminal_there_is_a_bar_with_times(capsys, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    show_all()
    assert capsys.readouterr().out == ""
    assert "100 %" in terminal.getvalue()
    assert "0:00:0" in terminal.getvalue()
    assert "cost 10" in terminal.getvalue()


def test_a_narrow_terminal_shows_complete_notes(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    note = "9000 of 10005, 0.56/s, 12 min 15 s left, 3 not finished"
    with Progress() as progress:
        progress.show("Inserting", 9000, 10005, note)
    assert f"{note}\n" in terminal.getvalue()
