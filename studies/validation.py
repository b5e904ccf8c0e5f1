"""Validation of the exact plant: writes docs/validation.md and its figures, up to the part of studies/recorded.py.

    python studies/validation.py [--out DIR]

The problems are in tests/reference/validation.py; the tests assert the values of the document. Takes about a
minute on one core. Repeated runs write the same bytes.
"""

import argparse
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import validation_results as results
from flexneedle.figures import style
from reference import closed_forms, elastica
from reference import space_validation as in_space
from reference import validation as problems
from reference.cases import EI, FOUNDATION
from validation_figures import draw

RECORDED = "\n## Against recordings"
"""Beginning of the part that studies/recorded.py writes, and this script keeps."""
ROOT = Path(__file__).resolve().parents[1]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; the first column is text, the others are numbers."""
    lines = [head, ("---", *["---:"] * (len(head) - 1)), *rows]
    return "\n".join(f"|{'|'.join(line)}|" for line in lines)


def small(value: float) -> str:
    """Format with two digits, in exponential notation below 0.001."""
    if abs(value) >= 1e-3:
        return style.format_signed(value, ".2g")
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}".replace("-", "−")


def power(sizes: Sequence[float] | np.ndarray, errors: Sequence[float] | np.ndarray) -> str:
    """Return the fitted order as text."""
    return f"{problems.order(sizes, errors):.2f}"


def document(found: results.Found) -> str:
    """Return the text of docs/validation.md."""
    parts = [
        "# Validation",
        INTRODUCTION,
        summary(found),
        *needle(found),
        *model(found),
        *bevel(found),
        *energy(found),
        *solver(found),
        *refinement(found),
        *space(found.space),
    ]
    return "\n\n".join(wrapped(part) for part in parts) + "\n"


def wrapped(text: str) -> str:
    """Wrap prose to lines of 120 characters; headings, tables and images are unchanged."""
    if text.startswith(("#", "|", "!", "*")):
        return text
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


INTRODUCTION = (
    "`python studies/validation.py` (`make validation`) compares the needle of the virtual phantom (`--phantom exact`,"
    " [theory](theory.md), section 11) with closed forms, a second solver and the controller's model. It writes this"
    " page; the tests assert its values (`pytest tests/phantom`). The page verifies that the equations are solved"
    " correctly; the tissue law and contact rules that plant and model share are compared with"
    " [recorded insertions](#against-recordings) at the end."
)


def summary(found: results.Found) -> str:
    """Return the table of the main results."""
    finest = {load: errors[-1] for load, errors in found.cantilever.items()}
    rows = [
        (
            f"cantilever, PL²/EI = {load:g}: deflection over L",
            f"{problems.LOADS[load]:.4f}",
            f"{elastica.cantilever(load)[1] + errors[1]:.4f}",
        )
        for load, errors in finest.items()
    ]
    last = found.gaps[1][0.125][results.CUBIC]
    worst = max(abs(errors[-1]) for errors in found.curvature.values())
    moved = largest_gap(found)
    rows += [
        (
            "cantilever: order in the segment length",
            "2",
            power(1.0 / results.SEGMENTS, found.cantilever[5.0][:, 1]),
        ),
        ("buckling load over Euler load", "1", f"{found.buckling:.5f}"),
        (
            "difference from the controller's model: order in the slope",
            "3",
            power([gap.angle for gap in last], [gap.lateral for gap in last]),
        ),
        ("steady bevel curvature: relative error", "0", small(worst)),
        ("work over stored energy without cutting, minus 1", "0", small(moved)),
        ("insertion: share of the work neither stored nor dissipated", "0", small(abs(lost(found)))),
        ("second solver: largest lateral difference of tips (mm)", "0", small(found.second[-1, 1])),
        (
            "space: order of convergence to a second solver",
            "2",
            power(1.0 / np.array(in_space.SEGMENTS), np.max(found.space.solver, axis=0)),
        ),
        (
            "space: buckling moment of a twisted rod over Greenhill's",
            "1",
            f"{found.space.twist[0.0]:.3f}",
        ),
    ]
    return table(("check", "expected", "found"), rows)


def largest_gap(found: results.Found) -> float:
    """Return the largest difference of work over stored energy from 1 in moves without cutting."""
    return max(abs(done / stored - 1.0) for done, stored in found.moves.values())


def lost(found: results.Found) -> float:
    """Return the energy error of an insertion with friction and the finest step."""
    return found.balances[5.0][-1].gap


def needle(found: results.Found) -> list[str]:
    """Return the section on the rod alone."""
    rows = [
        (
            f"{load:g}",
            f"{elastica.cantilever(load)[1]:.6f}",
            *(small(value) for value in np.abs(errors[-1])),
        )
        for load, errors in found.cantilever.items()
    ]
    return [
        "## The needle alone",
        "A cantilever with a transverse dead load P at its end is compared with the elastica from elliptic integrals"
        f" (Bisshopp and Drucker 1945). Errors with {results.SEGMENTS[-1]} segments:",
        table(("PL²/EI", "elastica, y/L", "error x/L", "error y/L", "error θ (rad)"), rows),
        "![Bent cantilevers; error over the number of segments](images/validation-needle.png)",
    ]


def model(found: results.Found) -> list[str]:
    """Return the section on the controller's model."""
    one, two = found.gaps[1], found.gaps[2][0.125]
    rows = [
        (f"{a.angle:.4f}", small(a.lateral), f"{b.angle:.4f}", small(b.lateral))
        for a, b in list(zip(one[0.125], two, strict=True))[::2]
    ]
    last = one[0.125][results.CUBIC]
    slope = power([gap.angle for gap in last], [gap.lateral for gap in last])
    return [
        "## The controller's model at small angles",
        "Both formulations simulate the same insertion to 44.5 mm with guide motion and a flip. Bevel offset and guide"
        " motion are scaled together; segments are 0.125 mm, and the guide is as rigid as in the model. The table gives"
        " the largest slope of the tip and the largest distance between the tips:",
        table(
            ("slope (rad), one layer", "distance (mm)", "slope (rad), two layers", "distance (mm)"),
            rows,
        ),
        "![Distance over the slope, with the third power](images/validation-model.png)",
        "Mirrored commands give the mirror image, so the effect of finite rotations begins with the third power of the"
        f" slope. The fitted power from {last[-1].angle:.3f} to {last[0].angle:.3f} rad is {slope}. At smaller slopes"
        " the discretisation error dominates; at larger slopes higher powers contribute.",
    ]


