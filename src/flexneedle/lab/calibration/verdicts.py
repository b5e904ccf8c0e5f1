"""Tables and verdict of a validation: errors by group, and the model against the best simple predictor."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.calibration.baselines import REGRESSION
from flexneedle.lab.calibration.comparison import MODEL, Errors
from flexneedle.types import Flags

_SHALLOW, _DEEP = 0.2, 0.45  # limits of groups by depth, as shares of the deepest step
_ROUND_MM = 5.0
NAMES = {
    MODEL: "model",
    "straight": "straight along the axis",
    "stays": "tip stays",
    "circle": "circle from the slope",
    "circle, no slope": "circle without slope",
    "mean path": "mean path",
    REGRESSION: "regression on guide motion",
}
"""Predictors by name, in words."""
PREDICTORS = tuple(NAMES)
_JOINED = {
    "better": "better than",
    "worse": "worse than",
    "not separable": "not separable from",
    "too few insertions": "with too few insertions to compare with",
}
_HEAD = {
    "better": "wins",
    "worse": "loses",
    "not separable": "neither wins nor loses",
    "too few insertions": "has too few insertions to tell",
}
_AHEAD = " mm ahead, "
_LEAST_MM = 1e-9
_DRAWS, _LEAST = 300, 3  # of insertions in a bootstrap; insertions that it needs
_COVERED = 0.90, 0.98
"""Coverage of intervals of 95 % that counts as right."""
GUIDED = "guided"
END = "to the end with the guide at rest"


@dataclass(frozen=True, eq=False)
class Row:
    """Errors (mm) of a group of predictions: number, median and 95 % by predictor, coverage of the model's intervals.

    ahead: 0 for the end of insertions.
    """

    group: str
    ahead: float
    count: int
    median: Mapping[str, float]
    most: Mapping[str, float]
    coverage: float

    @property
    def best(self) -> str:
        """The simple predictor with the smallest median that does not know the guide's motion ahead."""
        return min(
            (name for name in self.median if name not in (MODEL, REGRESSION)), key=self.median.__getitem__
        )

    @property
    def main(self) -> bool:
        """True for all predictions, guided ones, and the end."""
        return self.group in ("all", END) or self.group.startswith(GUIDED)

    def values(self) -> dict[str, Any]:
        """Return the row as plain values."""
        return vars(self) | {"median": dict(self.median), "most": dict(self.most)}


@dataclass(frozen=True)
class Comparison:
    """Median errors (mm) of the model and of a simple predictor, with an interval of 95 % of their ratio."""

    against: str
    ours: float
    theirs: float
    low: float
    high: float

    @property
    def word(self) -> str:
        """Return better, worse, "not separable" or "too few insertions"."""
        if self.high == np.inf:
            return "too few insertions"
        return "better" if self.high < 1.0 else "worse" if self.low > 1.0 else "not separable"

    @property
    def ratio(self) -> str:
        """The ratio of the medians with its interval as text."""
        value = f"ratio {self.ours / max(self.theirs, _LEAST_MM):.2f}"
        return value if self.high == np.inf else f"{value}, 95 %: {self.low:.2f} to {self.high:.2f}"

    @property
    def joined(self) -> str:
        """The word with its preposition."""
        return _JOINED[self.word]

    def __str__(self) -> str:
        return f"{self.joined} {NAMES[self.against]} ({self.theirs:.2f} mm, {self.ratio})"


@dataclass(frozen=True, eq=False)
class Verdict:
    """Comparisons of the model at a distance: with the best simple predictor, and with the regression."""

    row: Row
    simple: Comparison
    regression: Comparison

    @property
    def where(self) -> str:
        """Distance and group in words."""
        return self.row.group if self.row.ahead == 0.0 else f"{self.row.ahead:g}{_AHEAD}{self.row.group}"

    def values(self) -> dict[str, Any]:
        """Return the verdict as plain values; the interval of a ratio is null with too few insertions."""
        pairs = {
            "simple": self.simple,
            "regression": self.regression,
        }
        return {"predictions": self.where} | {
            key: vars(one) | {"word": one.word} for key, one in pairs.items()
        }

    def __str__(self) -> str:
        return f"{self.where}: median {self.row.median[MODEL]:.2f} mm, {self.simple}; {self.regression}"


def depth_limits(deepest: float) -> tuple[float, float]:
    """Return the limits (mm) of groups by depth: 20 and 45 mm for insertions to 100 mm."""
    unit = _ROUND_MM if deepest >= 10.0 * _ROUND_MM else 1.0
    shallow, deep = (round(share * deepest / unit) * unit for share in (_SHALLOW, _DEEP))
    return shallow, deep


