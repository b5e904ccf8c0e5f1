"""Validation of the exact plant: writes docs/validation.md and its figures.

    python studies/validation.py [--out DIR]

The problems are those of tests/reference/validation.py; the tests assert the values of the document. Takes about a
minute on one core. Repeated runs write the same bytes.
"""

import argparse
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from flexneedle.figures import style
from reference import closed_forms, elastica
from reference import space_validation as in_space
from reference import validation as problems
from reference.cases import EI, FOUNDATION
from validation_figures import draw

ROOT = Path(__file__).resolve().parents[1]
COMMAND = "*`python studies/validation.py`, or `make validation`*"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; the first column is text, the others are numbers."""
    lines = [head, ("---", *["---:"] * (len(head) - 1)), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def small(value: float) -> str:
    """Format with two digits, in exponential notation below 0.001."""
    if abs(value) >= 1e-3:
        return style.signed(value, ".2g")
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}".replace("-", "−")


def power(sizes: Sequence[float] | np.ndarray, errors: Sequence[float] | np.ndarray) -> str:
    """Return the fitted order as text."""
    return f"{problems.order(sizes, errors):.2f}"


def document(found: problems.Found) -> str:
    """Return the text of docs/validation.md."""
    parts = [
        "# Validation of the exact plant",
        INTRODUCTION,
        summary(found),
        COMMAND,
        *needle(found),
        *model(found),
        *bevel(found),
        *energy(found),
        *solver(found),
        *refinement(found),
        *space(found.space),
        "## What this does not show",
        LIMITS,
    ]
    return "\n\n".join(wrapped(part) for part in parts) + "\n"


def wrapped(text: str) -> str:
    """Wrap prose to lines of 120 characters; headings, tables and images are unchanged."""
    if text.startswith(("#", "|", "!", "*")):
        return text
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


INTRODUCTION = (
    "The needle of the virtual phantom (`--phantom exact`, [theory.md](theory.md) section 11) is compared with closed"
    " forms, a second solver and the controller's model. A script computes every value of this page and draws the"
    " figures; the tests assert them (`pytest tests/phantom`). The page verifies the solution of the equations; it"
    " does not validate the tissue model."
)
LIMITS = (
    "The exact plant and the controller's model share the tissue law (1), the springs normal to the needle and the rule"
    " of the bevel's rest point, so this page cannot validate those: only an experiment can. They differ in kinematics,"
    " mesh, position and direction of the tissue forces, imperfections, and the solver."
)


def summary(found: problems.Found) -> str:
    """Return the table of the main results."""
    finest = {load: errors[-1] for load, errors in found.cantilever.items()}
    rows = [
        (
            f"cantilever, PL²/EI = {load:g}: tip deflection over L",
            f"{problems.LOADS[load]:.4f}",
            f"{elastica.cantilever(load)[1] + errors[1]:.4f}",
        )
        for load, errors in finest.items()
    ]
    last = found.gaps[1][0.125][problems.CUBIC]
    worst = max(abs(errors[-1]) for errors in found.curvature.values())
    moved = max(abs(done / stored - 1.0) for done, stored in found.moves.values())
    rows += [
        (
            "cantilever: order of convergence in the segment length",
            "2",
            power(1.0 / problems.SEGMENTS, found.cantilever[5.0][:, 1]),
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
        ("second solver: largest lateral difference of the tips (mm)", "0", small(found.second[-1, 1])),
        (
            "in space: order of convergence to a second solver",
            "2",
            power(1.0 / np.array(in_space.SEGMENTS), np.max(found.space.solver, axis=0)),
        ),
        (
            "in space: moment that buckles a twisted rod over Greenhill's",
            "1",
            f"{found.space.twist[0.0]:.3f}",
        ),
    ]
    return table(("check", "expected", "found"), rows)


def lost(found: problems.Found) -> float:
    """Return the energy error of an insertion with friction and the finest step."""
    return found.balances[5.0][-1].gap


def needle(found: problems.Found) -> list[str]:
    """Section on the rod alone."""
    rows = []
    for load, errors in found.cantilever.items():
        expected, orders = (
            elastica.cantilever(load),
            [power(1.0 / problems.SEGMENTS, column) for column in errors.T],
        )
        rows.append(
            (
                f"{load:g}",
                f"{problems.LOADS[load]:.4f}",
                f"{expected[1]:.6f}",
                f"{expected[1] + errors[-1, 1]:.6f}",
                *(small(value) for value in np.abs(errors[-1])),
                ", ".join(orders),
            )
        )
    head = ("PL²/EI", "table, y/L", "elastica, y/L", f"plant, {problems.SEGMENTS[-1]} segments")
    return [
        "## The needle alone",
        "A cantilever with a transverse dead load P at its end, compared with the elastica by elliptic integrals"
        " (Bisshopp and Drucker 1945) and with published tables of four digits. The discrete rod converges with second"
        " order.",
        table((*head, "error x/L", "error y/L", "error θ (rad)", "orders x, y, θ"), rows),
        "![Bent cantilevers with the tips of the elastica, and the error over the number of segments]"
        "(images/validation-needle.png)",
        COMMAND,
        f"A straight column of 64 segments buckles at {found.buckling:.5f} times the Euler load π²EI/4L².",
    ]


def model(found: problems.Found) -> list[str]:
    """Section on the controller's model."""
    one, two = found.gaps[1], found.gaps[2][0.125]
    rows = [
        (
            f"{fine.angle:.4f}",
            *(small(one[h][k].lateral) for h in problems.MESHES),
            small(fine.energy),
            f"{two[k].angle:.4f}",
            small(two[k].lateral),
        )
        for k, fine in enumerate(one[0.125])
    ]
    last = one[0.125][problems.CUBIC]
    slope = power([gap.angle for gap in last], [gap.lateral for gap in last])
    meshes = [f"distance (mm), segments of {h:g} mm" for h in problems.MESHES]
    return [
        "## The controller's model at small angles",
        "The same insertion to 44.5 mm with guide motion and a flip in both formulations, with bevel offset and guide"
        " motion scaled together: the table gives the largest distance between the two tips and the largest slope of"
        " the tip. The contact spacing equals the segment length; steps are half as long. Mirrored commands give the"
        " mirror image, so the effect of finite rotations starts with the third power of the slope.",
        f"With the finest mesh and one layer, the fitted power from {last[-1].angle:.3f} to {last[0].angle:.3f} rad is"
        f" {slope}. At smaller slopes the discretisation error remains, in proportion to the slope; at larger ones"
        " higher powers contribute. Results with two layers are similar but less smooth, since single contact points"
        " are in a different layer than the model's. The guide is as rigid as the model's here (1e5 N/mm instead of the"
        " phantom's 1e3).",
        table(
            (
                "slope (rad), one layer",
                *meshes,
                "tissue energy, relative difference",
                "slope (rad), two layers",
                "distance (mm), segments of 0.125 mm",
            ),
            rows,
        ),
        "![Distance between the two formulations over the slope, with the third power](images/validation-model.png)",
        COMMAND,
    ]


