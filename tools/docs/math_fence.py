"""Fenced blocks of the language `math` as SVG: the same in every browser, without script, font or network."""

from html import escape
from typing import Any

import ziamath

SIZE_PX = 18
ziamath.config.precision = 2


def svg(source: str, _language: str, css_class: str, *_: Any, **__: Any) -> str:
    """Return one LaTeX formula as HTML, with the number of a `\\tag{n}` at its end at the right."""
    formula, _, number = source.partition(r"\tag{")
    drawn = ziamath.Latex(" ".join(formula.split()), size=SIZE_PX, color="currentColor").svg()
    label = f'<span class="number">({number.strip().rstrip("}")})</span>' if number else ""
    return f'<div class="{css_class}" role="img" aria-label="{escape(formula.strip())}">{drawn}{label}</div>'
