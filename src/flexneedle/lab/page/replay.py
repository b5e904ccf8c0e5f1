"""A recorded insertion, or two to compare, in one HTML file: the page's modules and styles, and the record as data."""

import hashlib
import html
import json
import re
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from posixpath import dirname, join, normpath
from string import Template

from flexneedle.errors import RunError
from flexneedle.lab.page.protocol import Recording, ServerMessage
from flexneedle.lab.page.shape_frames import ShapeFrame, pack_frame
from flexneedle.lab.page.worker.recordings import describe_recording
from flexneedle.record.folder import read_run
from flexneedle.record.loading import load_insertion, unfinished_note
from flexneedle.results import scenario_of
from flexneedle.simulator.zones import zones_of_record

_STATIC = Path(__file__).with_name("static")
_TEMPLATE = Path(__file__).with_name("replay.html")
_ENTRY, _STYLES, _ICON = "replay.js", ("vendor/uplot.css", "style.css", "panels.css"), "icon.svg"
_ENDS_ELEMENT = re.compile(r"<(?:/?script|/style|!--)", re.IGNORECASE)
_INCOMPLETE = "the trace is not complete"
_IMPORT = re.compile(r'^import (?:\{([^}]*)\}|(\w+)) from "([^"]+)";$', re.MULTILINE)
_LATER = re.compile(r'\bimport\("([^"]+)"\)')
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) (\w+))", re.MULTILINE)
_EXPORTS = re.compile(r"\bexport\{([^{}]*)\};?\s*\Z")
_LEFT = re.compile(r"^\s*(?:import|export)\b.*|\bimport\s*[(.].*|\bexport\s*[{*].*", re.MULTILINE)


def make_replay(
    folder: Path, second: Path | None = None, note: Callable[[str], object] = lambda _line: None
) -> str:
    """Return the HTML file that replays the insertion of a run's folder, beside the insertion of a second one.

    It needs no network and no other file, and is the same for the same runs. note: called with a line if a trace lacks
    its end, and for each zone whose file is missing or has changed.

    Raises InputError if a folder contains no insertion, RunError if it is not finished or has no control period.
    """
    folders = [folder] if second is None else [folder, second]
    record = [*_describe(folder, "first", note)]
    if second is not None:
        record += _describe(second, "second", note)
    return make_document(" and ".join(_name(each) for each in folders), record)


def make_document(title: str, record: Iterable[ServerMessage | ShapeFrame]) -> str:
    """Return the HTML file that replays the messages and frames of recorded insertions."""
    style = _check("\n".join((_STATIC / name).read_text(encoding="utf-8") for name in _STYLES))
    script = _check(bundle_modules(_STATIC, _ENTRY))
    icon = f"data:image/svg+xml;base64,{b64encode((_STATIC / _ICON).read_bytes()).decode()}"
    return Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        policy=_make_policy(style, script),
        title=html.escape(title),
        icon=icon,
        style=style,
        run=encode_record(record),
        script=script,
    )


def encode_record(record: Iterable[ServerMessage | ShapeFrame]) -> str:
    """Return a JSON array for an HTML element: messages as objects, frames in base64.

    `<` is escaped: a name or reason in the record cannot end the element.
    """
    parts = (
        json.dumps(b64encode(pack_frame(one)).decode())
        if isinstance(one, ShapeFrame)
        else one.model_dump_json()
        for one in record
    )
    return f"[{','.join(parts)}]".replace("<", "\\u003c")


def bundle_modules(static: Path, entry: str) -> str:
    """Return one script in place of the module `entry` and its imports, since a browser loads no module from a file.

    Each module becomes a function, after the modules that it imports. Raises ValueError for a form of import or export
    that the page does not use, and for modules that import each other.
    """
    done: dict[str, str] = {}

    def add(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise ValueError(f"{' imports '.join((*above, name))}: modules must not import each other")
        if name in done:
            return
        module = _convert_module(static, name)
        for imported in module.imports:
            add(imported, (*above, name))
        done[name] = module.text

    add(entry, ())
    return "\n".join(("const modules = {};", *done.values()))


@dataclass(frozen=True)
class _Module:
    """A module as an expression that adds its exports to `modules`, and the names of its imports."""

    text: str
    imports: list[str]


def _convert_module(static: Path, name: str) -> _Module:
    source = (static / name).read_text(encoding="utf-8")
    imports: list[str] = []
    exports: list[str] = _EXPORT.findall(source)

    def module(path: str) -> str:
        imports.append(normpath(join(dirname(name), path)))
        return f'modules["{imports[-1]}"]'

    def convert_import(found: re.Match[str]) -> str:
        names, default, path = found.groups()
        taken = f"default: {default}" if names is None else " ".join(names.split()).replace(" as ", ": ")
        return f"const {{ {taken} }} = {module(path)};"

    def collect_exports(found: re.Match[str]) -> str:
        exports.extend(": ".join(reversed(each.split(" as "))) for each in found[1].split(","))
        return ""

    text = _IMPORT.sub(convert_import, source)
    text = _LATER.sub(lambda found: f"Promise.resolve({module(found[1])})", text)
    text = _EXPORTS.sub(collect_exports, _EXPORT.sub("", text))
    if left := _LEFT.search(text):
        raise ValueError(
            f"{name}: {left[0][:80]!r}: a form of import or export that replay.py cannot convert"
        )
    body = f"{_license(static / name)}{text}\nreturn {{ {', '.join(exports)} }};"
    return _Module(f'modules["{name}"] = (() => {{\n{body}\n}})();', imports)


def _license(path: Path) -> str:
    """Return the licence of a vendored module, which a copy of it must include."""
    beside = path.with_suffix(".LICENSE")
    return f"/*\n{beside.read_text(encoding='utf-8')}*/\n" if beside.exists() else ""


def _describe(
    folder: Path, of: Recording, note: Callable[[str], object]
) -> Iterator[ServerMessage | ShapeFrame]:
    if line := unfinished_note(read_run(folder)):
        raise RunError(f"{line}; a replay needs a finished run")
    insertion, lacking = load_insertion(folder)
    if not insertion.periods:
        raise RunError(f"{folder}: nothing to replay: no control period is recorded")
    lost = [f"not drawn: {reason}" for reason in zones_of_record(scenario_of(insertion)).lost.values()]
    for line in filter(None, (lacking, *lost)):
        note(line)  # it contains the file's path, which the replay must not
    return describe_recording(insertion, _name(folder), of, _INCOMPLETE if lacking else "")


def _name(folder: Path) -> str:
    return folder.resolve().name


def _check(text: str) -> str:
    """Return the text of a script or style. Raises ValueError if it would end its element."""
    if found := _ENDS_ELEMENT.search(text):
        raise ValueError(f"{found[0]!r} in a script or style: it ends the element")
    return text


def _make_policy(style: str, script: str) -> str:
    """Return the content security policy: only this script and this style run, and nothing is loaded."""
    return "; ".join(
        (
            "default-src 'none'",
            f"script-src {_hash(script)}",
            f"style-src {_hash(style)}",
            "img-src data:",
            "base-uri 'none'",
            "form-action 'none'",
        )
    )


def _hash(text: str) -> str:
    return f"'sha256-{b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