def bevel(found: problems.Found) -> list[str]:
    """Section on steady curvature."""
    rows = []
    for length, errors in found.curvature.items():
        expected = closed_forms.steady_curvature(0.01, length, FOUNDATION, EI)
        shares = (f"{style.signed(100.0 * error, '+.3f')} %" for error in errors)
        rows.append((f"{length:g}", f"{expected:.4e}".replace("e-0", "e−"), *shares))
    return [
        "## Steady curvature of the bevel",
        "Far from skin and base and at small strain the path is a circle, κ = F/(EIβ), with the spring force reduced by"
        " the lateral slide of the tip ([theory.md](theory.md) eq. 10). Needle with 1/β = 10 mm, depth 250 mm, offset"
        " 0.01 mm; curvature over the last 60 mm.",
        table(
            (
                "bevel length (mm)",
                "κ (1/mm)",
                *(f"error, spacing and segments of {r:g} mm" for r in problems.RESOLUTIONS),
            ),
            rows,
        ),
        COMMAND,
    ]


def energy(found: problems.Found) -> list[str]:
    """Section on energies."""
    moved = [
        (name, style.signed(done, ".6f"), style.signed(stored, ".6f"), small(done / stored - 1.0))
        for name, (done, stored) in found.moves.items()
    ]
    rows = [
        (
            f"{step:g}",
            f"{friction:g}",
            *(f"{style.signed(value, '.5f')}" for value in (b.base, b.guide, b.bevel)),
            *(f"{value:.5f}" for value in (b.needle, b.tissue + b.spring, b.friction)),
            small(b.gap),
        )
        for friction, balances in found.balances.items()
        for step, b in zip(problems.STEPS, balances, strict=True)
    ]
    gaps = [balance.gap for balance in found.balances[0.0]]
    return [
        "## Energy",
        "Without cutting, energy is conserved: work of base and guide (trapezoidal rule, 40 steps) and change of the"
        " stored energy (mJ) for a bent needle at a depth of 28 mm that is moved without insertion.",
        table(("motion", "work", "stored", "work/stored − 1"), moved),
        COMMAND,
        "An insertion to 40 mm with guide motion and a flip: work of base, guide and the tissue on the bevel (negative"
        " if the tip moves against its force), compared with the energy stored in needle, tissue and guide and the"
        " energy dissipated by friction (mJ). The relative energy error decreases with the step, without friction with"
        f" the power {power(problems.STEPS, gaps)}.",
        table(
            (
                *("step (mm)", "friction (mN/mm)", "base", "guide", "bevel"),
                *("needle", "tissue and guide", "friction", "relative error"),
            ),
            rows,
        ),
        COMMAND,
    ]


