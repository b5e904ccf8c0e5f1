"""Saving and showing of figures: fonts of files, notebooks, windows."""

import base64
import sys
from types import ModuleType, SimpleNamespace

import pytest
from matplotlib.figure import Figure

from flexneedle.errors import InputError
from flexneedle.figures import style

PNG = b"\x89PNG"


@pytest.fixture
def figure():
    made = style.new_figure(1.0)
    made.text(0.1, 0.5, "depth (mm)")
    return made


def test_text_stays_text_in_vector_files(figure, tmp_path):
    """Journals refuse Type 3 fonts."""
    for name in ("a.pdf", "a.svg"):
        figure.savefig(tmp_path / name)
    pdf = (tmp_path / "a.pdf").read_bytes()
    assert b"/Type3" not in pdf
    assert b"/CIDFontType2" in pdf
    assert "depth (mm)</text>" in (tmp_path / "a.svg").read_text()


def test_a_saved_figure_is_drawn_once_for_each_file_and_nothing_is_cut(tmp_path, monkeypatch):
    drawn, draw = [], Figure.draw
    monkeypatch.setattr(Figure, "draw", lambda *of: drawn.append(draw(*of)))
    figure = style.new_figure(2.0)
    figure.subplots().set_ylabel("two\nlines", fontsize=30)
    style.save(figure, tmp_path, "name")
    assert len(drawn) == 2
    assert figure.axes[0].get_tightbbox().x0 > figure.bbox.x0


def test_a_notebook_shows_the_picture(figure, monkeypatch):
    assert figure._repr_png_().startswith(PNG)
    shown = []
    shell = SimpleNamespace(kernel=None, display_pub=SimpleNamespace(publish=shown.append))
    ipython = ModuleType("IPython")
    ipython.get_ipython = lambda: shell
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    figure.show()
    assert base64.b64decode(shown[0]["image/png"]).startswith(PNG)


def toolkit(monkeypatch, name, new_manager):
    """Install a backend with windows, in front of which nobody sits; return what was done with it."""
    done = []
    manager = SimpleNamespace(start_main_loop=lambda: done.append("closed"))
    canvas = SimpleNamespace(new_manager=lambda figure, _: new_manager(figure, done), manager_class=manager)
    module = ModuleType(name)
    module.FigureCanvas = canvas
    monkeypatch.setitem(sys.modules, f"matplotlib.backends.backend_{name}", module)
    return done


def opened(_figure, done):
    return SimpleNamespace(show=lambda: done.append("shown"))


def broken(_figure, _done):
    raise RuntimeError("couldn't connect to display")


def test_the_first_toolkit_that_works_opens_a_window_until_it_is_closed(figure, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(style, "_WINDOWS", ("missing", "broken", "works"))
    toolkit(monkeypatch, "broken", broken)
    done = toolkit(monkeypatch, "works", opened)
    figure.show()
    assert done == ["shown", "closed"]


@pytest.mark.parametrize(("display", "why"), [("", "no display"), (":0", "couldn't connect to display")])
def test_without_a_window_one_line_says_what_to_do(figure, monkeypatch, display, why):
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.setenv("WAYLAND_DISPLAY", "")
    monkeypatch.setattr(style, "_WINDOWS", ("broken",))
    toolkit(monkeypatch, "broken", broken)
    with pytest.raises(InputError, match=rf"^no window can be opened \(.*{why}\): save the figure") as caught:
        figure.show()
    assert "\n" not in str(caught.value)
