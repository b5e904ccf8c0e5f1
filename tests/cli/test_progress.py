"""Progress: a bar in a terminal, plain lines elsewhere, never on stdout."""

import io
import sys

from flexneedle.cli.progress import Progress


class Terminal(io.StringIO):
    """A stderr that says it is a terminal."""

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


def test_in_a_terminal_there_is_a_bar_with_times(capsys, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    show_all()
    assert capsys.readouterr().out == ""
    assert "100 %" in terminal.getvalue()
    assert "0:00:0" in terminal.getvalue()
    assert "cost 10" in terminal.getvalue()