def solver(found: problems.Found) -> list[str]:
    """Section on the second solver."""
    rows = [
        (f"{h:g}", *(small(value) for value in gaps))
        for h, gaps in zip(problems.ELEMENTS.tolist(), found.second, strict=True)
    ]
    orders = [power(problems.ELEMENTS, column) for column in found.second.T]
    return [
        "## A second solver",
        "`Shooting` in `tests/reference/rods.py` integrates the continuous rod from the tip to the base, with"
        " equilibrium of forces instead of minimal energy, and solves for the tip pose that satisfies the clamp"
        " condition. The test has 48 steps of all inputs with a retraction, two flips, two layers, varying stiffness,"
        " start errors, bend and guide clearance. Largest differences of the tip:",
        table(("segment (mm)", "x (mm)", "y (mm)", "θ (rad)"), [*rows, ("order", *orders)]),
        "θ converges with first order, since the slope of the last segment is that half a segment before the tip and"
        f" the natural bend extends to the tip: {small(found.second[2, 2])} rad with segments of 0.5 mm. With ten times"
        f" the default friction the tips differ by {small(found.rubbed[0])} mm, and by {small(found.rubbed[1])} mm with"
        " half the step: friction acts along the needle as it was before the step.",
        COMMAND,
    ]


def refinement(found: problems.Found) -> list[str]:
    """Section on element, step and spacing."""
    key = {"element": "element_mm", "step": "step_mm", "spacing": "contact_spacing_mm"}
    rows = [
        (
            f"`{key[name]}`",
            f"{size:g}",
            small(error),
            "default" if size == problems.SHIPPED[name] else "",
        )
        for name, errors in found.refined.items()
        for size, error in zip(problems.SIZES[name].tolist(), errors, strict=False)
    ]
    finest = ", ".join(f"{problems.SIZES[name][-1]:g}" for name in problems.SIZES)
    return [
        "## Refinement of an insertion",
        "Tip after 44.5 mm with guide motion and a flip in the paper's phantom without imperfections: distance from the"
        f" result with {finest} mm for element, step and spacing. The errors are not smooth, since single channel"
        " points change their segment or layer or are cut one step later.",
        table(("key of `[phantom]`", "mm", "distance (mm)", ""), rows),
        f"Orders: element {power(problems.SIZES['element'][:-1], found.refined['element'])}, step"
        f" {power(problems.SIZES['step'][:-1], found.refined['step'])}, spacing"
        f" {power(problems.SIZES['spacing'][:-1], found.refined['spacing'])}.",
        "![Error over element, step and spacing; difference from the second solver over the element length]"
        "(images/validation-insertion.png)",
        COMMAND,
    ]


def space(found: in_space.Space) -> list[str]:
    """Section on space."""
    sizes = 1.0 / np.array(in_space.SEGMENTS)
    rows = [
        (f"rod {k}", *(small(gap) for gap in gaps), power(sizes, gaps))
        for k, gaps in enumerate(found.solver, 1)
    ]
    rows.append(
        (
            "helix",
            *(small(left) for left in found.helix),
            power(1.0 / np.array(in_space.HELIX_SEGMENTS), found.helix),
        )
    )
    buckling = [
        (
            f"{share:g}",
            f"{elastica.twisted_buckling_moment(1.0, 1.0, share * 4.0 * np.pi**2):.4f}",
            f"{factor:.3f}",
        )
        for share, factor in found.twist.items()
    ]
    counts = [f"{n}, {m} segments" for n, m in zip(in_space.SEGMENTS, in_space.HELIX_SEGMENTS, strict=True)]
    return [
        "## In space",
        "The same kernel in the plane is what its planar predecessor was: tips within 1e-6 mm over random insertions"
        " with all inputs, z exactly 0 (`pytest tests/phantom/test_rod_plane.py`). All inputs turned about the axis"
        " turn the needle (1e-9 mm), and a roll by π is a flip (`test_rod_rotation.py`).",
        "Rods of 100 mm with a natural bend, tilted and rolled at their base, under a force in any direction on their"
        " tip: distance of the tip (mm) from that of Kirchhoff's equations, integrated from the base with a search for"
        " its moment (`tests/reference/kirchhoff.py`). A twisted helix under its wrench: largest moment per mm that is"
        " not balanced, over EIκ².",
        table(("problem", *counts, "order"), rows),
        COMMAND,
        "A straight rod between two clamps, twisted by its base under an axial load, buckles at Greenhill's moment T."
        " Its second clamp is stiff tissue with friction against rotation, which gives by about half a millimetre.",
        table(("axial load over Euler's", "TL/EI", "found over closed form"), buckling),
        COMMAND,
        "The roll of the tip lags behind that of the base by c l²/2GJ and c l over the free length, for a couple c per"
        f" mm of friction against rotation: relative error {small(abs(found.lag))} while it slides.",
    ]


def write(found: problems.Found, folder: Path) -> list[Path]:
    """Write validation.md and images/ to the folder and return the paths."""
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    page = folder / "validation.md"
    page.write_text(document(found), encoding="utf-8")
    return [page, *draw(found, images)]


def main() -> None:
    """Compute the results, print the summary and write the files."""
    parser = argparse.ArgumentParser(description="Validation of the exact plant.")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs", metavar="DIR", help="folder of validation.md"
    )
    chosen = parser.parse_args()
    found = problems.compute()
    print(summary(found), end="\n\n")
    for path in write(found, chosen.out):
        print(path)


if __name__ == "__main__":
    main()
