"""Files on which a custom module depends: the imports that are followed, and when a digest is the same."""

import importlib
import subprocess
import sys
import zipfile

import pytest

from flexneedle.module_files import digest_files
from flexneedle.plugins import load_part


@pytest.fixture
def project(tmp_path, monkeypatch):
    """The current directory, whose modules begin with "mine"."""
    folder = tmp_path / "project"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield folder
    for name in set(sys.modules) - before:
        if name.startswith("mine"):
            del sys.modules[name]


def write_all(folder, files):
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


PACKAGE = {"mine/__init__.py": "", "mine/sub/__init__.py": "", "mine/sub/gains.py": "", "mine/other.py": ""}
OF_MINE = "from mine import "
BOTH = ["mine_b.py", "mine_c.py"]
IMPORTS = [  # the module, its source, further files, the files that are found apart from the module's
    ("mine_a", "", {"mine_b.py": ""}, []),
    (
        "mine_a",
        "import mine_b, mine_c as c",
        {"mine_b.py": "", "mine_c.py": "", "mine_d.py": ""},
        ["mine_b.py", "mine_c.py"],
    ),
    (
        "mine_a",
        "from mine_b import X",
        {"mine_b.py": "import mine_c", "mine_c.py": "import mine_a"},
        ["mine_b.py", "mine_c.py"],
    ),
    ("mine_a", "def decide():\n    import mine_b", {"mine_b.py": ""}, ["mine_b.py"]),
    (
        "mine_a",
        "try:\n    import mine_none\nexcept ImportError:\n    import mine_b",
        {"mine_b.py": ""},
        ["mine_b.py"],
    ),
    ("mine_a", "import mine_b", {"mine_b.py": "def decide(:"}, ["mine_b.py"]),
    (
        "mine_a",
        "import mine.sub.gains",
        PACKAGE,
        ["mine/__init__.py", "mine/sub/__init__.py", "mine/sub/gains.py"],
    ),
    (
        "mine_a",
        "from mine.sub import gains",
        PACKAGE,
        ["mine/__init__.py", "mine/sub/__init__.py", "mine/sub/gains.py"],
    ),
    (
        "mine_a",
        "from mine.sub import *",
        PACKAGE,
        ["mine/__init__.py", "mine/sub/__init__.py", "mine/sub/gains.py"],
    ),
    ("mine_a", "from mine import other", PACKAGE, ["mine/__init__.py", "mine/other.py"]),
    (
        "mine_a",
        "import mine",
        PACKAGE | {"mine/__init__.py": "from . import other"},
        ["mine/__init__.py", "mine/other.py"],
    ),
    (
        "mine_a",
        "import mine",
        PACKAGE | {"mine/__init__.py": "from .other import X"},
        ["mine/__init__.py", "mine/other.py"],
    ),
    ("mine.part", "from . import other", PACKAGE, ["mine/__init__.py", "mine/other.py"]),
    (
        "mine.part",
        "from .sub.gains import K",
        PACKAGE,
        ["mine/__init__.py", "mine/sub/__init__.py", "mine/sub/gains.py"],
    ),
    (
        "mine.sub.part",
        "from .. import other",
        PACKAGE,
        ["mine/__init__.py", "mine/other.py", "mine/sub/__init__.py"],
    ),
    ("mine.sub.part", "from .... import other", PACKAGE, ["mine/__init__.py", "mine/sub/__init__.py"]),
    ("mine_a", "import mine.deep.gains", {"mine/deep/gains.py": ""}, ["mine/deep/gains.py"]),
    ("mine_a", "import importlib\nimportlib.import_module('mine_b')", {"mine_b.py": ""}, ["mine_b.py"]),
    (
        "mine.part",
        "from importlib import import_module as f\nimport_module('.other', __package__)",
        PACKAGE,
        ["mine/__init__.py", "mine/other.py"],
    ),
    (
        "mine_a",
        "import importlib\nimportlib.import_module('mine_' + 'b')",
        {"mine_b.py": "", "mine_c.py": ""},
        BOTH,
    ),
    ("mine_a", "for k in 'bc':\n    __import__(f'mine_{k}')", {"mine_b.py": "", "mine_c.py": ""}, BOTH),
    (
        "mine_a",
        "open('gains.json')\nprint('.', 'a\\0', 'x' * 9)",
        {"gains.json": "1", "other.json": ""},
        ["gains.json"],
    ),
    ("mine_a", "HERE / 'data' / 'gains.csv'", {"data/gains.csv": "1"}, ["data/gains.csv"]),
    (
        "mine_a",
        "HERE / 'data' / 'sub' / 'gains.csv', '..', '/', 'sub/..'",
        {"data/sub/gains.csv": "1", "data/sub/other.csv": "1"},
        ["data/sub/gains.csv"],
    ),
    ("mine_a", "runpy.run_path('mine_b.py')", {"mine_b.py": ""}, ["mine_b.py"]),
    (
        "mine.part",
        "files(__package__) / 'k.npz'",
        PACKAGE | {"mine/k.npz": ""},
        ["mine/__init__.py", "mine/k.npz"],
    ),
    ("mine_a", "open('../mine_x.json')", {"../mine_x.json": "1"}, []),
    ("mine_a", "import os.path, json, sys, math, flexneedle", {}, []),
    ("mine_a", "import numpy as np\nfrom scipy import special", {}, ["numpy", "scipy"]),
    ("mine_a", "from mine_b import K  # \xe9", {"mine_b.py": "# \xe9"}, ["mine_b.py"]),
]


