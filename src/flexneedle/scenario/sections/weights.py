"""Weights of a cost as settings, and cost terms of the user."""

import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from inspect import Parameter, isroutine, signature
from typing import Annotated, Any, TypeVar, cast

from pydantic import AfterValidator, BeforeValidator, Field, create_model, model_validator

from flexneedle.costs.weighted_sum import Cost, TermFunction, Weight
from flexneedle.errors import InputError, ScenarioWarning
from flexneedle.plugins import function_rule, is_own, load_part
from flexneedle.scenario.sections.fields import NonNegative, Section

_Settings = TypeVar("_Settings", bound=Section)


def name_functions(given: Any) -> Any:
    """Return a value with `module:NAME` in place of each function, in tables and lists too."""
    if isinstance(given, Mapping):
        return {key: name_functions(value) for key, value in given.items()}
    if isinstance(given, list | tuple):
        return type(given)(map(name_functions, given))
    return f"{given.__module__}:{given.__qualname__}" if isroutine(given) else given


def drop_old_keys(values: Any, section: str, old: Collection[str], why: str) -> Any:
    """Return the values of a section without keys of an earlier version; a ScenarioWarning names them, for one version.

    why: the reason, with the keys to use instead.
    """
    if not isinstance(values, Mapping):
        return values
    if found := [key for key in values if key in old]:
        keys = ", ".join(f"{section}.{key}" for key in found)
        warnings.warn(f"{keys}: not used, since {why}", ScenarioWarning, stacklevel=3)
    return {key: value for key, value in values.items() if key not in old}


def _resolve(name: str) -> TermFunction:
    """Return the function of a name `module:NAME`. Raises InputError with the rule that is broken."""
    if not is_own(name):
        raise InputError("must be module:NAME, such as mymodule:bending")
    function: Any = load_part(name, ())
    rule = function_rule(function, "trajectories")
    required = [each.name for each in _parameters(function) if each.default is Parameter.empty]
    if rule and required[1:] != ["target"]:
        raise InputError(rule.replace("(trajectories)", "(trajectories) or (trajectories, target)"))
    return cast(TermFunction, function)


def _parameters(function: object) -> Iterable[Parameter]:
    return signature(function).parameters.values() if callable(function) else ()


def _check_name(name: str) -> str:
    try:
        _resolve(name)
    except InputError as error:
        raise ValueError(str(error)) from None
    return name


def _choose(advice: str) -> Any:
    return Field(json_schema_extra={"choose": advice})


class OwnTerm(Section):
    """One `[[terms]]`: a custom cost term."""

    term: Annotated[
        str,
        BeforeValidator(name_functions),
        AfterValidator(_check_name),
        _choose("a function in a module of the current directory or of a package."),
    ]
    """Function of `trajectories`, or of `trajectories` and `target`, as `module:NAME`."""
    weight: Annotated[NonNegative, _choose("by the term's share of the printed cost.")]
    """Weight of its values in the cost."""

    @property
    def function(self) -> TermFunction:
        """The function."""
        return _resolve(self.term)


OwnTerms = Annotated[tuple[OwnTerm, ...] | None, Field(strict=False, max_length=100)]


def _field(weight: Weight) -> Any:
    extra: dict[str, Any] = {"unit": weight.unit, "choose": weight.choose}
    return Field(default=weight.default, description=weight.about, json_schema_extra=extra)


def with_weights(cost: Cost, section: str) -> Callable[[type[_Settings]], type[_Settings]]:
    """Return a decorator of the settings of a section that adds a key for each weight of a cost, and `terms`."""

    def drop_own_terms(values: Any) -> Any:
        unit = ", with weights in mm" if section == "plan" else ""
        why = f"custom terms are listed in [[{section}.terms]] now{unit}"
        return drop_old_keys(values, section, ("own_terms",), why)

    def add(settings: type[_Settings]) -> type[_Settings]:
        fields: dict[str, Any] = {weight.key: (NonNegative, _field(weight)) for weight in cost.settings()}
        fields["terms"] = (OwnTerms, Field(default=None, description="Further terms of the cost."))
        dropping: Any = {"drop_own_terms": model_validator(mode="before")(drop_own_terms)}
        return create_model(
            settings.__name__,
            __base__=settings,
            __module__=settings.__module__,
            __doc__=settings.__doc__,
            __validators__=dropping,
            **fields,
        )

    return add
