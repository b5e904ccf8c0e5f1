"""The cache of compiled kernels: a folder for the sources of each package that has some."""

import importlib.util
import sys
from pathlib import Path

import pytest
from numba.core import config

from flexneedle import types
from flexneedle.mechanics import compile as compiling

SOURCE = """\
from flexneedle.mechanics.compile import kernel


@kernel
def twice(x: float) -> float:
    return {factor} * x
"""


def compiled(home):
    """Whether kernels of the sources in a folder are in the cache."""
    return any(Path(compiling.cache_folder(home)).rglob("*.nbi"))


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of its own."""
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setattr(config, "CACHE_DIR", str(folder))
    return folder


@pytest.fixture
def package(tmp_path, cache, monkeypatch):
    """Write kernels into a folder of their own, and import them. Their cache is empty at first."""
    monkeypatch.setattr(
        sys, "dont_write_bytecode", True
    )  # Python would take a second edit in a second for the first
    home = tmp_path / "kernels"
    home.mkdir()
    assert cache.exists()

    def write(factor):
        path = home / "twice.py"
        path.write_text(SOURCE.format(factor=factor))
        spec = importlib.util.spec_from_file_location("kernels_of_a_test", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    write.home = home
    return write


def test_a_package_is_compiled_once_its_kernels_lie_in_the_cache(cache, package):
    module = package(2.0)
    assert not compiled(package.home)
    assert module.twice(4.0) == 8.0
    assert compiled(package.home)
    assert list(cache.rglob("*.nbi"))
    assert str(cache) == config.CACHE_DIR  # decorating leaves Numba's own setting as it was


def test_an_edit_of_the_package_asks_for_its_kernels_anew(package):
    assert package(2.0).twice(4.0) == 8.0
    edited = package(3.0)
    assert not compiled(package.home)
    assert edited.twice(4.0) == 12.0
    assert compiled(package.home)


def test_other_columns_ask_for_the_kernels_anew(package, monkeypatch):
    """They are constants in the kernels, but defined above them."""
    before = compiling.cache_folder(package.home)
    monkeypatch.setattr(types, "DB_Y", types.DB_Z)
    assert compiling.cache_folder(package.home) != before


def test_packages_have_folders_of_their_own(package):
    """Compiled kernels of one are none of another; all depend on the shared sources."""
    package(2.0).twice(4.0)
    assert not compiled(compiling.HERE)
    assert not compiled(Path(compiling.__file__).parent)
    assert compiling.cache_folder(package.home) != compiling.cache_folder(compiling.HERE)


def test_an_edit_of_the_shared_sources_asks_for_all_kernels_anew(package, tmp_path, monkeypatch):
    package(2.0).twice(4.0)
    shared = tmp_path / "shared"
    shared.mkdir()
    for source in compiling.HERE.glob("*.py"):
        (shared / source.name).write_bytes(source.read_bytes())
    monkeypatch.setattr(compiling, "HERE", shared)
    assert compiled(package.home)  # the same sources elsewhere
    with (shared / "law.py").open("a") as file:
        file.write("# another law\n")
    assert not compiled(package.home)


def test_without_a_set_folder_the_cache_lies_beside_the_code_or_with_the_user(package, monkeypatch, tmp_path):
    monkeypatch.setattr(config, "CACHE_DIR", "")
    assert Path(compiling.cache_folder(package.home)).parent == package.home / "__pycache__"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    monkeypatch.setattr(compiling.os, "access", lambda *_: False)
    assert Path(compiling.cache_folder(package.home)).parent == tmp_path / "user" / "flexneedle"
