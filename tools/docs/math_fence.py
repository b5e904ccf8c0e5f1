"""Fenced blocks of the language `math` as MathML, which browsers draw themselves: no script, no font, no network."""

from typing import Any

from latex2mathml.converter import convert


def mathml(source: str, _language: str, css_class: str, *_: Any, **__: Any) -> str:
    """Return one or several LaTeX formulas, a line each (blank lines separate), as HTML.

    A formula may end with `\\tag{n}`, its number, which is drawn at the right.
    """
    formulas = [" ".join(part.split()) for part in source.split("\n\n")]
    return "".join(f'<div class="{css_class}">{_formula(formula)}</div>' for formula in formulas if formula)


def _formula(latex: str) -> str:
    body, _, number = latex.partition(r"\tag{")
    drawn = convert(body.strip(), display="block")
    return drawn + (f'<span class="number">({number.rstrip("}")})</span>' if number else "")
