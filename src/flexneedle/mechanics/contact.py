"""Contact points: the tissue as springs along the needle (docs/theory.md sections 2 and 5)."""

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lanes import least, load, most, select
from flexneedle.mechanics.lateral import Lateral, size, times
from flexneedle.mechanics.law import Response, response, stored_energy
from flexneedle.mechanics.needle import Cut, Path
from flexneedle.mechanics.work import CELLS, CONTACT, KIND, LAW, PER_REACH, STIFFNESS, Needles, U, X


@inner
def contact_weight(w: Needles, i: int, tip_x: float) -> float:
    """Return ρ of contact i, 0 at the tip to 1 well behind it; docs/theory.md eq. 4."""
    return least(1.0, most(0.0, (tip_x - load(w.mesh, i, X)) * load(w.mesh, i, PER_REACH)))


@inner
def contact_law(w: Needles, i: int, u: Lateral) -> Response:
    """Return the law of contact i at the compression u (mm), scaled to the stiffness 1."""
    return response(w.laws, load(w.mesh, i, LAW), size(u) * load(w.mesh, i, CELLS))


@inner
def contact_rest(cut: Cut, path: Path, tip_x: float, x: float) -> tuple[Lateral, float]:
    """Return (fixed, share): a contact at x that the step cuts rests at fixed + share y_tip; docs/theory.md eq. 9."""
    share = (x - cut.tip.x) * (1.0 / (tip_x - cut.tip.x))
    path_y = times(1.0 - path.coupling, path.y)
    return cut.tip.y + times(share, path_y - cut.tip.y), share * path.coupling


@inner
def contact_energy(w: Needles, i: int, tip_x: float) -> float:
    """Return the energy (mJ) that contact i stores, without the weight of its layer."""
    cells = load(w.mesh, i, CELLS)
    stored = stored_energy(w.laws, load(w.mesh, i, LAW), size(load(w.laterals, i, U)) * cells)
    contact = load(w.mesh, i, KIND) == CONTACT
    scale = load(w.mesh, i, STIFFNESS) * contact_weight(w, i, tip_x)
    return select(contact, scale * stored / select(contact, cells * cells, 1.0), 0.0)
