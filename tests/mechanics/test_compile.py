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
    """Return whether kernels of the sources in a folder are in the cache."""
    return any(Path(compiling.cache_folder(home)).rglob("*.nbi"))


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache."""
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setattr(config, "CACHE_DIR", str(folder))
    return folder


@pytest.fixture
def package(tmp_path, cache, monkeypatch):
    """Return a function that writes kernels into a separate folder and imports them."""
    # Python would mistake a second edit within a second for the first.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
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


def test_kernels_are_compiled_once_for_each_version_of_their_sources(cache, package):
    module = package(2.0)
    assert not compiled(package.home)
    assert module.twice(4.0) == 8.0
    assert compiled(package.home)
    assert str(cache) == config.CACHE_DIR  # decorating leaves Numba's own setting unchanged
    edited = package(3.0)
    assert not compiled(package.home)
    assert edited.twice(4.0) == 12.0


def test_other_columns_need_other_kernels(package, monkeypatch):
    """They are constants in the kernels, but defined above them."""
    before = compiling.cache_folder(package.home)
    monkeypatch.setattr(types, "DB_Y", types.DB_Z)
    assert compiling.cache_folder(package.home) != before


def test_packages_have_separate_folders_and_depend_on_the_shared_sources(package, tmp_path, monkeypatch):
    package(2.0).twice(4.0)
    assert not compiled(compiling.HERE)
    shared = tmp_path / "shared"
    shared.mkdir()
    for source in compiling.HERE.glob("*.py"):
        (shared / source.name).write_bytes(source.read_bytes())
    monkeypatch.setattr(compiling, "HERE", shared)
    assert compiled(package.home)  # the same sources elsewhere
    with (shared / "law.py").open("a") as file:
        file.write("# another law\n")
    assert not compiled(package.home)


def test_the_cache_is_beside_the_code_or_with_the_user(package, monkeypatch, tmp_path):
    monkeypatch.setattr(config, "CACHE_DIR", "")
    assert Path(compiling.cache_folder(package.home)).parent == package.home / "__pycache__"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    monkeypatch.setattr(compiling.os, "access", lambda *_: False)
    assert Path(compiling.cache_folder(package.home)).parent == tmp_path / "user" / "flexneedle"
