"""The cache of compiled kernels: a folder for the sources of each package that has some."""

import importlib.util
import os
import subprocess
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


@pytest.mark.parametrize("part", ["cache_tag", "numba", "processor"])
def test_another_python_numba_or_processor_needs_other_kernels(package, monkeypatch, part):
    before, machine = compiling.cache_folder(package.home), list(compiling._machine())
    machine[("cache_tag", "numba", "processor").index(part)] = "another"
    monkeypatch.setattr(compiling, "_machine", lambda: tuple(machine))
    assert compiling.cache_folder(package.home) != before


def test_the_processor_is_the_one_that_numba_compiles_for():
    """Name and features, as in the key of Numba's own cache."""
    compiled = compiling.kernel(lambda x: x)
    compiled(1.0)
    assert compiling._machine()[2] == compiled.targetctx.codegen().magic_tuple()


def test_the_stamp_of_the_sources_has_their_times(package):
    package(2.0)
    before = compiling.source_stamp(package.home)
    os.utime(package.home / "twice.py", (0, 0))
    assert compiling.source_stamp(package.home) != before


def test_python_cannot_call_a_function_of_kernels():
    """A kernel calls it, and `interpret` runs it; without the error, the process would end."""
    twice = compiling.inner(lambda x: 2.0 * x)
    with pytest.raises(TypeError, match=r"in Python, call interpret\(<lambda>\)"):
        twice(4.0)
    assert compiling.interpret(twice)(4.0) == compiling.kernel(lambda x: twice(x))(4.0) == 8.0


@pytest.mark.usefixtures("cache")
def test_a_function_of_kernels_is_compiled_once_for_constants_and_variables():
    after = compiling.inner(lambda x: x + 1)
    assert compiling.kernel(lambda x: after(0) + after(1) + after(x))(2) == 6
    assert len(after.signatures) == 1


def test_without_compilation_one_line_says_what_to_do():
    command = [sys.executable, "-m", "flexneedle", "plan", "phantom"]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    rule = "NUMBA_DISABLE_JIT=1: an insertion would take hours without compiled kernels; unset it"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"flexneedle: {rule}\n")
