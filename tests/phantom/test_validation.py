"""docs/validation.md agrees with studies/validation.py, whose output is reproducible."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import validation as script
import validation_results as results
from reference import space_validation as in_space
from reference import validation as problems
from reference.rods import Bench

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "validation.md"
NUMBER = re.compile(r"[+−-]?\d+(?:\.\d+)?(?:e[−-]?\d+)?")


@pytest.fixture(scope="module")
def made_up():
    """Synthetic results."""
    angles = 0.05 * np.array(results.SCALES)
    gaps = [problems.Gap(float(a), float(a**3), float(a**3), -1e-3) for a in angles]
    balance = problems.Balance(4.0, 0.25, -0.05, needle=0.15, tissue=0.05, spring=0.0, friction=3.999)
    bench = Bench(segments=8).loaded(y=0.1)
    falling = {name: 1e-4 * sizes[:-1] ** 2 for name, sizes in results.SIZES.items()}
    return results.Found(
        cantilever={load: np.outer(results.SEGMENTS**-2.0, [1.0, 2.0, 3.0]) for load in problems.LOADS},
        shapes=dict.fromkeys(problems.LOADS, bench.nodes[:, :2] / 100.0),
        buckling=0.999,
        gaps={layers: dict.fromkeys(results.MESHES, gaps) for layers in (1, 2)},
        curvature={length: [0.01, 0.002, 5e-4] for length in results.BEVELS},
        moves=dict.fromkeys(problems.MOVES, (1.0, 0.999)),
        balances={
            friction: [replace(balance, base=4.0 + 0.01 * step) for step in results.STEPS]
            for friction in (0.0, 5.0)
        },
        second=np.outer(results.ELEMENTS**2, [1e-6, 1e-4, 1e-5]),
        rubbed=[2e-3, 1e-3],
        refined=falling,
        space=results.Space(
            [1e-3 * np.array([16.0, 4.0, 1.0])],
            [1e-4, 2.5e-5, 6e-6],
            dict.fromkeys(in_space.SHARES, 0.99),
            1e-12,
        ),
    )


def numbers(text):
    """Return all numbers in a text, in order."""
    return [float(found.replace("−", "-")) for found in NUMBER.findall(text)]


def assert_same(found, page):
    """Assert equal words and, since they depend on the processor, numbers to two digits; none below 1e-7."""
    assert NUMBER.sub("#", found) == NUMBER.sub("#", page)
    np.testing.assert_allclose(numbers(found), numbers(page), rtol=0.06, atol=1e-7)


def section(text, name):
    """Return the part of a page below a heading."""
    return next(part for part in text.split("\n## ") if part.startswith(name))


def test_the_page_has_the_cantilevers_that_the_script_computes():
    beams = {load: results.cantilevers(load) for load in problems.LOADS}
    found = SimpleNamespace(
        cantilever={load: errors for load, (errors, _) in beams.items()},
        buckling=problems.buckling_factor(64),
    )
    text = "\n\n".join(script.wrapped(part) for part in script.needle(found))
    assert_same(
        text.removeprefix("## ").strip(), section(PAGE.read_text(encoding="utf-8"), "The needle").strip()
    )


@pytest.mark.long
def test_the_page_has_the_energies_that_the_script_computes():
    found = SimpleNamespace(
        moves={name: problems.energy_balance(name, 40) for name in problems.MOVES},
        balances={
            f: [problems.insertion_balance(step, friction=f) for step in results.STEPS] for f in (0.0, 5.0)
        },
    )
    text = "\n\n".join(script.wrapped(part) for part in script.energy(found))
    assert_same(text.removeprefix("## ").strip(), section(PAGE.read_text(encoding="utf-8"), "Energy").strip())


@pytest.mark.slow
def test_the_page_is_what_the_script_writes():
    text = PAGE.read_text(encoding="utf-8").partition(script.RECORDED)[0]
    assert_same(script.document(results.compute()), text)


def test_the_summary_has_computed_deflections_beside_the_published_ones(made_up):
    lines = script.summary(made_up).splitlines()[2:5]
    assert [line.split("|")[2].strip() for line in lines] == ["0.3017", "0.4935", "0.7138"]
    off = made_up.cantilever[1.0][-1, 1]
    assert numbers(lines[0].split("|")[3])[0] == pytest.approx(0.30172 + off, abs=6e-5)


@pytest.mark.long
def test_same_results_same_bytes(made_up, tmp_path):
    """For page and pictures."""
    one, other = (script.write(made_up, tmp_path / name) for name in ("one", "other"))
    assert [path.name for path in one] == [
        "validation.md",
        *(
            f"validation-{name}.{kind}"
            for name in ("needle", "model", "insertion")
            for kind in ("png", "svg")
        ),
    ]
    for first, second in zip(one, other, strict=True):
        assert first.read_bytes() == second.read_bytes()
    page = one[0].read_text(encoding="utf-8")
    assert max(len(line) for line in page.splitlines() if not line.startswith(("|", "!"))) <= 120
    for image in re.findall(r"\]\((images/.*?)\)", page):
        assert (tmp_path / "one" / image).stat().st_size > 5_000
        assert (ROOT / "docs" / image).is_file()


def test_orders_and_small_numbers_are_readable():
    assert script.power([1.0, 2.0, 4.0], [3.0, 12.0, 48.0]) == "2.00"
    assert [script.small(value) for value in (0.0123, -0.5, 1.234e-5, -6e-12)] == [
        "0.012",
        "−0.5",
        "1.2e−5",
        "−6.0e−12",
    ]
