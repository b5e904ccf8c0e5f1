"""The modules of the page as one script: a browser loads no module from a file."""

import re
from dataclasses import dataclass
from pathlib import Path
from posixpath import dirname, join, normpath

_IMPORT = re.compile(r'^import (?:\{([^}]*)\}|(\w+)) from "([^"]+)";$', re.MULTILINE)
_LATER = re.compile(r'\bimport\("([^"]+)"\)')
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) (\w+))", re.MULTILINE)
_EXPORTS = re.compile(r"\bexport\{([^{}]*)\};?\s*\Z")
_LEFT = re.compile(r"^\s*(?:import|export)\b.*|\bimport\s*[(.].*|\bexport\s*[{*].*", re.MULTILINE)


def bundled(static: Path, entry: str) -> str:
    """One script that does what the module `entry` of the folder does: each module a function, the imported ones first.

    A module may use the forms of import and export that the page's have. Raises ValueError for others, and for modules
    that import each other.
    """
    done: dict[str, str] = {}

    def add(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise ValueError(f"{' imports '.join((*above, name))}: modules must not import each other")
        if name in done:
            return
        module = _read(static, name)
        for imported in module.imports:
            add(imported, (*above, name))
        done[name] = module.text

    add(entry, ())
    return "\n".join(("const modules = {};", *done.values()))


@dataclass(frozen=True)
class _Module:
    """A module as an expression that puts what it exports into `modules`, and the names of those that it imports."""

    text: str
    imports: list[str]


def _read(static: Path, name: str) -> _Module:
    source = (static / name).read_text(encoding="utf-8")
    imports: list[str] = []
    exports: list[str] = _EXPORT.findall(source)

    def module(path: str) -> str:
        imports.append(normpath(join(dirname(name), path)))
        return f'modules["{imports[-1]}"]'

    def imported(found: re.Match[str]) -> str:
        names, default, path = found.groups()
        taken = f"default: {default}" if names is None else " ".join(names.split()).replace(" as ", ": ")
        return f"const {{ {taken} }} = {module(path)};"

    def exported(found: re.Match[str]) -> str:
        exports.extend(": ".join(reversed(each.split(" as "))) for each in found[1].split(","))
        return ""

    text = _IMPORT.sub(imported, source)
    text = _LATER.sub(lambda found: f"Promise.resolve({module(found[1])})", text)
    text = _EXPORTS.sub(exported, _EXPORT.sub("", text))
    if left := _LEFT.search(text):
        raise ValueError(f"{name}: {left[0][:80]!r}: must be a form of import or export that bundle.py knows")
    body = f"{_license(static / name)}{text}\nreturn {{ {', '.join(exports)} }};"
    return _Module(f'modules["{name}"] = (() => {{\n{body}\n}})();', imports)


def _license(path: Path) -> str:
    """The licence of a vendored module, which a copy of it must have."""
    beside = path.with_suffix(".LICENSE")
    return f"/*\n{beside.read_text(encoding='utf-8')}*/\n" if beside.exists() else ""
