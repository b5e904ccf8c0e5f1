"""The files on which a custom module depends: its source, the modules that it imports, and data beside them.

Imports are read from the sources and resolved without executing a module: statements anywhere in a file, and
`import_module` and `__import__`. Where they compute a name, all modules of the folder count. Data are files in the
folder of a module, or below, that a text in its source names, such as "gains.json".
"""

import ast
import hashlib
import pkgutil
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import invalidate_caches
from importlib.machinery import SOURCE_SUFFIXES, ModuleSpec
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.util import resolve_name
from pathlib import Path
from typing import Any

_DIGITS = 12
_LONGEST_NAME = 100  # of a data file
_PACKAGE = __name__.partition(".")[0]
_PYTHON = {Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib")}
_LINE_ENDS = ((b"\r\n", b"\n"), (b"\r", b"\n"))

_loaded: dict[str, tuple[object, str]] = {}
"""By the name of a loaded module: its spec, new after a reload, and the digest of its source at first sight."""


@dataclass(frozen=True)
class _Place:
    """Location of a module. folders: of a package, else ()."""

    spec: ModuleSpec
    folders: tuple[str, ...]

    @property
    def is_folder(self) -> bool:
        """Whether the module is a package without `__init__.py`."""
        return self.spec.origin is None and bool(self.folders)

    @property
    def homes(self) -> list[Path]:
        """Folders that hold a module without a parent."""
        paths = [Path(self.spec.origin or "").parent] if not self.folders else map(Path, self.folders)
        return [path.parent if self.folders else path for path in paths]


def search_current_folder() -> None:
    """Search the current directory first for modules, as with `python -m`."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)


def has_record(module: str) -> bool:
    """Return whether the source of a loaded module was read when it was loaded."""
    return module in _loaded and _loaded[module][0] is _loaded_spec(module)


def digest_files(module: str, *, as_loaded: bool = True) -> dict[str, str]:
    """Return a digest of each source file on which a module depends, by its name, such as `gains/pid.py`.

    Files of Python and of this package are left out; other installed packages that it imports are present with their
    version; of an installed package, `module` and its own files count. A digest does not depend on the folder or on
    line ends, which Python ignores; it is "" without a source: compiled modules and notebooks. as_loaded: whether a
    module that this process has loaded counts with its source at that time (default: true), not the present one.
    Returns {} for a module that is not found.
    """
    invalidate_caches()
    search_current_folder()
    found: dict[str, str] = {}
    waiting, seen = list(_with_parents([module])), set[str]()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        top = name.partition(".")[0]
        if top in seen and top in found and name != top:  # of an installed package
            continue
        kind = "own" if top == module.partition(".")[0] != _PACKAGE else _find_kind(top)
        if kind == "installed":
            found[top] = _find_version(top)
        elif kind == "own" and (place := _find(name)):
            imported = _add_module(found, name, place, as_loaded)
            waiting += _with_parents(imported)
    return dict(sorted(found.items()))


def _with_parents(names: Iterable[str]) -> Iterator[str]:
    """Yield modules with the packages that contain them; `package.*` with all modules of the package."""
    for name in names:
        parts = name.removesuffix(".*").split(".")
        yield from (".".join(parts[:count]) for count in range(1, len(parts) + 1))
        if name.endswith(".*") and _find_kind(parts[0]) == "own" and (place := _find(".".join(parts))):
            yield from (f"{'.'.join(parts)}.{each.name}" for each in pkgutil.iter_modules(place.folders))


def _add_module(found: dict[str, str], name: str, place: _Place, as_loaded: bool) -> list[str]:
    """Add the file of a module, and return the names that it imports."""
    if place.is_folder:
        return []
    source = _read(place.spec)
    suffix = Path(place.spec.origin or "").suffix if name != "__main__" else ".py"
    file = name.replace(".", "/") + ("/__init__" if place.folders else "") + suffix
    if source is None:
        found[file] = ""
        return []
    found[file] = _digest(name, source, as_loaded)
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):  # cannot be imported either
        return []
    package, folder = name if place.folders else name.rpartition(".")[0], Path(place.spec.origin or "").parent
    for data in _find_data(tree, folder):
        inside = f"{package.replace('.', '/')}/{data}" if package else data
        found.setdefault(inside, _digest_bytes((folder / data).read_bytes()))
    imported = list(_find_imports(tree, package))
    if "" in imported:
        imported += [f"{package}.{each.name}".lstrip(".") for each in pkgutil.iter_modules([str(folder)])]
    return list(filter(None, imported))


def _find_data(tree: ast.Module, folder: Path) -> set[str]:
    """Return the paths, relative to a folder, of the files in it or in its folders that a source names.

    Of a path such as HERE / "data" / "sub" / "gains.json", each part is named.
    """
    texts = {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    names = {text for text in texts if text.isprintable() and len(text) <= _LONGEST_NAME}
    home = folder.resolve()
    found, waiting = set[Path](), [home]
    while waiting:
        each = waiting.pop()
        paths = {path.resolve() for name in names if (path := each / name).exists()}
        inside = {path for path in paths if path.is_relative_to(home)} - found
        found |= inside
        waiting += [path for path in inside if path.is_dir() and path != home]
    return {str(path.relative_to(home)) for path in found if path.is_file()}


def _digest_bytes(content: bytes) -> str:
    for end, plain in _LINE_ENDS:
        content = content.replace(end, plain)
    return hashlib.sha256(content).hexdigest()[:_DIGITS]


def _digest(name: str, source: bytes, as_loaded: bool) -> str:
    digest = _digest_bytes(source)
    if name not in sys.modules:
        return digest
    if not has_record(name):
        _loaded[name] = (_loaded_spec(name), digest)
    return _loaded[name][1] if as_loaded else digest


def _loaded_spec(name: str) -> ModuleSpec | None:
    return getattr(sys.modules.get(name), "__spec__", None)


def _read(spec: ModuleSpec) -> bytes | None:
    """Return the source of a module, also from an archive, or None."""
    path = Path(spec.origin or "")
    if path.suffix not in SOURCE_SUFFIXES:
        return None
    loader: Any = spec.loader
    try:
        return path.read_bytes() if path.is_file() else bytes(loader.get_data(str(path)))
    except (OSError, AttributeError):
        return None


def _find_imports(tree: ast.Module, package: str) -> Iterator[str]:
    """Yield the names that a source imports, "" for a computed one.

    Of `from a import b` both a and a.b, which may be an attribute.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = _resolve("." * node.level + (node.module or ""), package)
            yield from (name for alias in node.names if base for name in (base, f"{base}.{alias.name}"))
        elif isinstance(node, ast.Call) and node.args and _is_import(node.func):
            given = node.args[0].value if isinstance(node.args[0], ast.Constant) else None
            yield _resolve(given, package) if isinstance(given, str) else ""


def _is_import(function: ast.expr) -> bool:
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    return name in {"import_module", "__import__"}


def _resolve(name: str, package: str) -> str:
    """Return the full name of an imported module, "" if it is outside of all packages."""
    try:
        return resolve_name(name, package)
    except ImportError:
        return ""


def _find(name: str) -> _Place | None:
    """Return the location of a module, loaded or not; its packages are not executed."""
    if name == "__main__":
        return _Place(ModuleSpec(name, None, origin=getattr(sys.modules[name], "__file__", None)), ())
    path = None
    parent, _, last = name.rpartition(".")
    if parent:
        package = _find(parent)
        if package is None or not package.folders:
            return None
        path = list(package.folders)
    spec = _loaded_spec(name) or _find_spec(name, path)
    if spec is None:
        return None
    if spec.origin is None and spec.submodule_search_locations is not None:
        folders = [str(Path(each) / last) for each in (sys.path if path is None else path)]
        return _Place(spec, tuple(folder for folder in folders if Path(folder).is_dir()))
    return _Place(spec, tuple(spec.submodule_search_locations or ()))


def _find_spec(name: str, path: list[str] | None) -> ModuleSpec | None:
    for find in (finder.find_spec for finder in sys.meta_path if hasattr(finder, "find_spec")):
        try:
            spec = find(name, path)
        except KeyError:  # a folder without `__init__.py` in a package that is not loaded
            return ModuleSpec(name, None, is_package=True)
        if spec is not None:
            return spec
    return None


def _find_kind(top: str) -> str:
    """Return "own", "installed", or "" for modules of Python and of this package, and for missing ones."""
    place = None if top == _PACKAGE else _find(top)
    if place is None or place.spec.origin in {"built-in", "frozen"}:
        return ""
    homes = [home.resolve() for home in place.homes]
    if any(home in _PYTHON or (home.name == "lib-dynload" and home.parent in _PYTHON) for home in homes):
        return ""
    return "installed" if all(map(_is_of_packages, homes)) else "own"


def _is_of_packages(folder: Path) -> bool:
    """Return whether a folder holds installed packages."""
    return folder.name in {"site-packages", "dist-packages"} or any(folder.glob("*.dist-info"))


@cache
def _find_version(top: str) -> str:
    """Return the version of an installed package, or "" for a module without one."""
    try:
        return version(top)
    except PackageNotFoundError:
        names = packages_distributions().get(top)
        return version(names[0]) if names else ""
