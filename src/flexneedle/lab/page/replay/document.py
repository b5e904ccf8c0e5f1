"""A recorded insertion, or two to compare, in one HTML file: the page's modules and styles, and the record as data."""

import hashlib
import html
import json
import re
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from string import Template

from flexneedle.errors import RunError
from flexneedle.lab.page.frames import ShapeFrame, packed
from flexneedle.lab.page.messages import News
from flexneedle.lab.page.replay.bundle import bundled
from flexneedle.lab.page.worker.recording import Of, recorded
from flexneedle.record.folder import read_run
from flexneedle.record.loading import load_insertion, unfinished

_STATIC = Path(__file__).parents[1] / "static"
_TEMPLATE = Path(__file__).with_name("replay.html")
_ENTRY, _STYLES, _ICON = "replay.js", ("vendor/uplot.css", "style.css", "panels.css"), "icon.svg"
_ENDS_ELEMENT = re.compile(r"<(?:/?script|/style|!--)", re.IGNORECASE)
_INCOMPLETE = "the trace is not complete"


def replay_of(
    folder: Path, second: Path | None = None, note: Callable[[str], object] = lambda _line: None
) -> str:
    """The HTML file that replays the insertion of a run's folder, beside that of a second one.

    It needs no network and no other file, and is the same for the same runs. note: called with a line if a trace lacks
    its end.

    Raises InputError if a folder contains no insertion, RunError if it is not finished or has no control period.
    """
    folders = [folder] if second is None else [folder, second]
    record = [*_recorded(folder, "first", note)]
    if second is not None:
        record += _recorded(second, "second", note)
    return document(" and ".join(_name(each) for each in folders), record)


def document(title: str, record: Iterable[News | ShapeFrame]) -> str:
    """The HTML file that replays what a worker has reported of recorded insertions."""
    style = _checked("\n".join(_text(name) for name in _STYLES))
    script = _checked(bundled(_STATIC, _ENTRY))
    icon = f"data:image/svg+xml;base64,{b64encode((_STATIC / _ICON).read_bytes()).decode()}"
    return Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        policy=_policy(style, script),
        title=html.escape(title),
        icon=icon,
        style=style,
        run=as_data(record),
        script=script,
    )


def as_data(record: Iterable[News | ShapeFrame]) -> str:
    """News as JSON objects, frames in base64, in a JSON array that is the text of an HTML element.

    `<` is escaped, so that no name or reason in the record ends the element.
    """
    parts = (
        json.dumps(b64encode(packed(one)).decode()) if isinstance(one, ShapeFrame) else one.model_dump_json()
        for one in record
    )
    return f"[{','.join(parts)}]".replace("<", "\\u003c")


def _recorded(folder: Path, of: Of, note: Callable[[str], object]) -> Iterator[News | ShapeFrame]:
    if line := unfinished(read_run(folder)):
        raise RunError(f"{line}; a replay needs a finished run")
    insertion, lacking = load_insertion(folder)
    if not insertion.periods:
        raise RunError(f"{folder}: nothing to replay: no control period is recorded")
    if lacking:
        note(lacking)  # it names the file's path, which is nobody's business whom the replay is given to
    return recorded(insertion, _name(folder), of, _INCOMPLETE if lacking else "")


def _name(folder: Path) -> str:
    return folder.resolve().name


def _text(name: str) -> str:
    return (_STATIC / name).read_text(encoding="utf-8")


def _checked(text: str) -> str:
    """A script or style as the text of its element. Raises ValueError if it would not be."""
    if found := _ENDS_ELEMENT.search(text):
        raise ValueError(f"{found[0]!r} in a script or style: must not be, it ends the element")
    return text


def _policy(style: str, script: str) -> str:
    """The content security policy: this script and this style alone run, and nothing is loaded."""
    return "; ".join(
        (
            "default-src 'none'",
            f"script-src {_source(script)}",
            f"style-src {_source(style)}",
            "img-src data:",
            "base-uri 'none'",
            "form-action 'none'",
        )
    )


def _source(text: str) -> str:
    return f"'sha256-{b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
