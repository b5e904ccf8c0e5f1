"""The parts of a validation: which scenario predicts which insertions, and which others train its nuisances."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from flexneedle.errors import InputError
from flexneedle.lab.calibration.calibration import Calibration, calibrate
from flexneedle.lab.calibration.files import read_record
from flexneedle.lab.calibration.session import Session
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario

Key = tuple[str, str, str]


class Fold(NamedTuple):
    """Insertions that are predicted, the scenario that predicts them, and insertions for all that it does not hold.

    drift: change of ln of the moduli from an insertion of a session to the next.
    """

    scenario: Scenario
    training: Session
    test: Session
    drift: float = 0.0


class Split(NamedTuple):
    """The folds of a validation, and a sentence that states who trains and who tests."""

    folds: tuple[Fold, ...]
    sentence: str


@dataclass(frozen=True, eq=False)
class _Source:
    """A scenario with what is known of its fit: insertions, and a function that repeats the fit."""

    scenario: Scenario
    drift: float = 0.0
    used: frozenset[Key] = frozenset()
    training: Session | None = None  # recordings of the fit, where they are at hand
    again: Callable[[Session], Calibration] | None = None


def split(given: Calibration | Scenario | str | Path, session: Session, training: Session | None) -> Split:
    """Return the folds of a validation. No insertion is in both parts of a fold.

    Raises InputError if no insertion is left to train or to test.
    """
    source = _source_of(given)
    if training is not None:
        return _single(source, training, session, "given")
    fitted = source.training or _those(session, source.used)
    if not fitted.recordings:
        why = "The scenario was not fitted to these insertions: each half trains the rest of the model for the other"
        return _halves(replace(source, again=None), session, why)
    if source.again is not None and all(key in source.used for key in _keys(session)):
        why = f"All {len(session.recordings)} insertions were used in the fit: the fit was repeated on each half"
        return _halves(source, session, f"{why}, and each half predicts the other")
    return _single(source, fitted, session, "of the fit")


def _source_of(given: Calibration | Scenario | str | Path) -> _Source:
    if isinstance(given, Calibration):
        names = tuple(dict.fromkeys(each.name for each in given.parameters))
        used = frozenset(_keys(given.session))
        return _Source(
            given.scenario,
            given.trial.drift,
            used,
            given.session,
            lambda part: calibrate(given.start, part, names),
        )
    scenario = load_scenario(given)
    record = None
    if not isinstance(given, Scenario) and Path(given).is_file():
        record = read_record(Path(given))
    return _Source(scenario) if record is None else _recorded(scenario, record)


def _recorded(scenario: Scenario, record: dict[str, Any]) -> _Source:
    """Return the source of a scenario with a record of its fit. Raises InputError for a record without a key."""
    try:
        start, names = (
            Scenario.from_values(record["start"], "record of the calibration"),
            tuple(record["fit"]),
        )
        used = frozenset(
            (str(session), str(name), str(steps)) for session, name, steps in record["insertions"]
        )
        fitted = [each for label, each in record["parameters"].items() if label.startswith("drift")]
        drift = sum(each["value"] for each in fitted if each["identified"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"record of the calibration: has no valid {error}") from None
    return _Source(scenario, drift, used, None, lambda part: calibrate(start, part, names))


def _keys(session: Session) -> list[Key]:
    return [one.key for one in session.recordings]


def _those(session: Session, keys: frozenset[Key]) -> Session:
    return session.select([key in keys for key in _keys(session)])


def _single(source: _Source, training: Session, session: Session, which: str) -> Split:
    used = frozenset(_keys(training))
    test = session.select([key not in used for key in _keys(session)])
    _check(training, test)
    counts = len(training.recordings), len(test.recordings)
    sentence = f"{counts[0]} insertions {which} train, {counts[1]} others test"
    return Split((Fold(source.scenario, training, test, source.drift),), sentence)


def _halves(source: _Source, session: Session, why: str) -> Split:
    halves = session.even, session.odd
    _check(*halves)
    folds, problems = [], dict[str, None]()
    for training, test in (halves, halves[::-1]):
        fitted = source
        if source.again is not None:
            again = source.again(training)
            fitted = _source_of(again)
            problems |= dict.fromkeys(again.problems)
        folds.append(Fold(fitted.scenario, training, test, fitted.drift))
    warned = "".join(f"; {problem}" for problem in problems)
    return Split(tuple(folds), f"{why} (even and odd insertions of each session){warned}")


def _check(training: Session, test: Session) -> None:
    if not training.recordings or not test.recordings:
        lacking = "test" if training.recordings else "train"
        raise InputError(
            f"session: no insertion is left to {lacking}: validation needs at least two in a session"
        )
    if training.axes != test.axes:
        raise InputError(f"training: has {training.axes} lateral axes, the session {test.axes}")


def sessions_of(fold: Fold) -> Iterator[Fold]:
    """Yield a fold for each session that is tested; one without training insertions is trained by all of them."""
    for name in fold.test.names:
        if name in fold.training.names:
            training = fold.training.of(name)
        else:
            alike = tuple(replace(one, session=name) for one in fold.training.recordings)
            training = replace(fold.training, recordings=alike)
        yield fold._replace(training=training, test=fold.test.of(name))
