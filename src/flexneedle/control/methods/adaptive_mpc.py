"""`adaptive-mpc`: one search to the target, every period, on a model that is fitted to the readings."""

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from flexneedle.control.adaptive_settings import AdaptiveMpc
from flexneedle.control.estimate import Estimate, Floats
from flexneedle.control.identification import Identification, Identified
from flexneedle.control.interface import Decision, Method, Task
from flexneedle.control.path import Ahead, Path, of_plan, proposals
from flexneedle.control.outlook import Outlook
from flexneedle.planning import Settings, cross_entropy
import os
P = dict(wE=float(os.environ.get('WE','0.3')), wL=float(os.environ.get('WL','3')), wS=float(os.environ.get('WS','0.5')), wR=float(os.environ.get('WR','0.015')), N=int(os.environ.get('NS','24')), IT=int(os.environ.get('IT','2')), FIRST=int(os.environ.get('FIRST','4')))


@dataclass(frozen=True, eq=False)
class Memory:
    path: Path
    first: bool = True
    scale: float = 1.0
    outlook: Outlook | None = None


def begin(task: Task) -> Memory:
    return Memory(of_plan(task.plan), True, moved_energy(task.scenario, task.plan.target[0]))


def moved_energy(scenario, depth):
    tops = [*scenario.layer_tops, np.inf]
    total = 0.0
    for k, layer in enumerate(scenario.tissue):
        length = min(depth, tops[k + 1]) - tops[k]
        if length <= 0.0:
            continue
        lam = 1.0 - 1.0 / layer.compression_length_mm
        a = layer.alpha
        w = 2.0 * layer.shear_modulus / a**2 * (2.0 * lam ** (-a / 2) + lam**a - 3.0)
        total += layer.energy_weight * w * layer.engaged_width_mm * layer.compression_length_mm * length
    return total


def decide(task: Task, memory: Memory, estimate: Estimate, rng: np.random.Generator) -> tuple[Decision, Memory]:
    belief = cast(Identified, estimate)
    state, setup = belief.state, task.scenario.setup
    ahead = Ahead.of(task, state, memory.path)
    count = P['N'] * (P['FIRST'] if memory.first else 1)
    lower, upper = ahead.bounds
    settings = Settings(samples=count, elite=max(3, count // 8), iterations=P['IT'], smoothing=0.3, tolerance=1e-9, lower=lower, upper=upper)
    first = proposals(ahead, count, rng)
    search = cross_entropy.start(ahead.in_hand, first.std(axis=0) + 1e-9)
    samples = first
    for k in range(P['IT']):
        if k:
            samples = cross_entropy.ask(search, settings, rng)
        search = cross_entropy.tell(search, settings, samples, cost(task, belief, ahead, samples, memory.scale)[0])
    path = ahead.corrected(search.best)
    _, miss = cost(task, belief, ahead, search.best[None], memory.scale)
    x = float(state.tip[0])
    due = [r for r in path.rolls if ahead.due(r)]
    later = [r for r in path.rolls if not ahead.due(r)]
    path = Path(path.depth, path.guide, tuple(later))
    advance = min(setup.max_advance_mm, ahead.left)
    if later and later[0] < x + advance:
        advance = later[0] - x
    guide = float(np.clip(np.interp(x + advance, path.depth, path.guide) - state.guide, -ahead.step, ahead.step))
    base = ahead.base[0] * min(1.0, advance / max(ahead.depth[1] - x, 1e-9))
    outlook = memory.outlook or Outlook.of(belief)
    chosen, _ = ahead.controls(search.best[None])
    tips = belief.simulator.rollout(state, chosen, limits=False).tips[0]
    outlook = outlook.renewed(belief, chosen[0], tips)
    sds = [outlook.sd(belief, task.plan.target[0], b) for b in (0.0, 3.0, 6.0, 12.0)]
    why = "SD " + " ".join(f"{v:.4f}" for v in (miss[0], *sds)) + f" predicted miss {miss[0]:.3f} mm, rolls at {', '.join(f'{r:.1f}' for r in later) or 'none'}"
    command = (advance, float(base[0]), float(base[1]), guide, 1 if len(due) % 2 else -1)
    return Decision(command, why, float(search.best_cost)), Memory(path, False, memory.scale, outlook)


def cost(task, belief, ahead, z, scale):
    controls, depths = ahead.controls(z)
    tips, energy, converged = belief.simulator.rollout(belief.state, controls, limits=False)
    side = belief.state.bevel * np.cumprod(-np.sign(controls[:, :, 4]), axis=1)
    seen = tips[:, :, 1] + belief.run_out * side + belief.residual
    depth, lateral = task.plan.target
    end = tips[:, -1]
    miss = seen[:, -1] + np.tan(end[:, 2]) * (depth - end[:, 0]) - lateral
    guided = ahead.step > 0.0
    we, wl = (P['wE'], P['wL']) if guided else (1.0, 0.0)
    x, y = belief.tip[:2]
    share = np.clip((tips[:, :, 0] - x) / max(depth - x, 1e-9), 0.0, 1.0)
    line = y + share * (lateral - y)
    weight = controls[:, :, 0] * share
    off = (np.abs(seen - line) * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-12)
    adv = np.maximum(controls[:, :, 0], 1e-9)
    slope = (controls[:, :, 3] ** 2 / adv).sum(axis=1) / max(ahead.left, 1e-9)
    rolls = (controls[:, :, 4] > 0.0).sum(axis=1)
    costs = np.abs(miss) + we * energy[:, -1] / scale + wl * off + P['wS'] * slope + P['wR'] * rolls
    return np.where(converged.all(axis=1), costs, np.inf), miss


METHOD = Method(
    "adaptive-mpc",
    "one search to the target on a model that is fitted to the readings",
    Identification(),
    begin=begin,
    decide=decide,
    settings=AdaptiveMpc,
)