def groups_of(errors: Errors, deepest: float) -> dict[str, Flags]:
    """Return which predictions (p,) are in each group by name."""
    shallow, deep = depth_limits(deepest)
    depth, guided = errors.depth, errors.guided
    groups = {
        "all": np.full(len(errors), True),
        GUIDED: guided,
        f"guided, to {deep:g} mm": guided & (depth <= deep),
        f"depth to {shallow:g} mm": depth <= shallow,
        f"depth {shallow:g} to {deep:g} mm": (depth > shallow) & (depth <= deep),
        f"depth from {deep:g} mm": depth > deep,
        "first half of a session": errors.place <= 0.5,
        "second half of a session": errors.place > 0.5,
    }
    names = dict.fromkeys(errors.session.tolist())
    return groups | {f"session {name}": errors.session == name for name in names if len(names) > 1}


def row_of(group: str, ahead: float, errors: Errors) -> Row:
    """Return the row of a group of predictions; at least one."""
    return Row(
        group,
        ahead,
        len(errors),
        {name: float(np.median(values)) for name, values in errors.size.items()},
        {name: float(np.quantile(values, 0.95)) for name, values in errors.size.items()},
        float(errors.inside.mean()),
    )


def rows_of(found: Mapping[float, Errors], deepest: float) -> Iterator[Row]:
    """Yield the rows of all groups and distances that have predictions, group by group."""
    groups = {ahead: groups_of(errors, deepest) for ahead, errors in found.items()}
    for group in dict.fromkeys(name for each in groups.values() for name in each):
        for ahead, errors in found.items():
            chosen = groups[ahead].get(group, np.zeros(len(errors), dtype=bool))
            if chosen.any():
                yield row_of(group, ahead, errors.select(chosen))


def judge(group: str, ahead: float, errors: Errors) -> Verdict:
    """Return the verdict on a group of predictions; at least one."""
    row = row_of(group, ahead, errors)
    return Verdict(row, _compare(row, errors, row.best), _compare(row, errors, REGRESSION))


def _compare(row: Row, errors: Errors, against: str) -> Comparison:
    ours, theirs, ends = errors.size[MODEL], errors.size[against], (0.0, np.inf)
    if len(np.unique(errors.insertion)) >= _LEAST:
        ends = bootstrap(
            errors.insertion,
            lambda drawn: float(np.median(ours[drawn])) / max(float(np.median(theirs[drawn])), _LEAST_MM),
        )
    return Comparison(against, row.median[MODEL], row.median[against], *ends)


def bootstrap(insertion: NDArray[Any], statistic: Callable[[NDArray[np.intp]], float]) -> tuple[float, float]:
    """Return the interval of 95 % of a statistic of rows, by bootstrap over the insertions (r,) of the rows."""
    rows = [np.flatnonzero(insertion == one) for one in np.unique(insertion)]
    random = np.random.default_rng(0)
    drawn = (random.integers(len(rows), size=len(rows)) for _ in range(_DRAWS))
    found = [statistic(np.concatenate([rows[k] for k in each])) for each in drawn]
    low, high = np.quantile(found, (0.025, 0.975)).tolist()
    return low, high


def headline(verdicts: Sequence[Verdict]) -> str:
    """Return in words where the model wins against predictors that do not know the guide's motion ahead."""
    places = {word: [each.where for each in verdicts if each.simple.word == word] for word in _HEAD}
    parts = [f"{_HEAD[word]} {_list(where)}" for word, where in places.items() if where]
    return f"Against predictors that do not know the guide's motion, the model {'; it '.join(parts)}."


def _list(places: Sequence[str]) -> str:
    """Return places in words, distances in a common group joined."""
    groups: dict[str, list[str]] = {}
    for place in places:
        distance, _, group = place.partition(_AHEAD)
        groups.setdefault(group, []).append(distance)
    return " and ".join(
        f"{_join(distances)}{_AHEAD}{group}" if group else _join(distances)
        for group, distances in groups.items()
    )


def _join(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def judge_coverage(rows: Sequence[Row]) -> str:
    """Return in words whether the intervals cover 95 %."""
    low, high = min(row.coverage for row in rows), max(row.coverage for row in rows)
    shares = (
        f"{100 * low:.0f} %"
        if round(100 * low) == round(100 * high)
        else f"{100 * low:.0f} to {100 * high:.0f} %"
    )
    word = "too narrow" if low < _COVERED[0] else "wider than needed" if high > _COVERED[1] else "right"
    return f"The model's intervals of 95 % cover {shares} of the readings: {word}."
