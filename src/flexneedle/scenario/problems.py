"""Problems of a scenario as one line each: key, value, rule."""

import json
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

from flexneedle.errors import make_printable
from flexneedle.scenario.alternatives import SHEAR, YOUNG
from flexneedle.scenario.dotted import split_key

_BROKEN = "broken_rules"
_LONGEST_VALUE = 60


class Problem(NamedTuple):
    """A broken rule. `key` is dotted or a path, relative to the section that checks; value None: a key not set."""

    key: str | tuple[str | int, ...]
    value: object
    rule: str


def refuse(problems: Iterable[Problem]) -> None:
    """Raise the problems, if any, from within a pydantic validator."""
    found = list(problems)
    if found:
        raise PydanticCustomError(_BROKEN, "rules are broken", {"problems": found})


def to_line(problem: Problem) -> str:
    """Return a problem as `key = value: rule`."""
    path = key_path(_path(problem.key)) or "scenario"
    shown = "" if problem.value is None else f" = {_format_value(problem.value)}"
    return make_printable(f"{path}{shown}: {problem.rule}")


def describe(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """Return one line `key = value: rule` for each problem, in the order of the schema."""
    return [to_line(problem) for problem in problems_of(error, model)]


def problems_of(error: ValidationError, model: type[BaseModel]) -> list[Problem]:
    """Return the problems of a section, in the order of the schema."""
    details = error.errors(include_url=False)
    inner = {detail["loc"][:depth] for detail in details for depth in range(len(detail["loc"]))}
    # pydantic also reports a list as too short when its items are refused: only the items are reported.
    reported = [d for d in details if not (d["type"] == "too_short" and d["loc"] in inner)]
    reported = [d for d in reported if not (d["type"] == "missing" and _is_misspelt(d["loc"], details))]
    return [problem for detail in reported for problem in _problems(detail, model)]


def key_path(loc: Sequence[str | int]) -> str:
    """Return a path as it is written in messages: `tissue[1].alpha`."""
    path = ""
    for part in loc:
        if isinstance(part, int):
            path += f"[{part}]"
        else:
            path += ("." if path else "") + (part if _is_bare(part) else json.dumps(part))
    return path


def _is_bare(key: str) -> bool:
    return key.isascii() and key.replace("-", "").isidentifier()


def _problems(detail: ErrorDetails, model: type[BaseModel]) -> list[Problem]:
    loc = detail["loc"]
    if detail["type"] == _BROKEN:
        found: list[Problem] = detail["ctx"]["problems"]
        return [each._replace(key=(*loc, *_path(each.key))) for each in found]
    if detail["type"] == "missing":
        return [Problem(loc, None, "missing")]
    if detail["type"] == "extra_forbidden":
        return [Problem(loc, detail["input"], _unknown(loc, model))]
    rule = _rule(detail)
    if detail["type"] == "tuple_type" and isinstance(detail["input"], Mapping) and _section_at(loc, model):
        rule += f": write [[{'.'.join(map(str, loc))}]]"
    return [Problem(loc, detail["input"], rule)]


def _is_misspelt(missing: tuple[int | str, ...], details: Sequence[ErrorDetails]) -> bool:
    """Return whether an unknown key of the same table resembles a missing one, so that one line is enough."""
    unknown = (d["loc"] for d in details if d["type"] == "extra_forbidden" and d["loc"][:-1] == missing[:-1])
    valid = [SHEAR, YOUNG] if missing[-1] == SHEAR else [str(missing[-1])]
    return any(get_close_matches(str(loc[-1]), valid, n=1) for loc in unknown)


def _path(key: str | tuple[str | int, ...]) -> Sequence[str | int]:
    return split_key(key) if isinstance(key, str) else key


def _format_value(value: object) -> str:
    """Return a value in one short line, much as TOML writes it."""
    if isinstance(value, Mapping):
        text = "{…}"
    elif isinstance(value, bool | str):
        text = json.dumps(value, ensure_ascii=False)
    elif isinstance(value, list | tuple):
        text = (
            "[" + ", ".join(_format_value(item) for item in value[:5]) + (", …]" if len(value) > 5 else "]")
        )
    elif isinstance(value, int) and value.bit_length() > 200:
        text = "a very large number"
    else:
        text = str(value)
    return text if len(text) <= _LONGEST_VALUE else text[:_LONGEST_VALUE] + "…"


def _rule(detail: ErrorDetails) -> str:
    kind, context = detail["type"], detail.get("ctx", {})
    match kind:
        case "greater_than":
            return f"must be above {context['gt']:g}"
        case "greater_than_equal":
            return f"must be at least {context['ge']:g}"
        case "less_than":
            return f"must be below {context['lt']:g}"
        case "less_than_equal":
            return f"must be at most {context['le']:g}"
        case "literal_error":
            return f"must be one of {context['expected'].replace(' or ', ', ').replace(chr(39), '')}"
        case "string_too_long":
            return f"must have at most {context['max_length']} characters"
        case "too_short":
            return f"must have at least {context['min_length']} entries"
        case "too_long" if context["max_length"] != 2:
            return f"must have at most {context['max_length']} entries"
        case "too_long":
            return "must be two numbers, low and high"
        case "value_error":
            return str(context["error"])
    return _TYPE_RULES.get(kind, detail["msg"])


_TYPE_RULES = {
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be text in quotes",
    "tuple_type": "must be a list",
    "list_type": "must be a list",
    "model_type": "must be a table",
}


def unknown_key(key: str, valid: Sequence[str]) -> str:
    """Return the rule that an unknown key breaks, with the closest valid key and the list of valid keys."""
    close = get_close_matches(key, valid, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    if close and close[0] in (SHEAR, YOUNG) and SHEAR in valid:  # a factor of 3
        hint = f"did you mean {SHEAR} (μ) or {YOUNG} (E = 3μ)? "
    return f"unknown key; {hint}valid keys: {', '.join(valid)}"


def _unknown(loc: tuple[int | str, ...], model: type[BaseModel]) -> str:
    section = _section_at(loc[:-1], model)
    valid = list(section.model_fields) if section else []
    return unknown_key(str(loc[-1]), [*valid, *([YOUNG] if SHEAR in valid else [])])


def _section_at(loc: Sequence[str | int], model: type[BaseModel]) -> type[BaseModel] | None:
    """Return the model that describes the table at a path."""
    section: type[BaseModel] | None = model
    named = False  # whether the next part is a name that the user has given to a section
    for part in loc:
        if section and isinstance(part, str) and not named:
            annotation = section.model_fields[part].annotation
            section, named = _model_in(annotation), get_origin(annotation) is dict
        else:
            named = False
    return section


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_model_in, get_args(annotation))), None)