def bevel(found: results.Found) -> list[str]:
    """Return the section on steady curvature."""
    rows = []
    for length, errors in found.curvature.items():
        expected = closed_forms.steady_curvature(0.01, length, FOUNDATION, EI)
        shares = (f"{style.format_signed(100.0 * error, '+.3f')} %" for error in errors)
        rows.append((f"{length:g}", f"{expected:.4e}".replace("e-0", "e−"), *shares))
    return [
        "## Steady curvature of the bevel",
        "Far from skin and base and at small strain the path is a circle with κ = F/(EIβ), where the spring force is"
        " reduced by the lateral slide of the tip ([theory](theory.md), eq. 10). Curvature over the last 60 mm of a"
        " path of 250 mm, 1/β = 10 mm, offset 0.01 mm:",
        table(
            (
                "bevel length (mm)",
                "κ (1/mm)",
                *(f"error, {r:g} mm segments" for r in results.RESOLUTIONS),
            ),
            rows,
        ),
    ]


def energy(found: results.Found) -> list[str]:
    """Return the section on energies."""
    moved = largest_gap(found)
    rows = [
        (f"{step:g}", *(small(balances[k].gap) for balances in found.balances.values()))
        for k, step in enumerate(results.STEPS)
    ]
    gaps = [balance.gap for balance in found.balances[0.0]]
    return [
        "## Energy",
        "Without cutting, energy is conserved: when base and guide move a bent needle at a depth of 28 mm without"
        " insertion, the relative difference between their work (trapezoidal rule, 40 steps) and the change of the"
        f" stored energy is at most {small(moved)}.",
        "In an insertion to 40 mm with guide motion and a flip, the work of base, guide and the tissue on the bevel is"
        " compared with the stored energy and the energy dissipated by friction. The relative error decreases with the"
        f" step, without friction at order {power(results.STEPS, gaps)}:",
        table(("step (mm)", *(f"friction {friction:g} mN/mm" for friction in found.balances)), rows),
    ]