@pytest.mark.parametrize(("module", "source", "files", "expected"), IMPORTS)
def test_all_modules_of_the_project_that_are_imported_count(project, module, source, files, expected):
    name = module.replace(".", "/") + ".py"
    write_all(project, {**files, name: source})
    before = set(sys.modules)
    found = digest_files(module)
    assert sorted(found) == sorted([*expected, name])
    assert all(found.values())
    assert not {loaded for loaded in set(sys.modules) - before if loaded.startswith("mine")}


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("K = 1\nJ = 2\n", "K = 1\r\nJ = 2\r\n", True),
        ("K = 1\nJ = 2\n", "K = 1\rJ = 2\r", True),
        ("K = 1\n", "K = 1.0\n", False),
        ("K = 1\n", "K = 1  # per s\n", False),
    ],
)
def test_line_ends_and_folders_do_not_count(project, tmp_path, monkeypatch, old, new, same):
    write_all(project, {"mine_a.py": "import mine_b"})
    (project / "mine_b.py").write_bytes(old.encode())
    first = digest_files("mine_a")
    other = tmp_path / "other"
    write_all(other, {"mine_a.py": "import mine_b", "__pycache__/mine_a.cpython-311.pyc": "x"})
    (other / "mine_b.py").write_bytes(new.encode())
    monkeypatch.chdir(other)
    assert (digest_files("mine_a") == first) is same


def test_modules_of_another_folder_of_the_search_path_count(project, tmp_path, monkeypatch):
    write_all(project, {"mine_a.py": "import mine_lib"})
    write_all(tmp_path / "lib", {"mine_lib.py": "K = 1"})
    monkeypatch.syspath_prepend(tmp_path / "lib")
    assert list(digest_files("mine_a")) == ["mine_a.py", "mine_lib.py"]


@pytest.mark.parametrize("folder", ["venv/site-packages", "installed"])
def test_an_installed_package_counts_by_its_own_files_else_by_its_version(project, monkeypatch, folder):
    """Also if the environment is in the folder of the project, or is a target folder of pip."""
    files = {
        "minepack/__init__.py": "",
        "minepack/pid.py": "from . import gains\nimport mineother",
        "minepack/gains.py": "",
    }
    about = {"minepack-1.5.dist-info/METADATA": "Metadata-Version: 2.1\nName: minepack\nVersion: 1.5\n"}
    write_all(project / folder, {**files, **about, "mineother.py": ""})
    write_all(project, {"mine_a.py": "from minepack import pid"})
    monkeypatch.syspath_prepend(project / folder)
    own = ["minepack/__init__.py", "minepack/gains.py", "minepack/pid.py"]
    assert list(digest_files("minepack.pid")) == ["mineother", *own]
    found = digest_files("mine_a")
    assert (list(found), found["minepack"]) == (["mine_a.py", "minepack"], "1.5")
    assert digest_files("minepack.pid")["minepack/pid.py"] != found["mine_a.py"]


def test_a_loaded_module_counts_as_it_was_loaded_until_it_is_reloaded(project):
    write_all(project, {"mine_a.py": "import mine_b", "mine_b.py": "K = 1"})
    before = digest_files("mine_a")
    helper = load_part("mine_a:mine_b", ())
    (project / "mine_b.py").write_text("K = 22")
    assert digest_files("mine_a") == before
    assert digest_files("mine_a", as_loaded=False)["mine_b.py"] != before["mine_b.py"]
    importlib.reload(helper)
    assert digest_files("mine_a")["mine_b.py"] == digest_files("mine_a", as_loaded=False)["mine_b.py"]


def test_a_module_without_source_has_no_digest(project):
    write_all(project, {"mine_a.py": "import mine_fast", "mine_fast.so": "", "mine_old.pyc": ""})
    suffix = importlib.machinery.EXTENSION_SUFFIXES[0]
    (project / "mine_fast.so").rename(project / f"mine_fast{suffix}")
    assert digest_files("mine_a")["mine_fast.so"] == ""
    assert digest_files("mine_old") == {"mine_old.pyc": ""}
    assert digest_files("mine_none") == digest_files("flexneedle.control") == {}


def test_modules_in_an_archive_count(project, monkeypatch):
    with zipfile.ZipFile(project / "lib.zip", "w") as archive:
        archive.writestr("mine_z.py", "import mine_y")
        archive.writestr("mine_y.py", "K = 1")
    monkeypatch.syspath_prepend(project / "lib.zip")
    found = digest_files("mine_z")
    assert list(found) == ["mine_y.py", "mine_z.py"]
    assert all(found.values())


@pytest.mark.parametrize(("argv", "file"), [(["script.py"], True), (["-c", "{source}"], False)])
def test_a_script_counts_and_an_input_without_file_has_no_digest(project, argv, file):
    source = (
        "import mine_b\nfrom flexneedle.module_files import digest_files\nprint(digest_files('__main__'))"
    )
    write_all(project, {"script.py": source, "mine_b.py": ""})
    command = [sys.executable, *(word.format(source=source) for word in argv)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ("'mine_b.py': '" in done.stdout) is file
    assert ("''" in done.stdout) is not file
