"""HTML that is safe by default: whatever is not `Html` already is text, and escaped."""

from collections.abc import Iterable, Sequence
from html import escape

_VOID = frozenset({"img", "meta", "br"})
# Nothing is loaded and no script runs, whatever the data hold.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


class Html(str):
    """Text that is HTML."""

    __slots__ = ()


def element(tag: str, *children: object, **attributes: str) -> Html:
    """Return an element. Children that are not Html are text; `class_` is the attribute class; None is left out."""
    named = "".join(f' {name.rstrip("_")}="{escape(value)}"' for name, value in attributes.items())
    if tag in _VOID:
        return Html(f"<{tag}{named}>")
    return Html(f"<{tag}{named}>{joined(children)}</{tag}>")


def joined(children: Iterable[object]) -> Html:
    """Return children one after the other; None is nothing."""
    return Html("".join(c if isinstance(c, Html) else escape(str(c)) for c in children if c is not None))


def table(caption: str, heads: Sequence[object], rows: Iterable[Sequence[object]], names: int = 1) -> Html:
    """Return a table that scrolls by itself where it is too wide; the first `names` columns are names."""
    named = (element("th", head, scope="col", class_="name") for head in heads[:names])
    top = element("tr", *named, *(element("th", head, scope="col") for head in heads[names:]))
    body = (
        element(
            "tr",
            *(element("th", cell, scope="row") for cell in row[:names]),
            *(element("td", cell) for cell in row[names:]),
        )
        for row in rows
    )
    whole = element(
        "table", element("caption", caption), element("thead", top), element("tbody", *body, Html("\n"))
    )
    return element("div", whole, class_="scroll", tabindex="0", role="region", **{"aria-label": caption})


def document(title: str, style: str, body: Html) -> str:
    """Return a whole page that needs nothing but itself."""
    head = element(
        "head",
        Html('<meta charset="utf-8">'),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        Html(f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'),
        element("title", title),
        element("style", Html(style)),
    )
    return f'<!DOCTYPE html>\n<html lang="en">{head}\n{element("body", body)}</html>\n'