def solver(found: results.Found) -> list[str]:
    """Return the section on the second solver."""
    rows = [
        (f"{h:g}", *(small(value) for value in gaps))
        for h, gaps in list(zip(results.ELEMENTS.tolist(), found.second, strict=True))[::2]
    ]
    orders = [power(results.ELEMENTS, column) for column in found.second.T]
    return [
        "## A second solver",
        "A second solver (`tests/reference/rods.py`) integrates the continuous rod from the tip to the base, from"
        " force equilibrium instead of minimum energy. The test moves all inputs in 48 steps with a retraction, two"
        " flips, two layers, varying stiffness, start errors, bend and guide clearance. Largest differences of the"
        " tips:",
        table(("segment (mm)", "x (mm)", "y (mm)", "θ (rad)"), [*rows, ("order", *orders)]),
        "θ converges at first order: the last segment has the rod's slope half a segment before the tip. With"
        f" ten times the default friction the tips differ by {small(found.rubbed[0])} mm; with half the step"
        f" by {small(found.rubbed[1])} mm, since friction acts along the shape of the needle before the step.",
    ]


def refinement(found: results.Found) -> list[str]:
    """Return the section on element, step and spacing."""
    key = {"element": "element_mm", "step": "step_mm", "spacing": "contact_spacing_mm"}
    rows = []
    for name, errors in found.refined.items():
        sizes = results.SIZES[name][:-1]
        (shipped,) = np.flatnonzero(sizes == problems.SHIPPED[name])
        rows.append((f"`{key[name]}`", f"{sizes[shipped]:g}", small(errors[shipped]), power(sizes, errors)))
    finest = ", ".join(f"{results.SIZES[name][-1]:g}" for name in results.SIZES)
    return [
        "## Refinement of an insertion",
        "An insertion to 44.5 mm with guide motion and a flip in the paper's phantom without imperfections. The"
        f" distance is measured from the tip with {finest} mm for element, step and spacing.",
        table(("key of `[phantom]`", "default (mm)", "distance (mm)", "order"), rows),
        "![Error over element, step and spacing; difference from the second solver](images/validation-insertion.png)",
    ]


def space(found: results.Space) -> list[str]:
    """Return the section on space."""
    gaps = np.max(found.solver, axis=0)
    rows = [
        ("rods", *(small(gap) for gap in gaps), power(1.0 / np.array(in_space.SEGMENTS), gaps)),
        (
            "helix",
            *(small(left) for left in found.helix),
            power(1.0 / np.array(in_space.HELIX_SEGMENTS), found.helix),
        ),
    ]
    buckling = " and at ".join(
        f"{factor:.3f} times this moment with {share:g} times Euler's load"
        for share, factor in found.twist.items()
    )
    counts = [f"{n}, {m} segments" for n, m in zip(in_space.SEGMENTS, in_space.HELIX_SEGMENTS, strict=True)]
    return [
        "## In space",
        "Rods of 100 mm with a natural bend, tilted and rolled at their base, carry a tip force in any direction;"
        " the table gives the largest distance (mm) to the tip from Kirchhoff's equations"
        " (`tests/reference/kirchhoff.py`). For a twisted helix under its wrench it gives the largest unbalanced moment"
        " per mm over EIκ².",
        table(("problem", *counts, "order"), rows),
        "A straight rod between two clamps, twisted by its base under an axial load, buckles at Greenhill's moment. The"
        f" plant buckles at {buckling}; its second clamp is stiff tissue, which moves by about half a millimetre.",
        "The roll of the tip lags behind the roll of the base by c l²/2GJ over the inserted length l, for a friction"
        f" couple c per mm, and by c l/GJ per mm of the free length: relative error {small(abs(found.lag))}.",
    ]


def write(found: results.Found, folder: Path) -> list[Path]:
    """Write validation.md and images/ to the folder and return the paths."""
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    page = folder / "validation.md"
    old = page.read_text(encoding="utf-8") if page.exists() else ""
    recorded = "".join(old.partition(RECORDED)[1:])
    page.write_text(document(found) + recorded, encoding="utf-8")
    return [page, *draw(found, images)]


def main() -> None:
    """Compute the results, print the summary and write the files."""
    parser = argparse.ArgumentParser(description="Validation of the exact plant.")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs", metavar="DIR", help="folder of validation.md"
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="compute the differences from the model with one element size; needs --out",
    )
    chosen = parser.parse_args()
    if chosen.quick and chosen.out == ROOT / "docs":
        parser.error(f"--quick: its page is no result: name a folder other than {chosen.out} with --out")
    found = results.compute(quick=chosen.quick)
    print(summary(found), end="\n\n")
    for path in write(found, chosen.out):
        print(path)


if __name__ == "__main__":
    main()
