"""Folders of caches, and processes without a home, a user name or a backend of matplotlib."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from flexneedle import caches

FIGURES = (
    *("record.figures", "lab.study.report.figures"),
    *("lab.study.figures.shares", "lab.tracker_evaluation.figures.field"),
)


@pytest.fixture(autouse=True)
def _fresh(tmp_path, monkeypatch):
    """A temporary folder of the test, without settings of the user."""
    monkeypatch.setattr(caches.tempfile, "tempdir", str(tmp_path))
    for variable in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR", "NUMBA_CACHE_DIR"):
        monkeypatch.setenv(variable, "")  # which counts as unset
    caches.temporary_folder.cache_clear()
    yield
    caches.temporary_folder.cache_clear()


def locked(monkeypatch, *writable):
    """Let only folders below `writable` be written, as for a user who owns no other."""
    monkeypatch.setattr(
        caches.os, "access", lambda path, _: any(Path(path).is_relative_to(p) for p in writable)
    )


@pytest.mark.parametrize("home", [None, "", "/nonexistent/home"])
def test_without_a_home_kernels_go_to_a_temporary_folder_with_one_line(home, tmp_path, monkeypatch, capsys):
    def no_entry(_uid):
        raise KeyError

    monkeypatch.delenv("HOME") if home is None else monkeypatch.setenv("HOME", home)
    monkeypatch.setattr("pwd.getpwuid", no_entry)
    locked(monkeypatch, tmp_path)
    found = [caches.kernel_folder("kernels-1", Path("/installed/phantom"), "") for _ in range(2)]
    caches.use_matplotlib_folder()
    assert found == [tmp_path / f"flexneedle-{os.getuid()}" / "kernels" / "kernels-1"] * 2
    assert os.environ["NUMBA_CACHE_DIR"] == str(found[0].parent)
    assert os.environ["MPLCONFIGDIR"] == str(found[0].parents[1] / "matplotlib")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        f"flexneedle: no folder of caches can be written; caches are in {found[0].parents[1]}"
    )


def test_kernels_go_to_the_first_folder_that_can_be_written(tmp_path, monkeypatch, capsys):
    chosen, code, home = (tmp_path / name for name in ("chosen", "code", "home"))
    for folder in (chosen, code, home):
        folder.mkdir()
    monkeypatch.setenv("HOME", str(home))
    orders = {
        (str(chosen), chosen, code, home): chosen,
        ("", code, home): code / "__pycache__",
        ("", home): home / ".cache" / "flexneedle",
    }
    for (given, *writable), expected in orders.items():
        locked(monkeypatch, *writable)
        assert caches.kernel_folder("kernels-1", code, given) == expected / "kernels-1"
    assert not capsys.readouterr().err


@pytest.mark.parametrize("chosen", ["/proc/flexneedle", "file"])
def test_a_chosen_folder_that_cannot_be_created_is_replaced_with_one_line(
    chosen, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    found = [caches.kernel_folder("kernels-1", tmp_path, chosen) for _ in range(2)]
    assert found == [tmp_path / f"flexneedle-{os.getuid()}" / "kernels" / "kernels-1"] * 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(found[0].parents[1]) in line


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("NUMBA_NUM_THREADS", "0"),
        ("NUMBA_NUM_THREADS", "two"),
        ("NUMBA_DISABLE_JIT", "true"),
        ("NUMBA_DISABLE_JIT", ""),
        ("NUMBA_DISABLE_JIT", "1"),
    ],
)
def test_settings_of_numba_that_cannot_be_used_are_refused_in_one_line(variable, value):
    code = "from flexneedle.cli.main import main; raise SystemExit(main(['plan', 'phantom']))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, variable: value},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "unset it" in done.stderr


def test_a_folder_of_matplotlib_that_the_user_chose_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("MPLCONFIGDIR", "/mine")
    locked(monkeypatch, tmp_path)
    caches.use_matplotlib_folder()
    assert os.environ["MPLCONFIGDIR"] == "/mine"


def test_another_user_s_temporary_folder_is_not_used(tmp_path):
    """A link, or a folder that others can write, could hold code of others."""
    name = tmp_path / f"flexneedle-{os.getuid()}"
    name.symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").mkdir()
    assert caches.temporary_folder() != name
    name.unlink()
    name.mkdir()
    name.chmod(0o777)
    caches.temporary_folder.cache_clear()
    assert caches.temporary_folder() != name


@pytest.mark.parametrize("backend", ["module://matplotlib_inline.backend_inline", "nonsense"])
def test_figures_need_no_backend(backend):
    modules = [f"flexneedle.{name}" for name in FIGURES]
    done = [
        subprocess.run(
            [sys.executable, "-c", f"import {module}"],
            env={**os.environ, "MPLBACKEND": backend}, capture_output=True, text=True, check=False,
        ).stderr
        for module in modules
    ]  # fmt: skip
    assert done == [""] * len(modules)
