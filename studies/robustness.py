"""Random control sequences in random tissue: no exception, no NaN, no unconverged step (`make robustness`).

Every batch is one random scenario and many sequences of all inputs within its limits, run by `Simulator.rollout`: in
the plane, or with `--space` in two lateral axes with rolls to any angle and spins. With `--adapted` most needles have a
bend, a clearance in their guide, or both, as an observer may estimate them. Progress is printed on stderr, a JSON
summary on stdout; exit status 1 after any failure, 130 after an interrupt. A batch depends only on seed, batch number
and these options, which reproduce a failure.
"""

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass, field

import numpy as np

import flexneedle
from flexneedle import Adaptation, Control, Scenario, Simulator
from flexneedle.mechanics.solve import COUPLED_ITERATIONS
from flexneedle.scenario.sections.needle import GAUGES
from flexneedle.types import DB_PSI, DB_THETA, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, SPIN

STEPS = 80
BATCH = 20
SHOWN = 5


@dataclass
class FailureTally:
    """Counts of a run, and the arguments that reproduce each failure."""

    steps: int = 0
    unconverged: int = 0
    not_finite: int = 0
    exceptions: int = 0
    fallback_steps: int = 0
    most_iterations: int = 0
    worst_residual_mm: float = 0.0
    failures: list[str] = field(default_factory=list)

    @property
    def failed(self) -> bool:
        """Whether there was any failure."""
        return self.unconverged + self.not_finite + self.exceptions > 0

    def conclude(self, script: str, seed: int, start: float, interrupted: bool) -> int:
        """Print the summary in JSON and how to reproduce the first failure; return the exit status.

        start: `time.perf_counter()` at the start.
        """
        result = asdict(self) | {
            "failures": self.failures[:SHOWN],
            "seed": seed,
            "seconds": round(time.perf_counter() - start, 1),
            "version": flexneedle.__version__,
            "passed": not self.failed,
        }
        print(json.dumps(result, indent=2))
        if self.failures:
            print(f"reproduce: python studies/{script} {self.failures[0]}", file=sys.stderr)
        return 130 if interrupted else int(self.failed)


@dataclass
class Tally(FailureTally):
    """Counts of sequences; `worst_residual_mm` is over sequences that are repeated step by step."""

    sequences: int = 0
    checked_steps: int = 0


def draw_layer(rng: np.random.Generator) -> dict[str, float]:
    """Return μ 0.1 to 100 kPa and α 1 to 30, the required ranges; h and w around the phantom."""
    return {
        "shear_modulus_kpa": float(10 ** rng.uniform(-1, 2)),
        "alpha": float(rng.uniform(1, 30)),
        "compression_length_mm": float(rng.uniform(8, 40)),
        "engaged_width_mm": float(rng.uniform(1, 15)),
        "energy_weight": float(rng.uniform(0, 3)),
    }


def draw_scenario(rng: np.random.Generator) -> Scenario:
    """Return 1 to 5 layers, needles of 17 to 27 gauge with and without stylet, with and without a guide."""
    layers = [draw_layer(rng) for _ in range(rng.integers(1, 6))]
    for layer in layers[:-1]:
        layer["thickness_mm"] = float(rng.choice([5.0, rng.uniform(0.05, 20.0)]))
    thinnest = min(layer["compression_length_mm"] for layer in layers)
    gap = float(rng.choice([0.5, 5.0, 28.5]))
    setup = {
        "tip_to_skin_mm": gap,
        "stroke_mm": gap + 55.0,
        "max_advance_mm": float(rng.choice([1.0, 3.0])),
        "guide_to_skin_mm": gap + float(rng.uniform(1, 25)),
    }
    if rng.random() < 0.25:
        del setup["guide_to_skin_mm"]
    return Scenario.from_values(
        {
            "name": "Random",
            "needle": {
                "gauge": str(rng.choice(list(GAUGES))),
                "stylet": bool(rng.random() < 0.5),
                "length_mm": float(rng.uniform(110, 220)),
                "bevel": {
                    "offset_mm": float(rng.choice([0.0, rng.uniform(0, 0.69 * thinnest)])),
                    "length_mm": float(rng.uniform(0.2, 8)),
                },
            },
            "setup": setup,
            "contact": {"spacing_mm": float(rng.choice([1.0, rng.uniform(0.25, 3.0)]))},
            "tissue": layers,
        }
    )


def draw_controls(scenario: Scenario, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return (count, STEPS, 9): steps up to the limits, constant over runs or changing every step."""
    setup = scenario.setup
    shape = (count, STEPS)
    forward = _runs(rng, shape, 0.9)
    length = np.where(rng.random(shape) < 0.85, rng.uniform(0.2, 1.0, shape), 10 ** rng.uniform(-9, 0, shape))
    columns = [_bounded(forward * length * setup.max_advance_mm, 0.0, setup.stroke_mm)]
    ranges = (
        (setup.max_base_step_mm, setup.max_base_travel_mm),
        (setup.max_base_turn_step, 0.15),
        (setup.max_guide_step_mm if setup.has_guide else 0.0, setup.max_guide_travel_mm),
    )
    for step, travel in ranges:
        # From no motion to bang-bang at the limit, with a separate direction for each sequence.
        swing = step * rng.choice([0.0, 0.1, 0.4, 1.0], (count, 1))
        moves = swing * _runs(rng, shape, rng.uniform(0.5, 0.95)) * rng.uniform(0, 1, shape)
        columns.append(_bounded(moves, -travel, travel))
    advance, base, turn, guide = columns
    roll = np.where(rng.random(shape) < rng.choice([0.02, 0.2], (count, 1)), np.pi, 0.0)
    return flexneedle.controls(*shape, db_x=advance, db_y=base, db_theta=turn, dg_y=guide, roll=roll)


def draw_controls_in_space(scenario: Scenario, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return (count, STEPS, 9): as in the plane along y and z, rolls by half turns or to any angle, spins in some."""
    rows, across = (draw_controls(scenario, count, rng) for _ in range(2))
    rows[..., [DB_Z, DB_PSI, DG_Z]] = across[..., [DB_Y, DB_THETA, DG_Y]]
    free, angles = rng.random((count, 1)) < 0.5, rng.uniform(-4.0, 4.0, rows.shape[:2])
    rows[..., ROLL] = np.where(free & (rows[..., ROLL] > 0.0), angles, rows[..., ROLL])
    spins = rng.choice([0.0, 0.0, 0.1, 1.0, 6.0], (count, 1))
    rows[..., SPIN] = spins * rng.uniform(-1.0, 1.0, rows.shape[:2])
    return rows


def bent(simulator: Simulator, rng: np.random.Generator) -> Simulator:
    """Return the simulator of a needle with a bend (mm) in half of the cases, and a clearance in half."""
    layers, axes = len(simulator.scenario.tissue), simulator.scenario.setup.axes
    y, z = rng.uniform(-2.0, 2.0, 2).tolist()
    bend = float(rng.choice([0.0, 1.0])) * (y if axes == 1 else complex(y, z))
    clearance = float(rng.choice([0.0, rng.uniform(0.0, 0.2)]))
    fitted = Adaptation(np.zeros(layers - 1), np.ones(layers), bend=bend, clearance=clearance)
    return simulator.with_model(simulator.adapt(fitted))


def _runs(rng: np.random.Generator, shape: tuple[int, int], forward: float) -> np.ndarray:
    """Return −1 and +1 in runs of 1 to 12 steps, +1 with the given probability."""
    signs = np.where(rng.random(shape) < forward, 1.0, -1.0)
    hold = np.repeat(np.arange(shape[1] // 4 + 1), 4)[: shape[1]]
    return np.where(rng.random((shape[0], 1)) < 0.5, signs, signs[:, hold])


def _bounded(steps: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return steps clipped so that their sum stays within low and high."""
    position, kept = np.zeros(steps.shape[0]), np.empty_like(steps)
    for k in range(steps.shape[1]):
        kept[:, k] = np.clip(position + steps[:, k], low, high) - position
        position += kept[:, k]
    return kept


def run_batch(
    seed: int, batch: int, count: int, tally: Tally, *, space: bool = False, adapted: bool = False
) -> None:
    """Run `count` sequences of one scenario; failures are counted, not raised."""
    rng = np.random.default_rng((seed, batch))
    scenario = draw_scenario(rng)
    controls = (draw_controls_in_space if space else draw_controls)(scenario, BATCH, rng)[:count]
    roll = 0.0 if rng.random() < 0.5 else np.pi
    kind = ("--space " if space else "") + ("--adapted " if adapted else "")
    options = f"{kind}--seed {seed} --batch {batch}"
    try:
        simulator = Simulator(scenario.with_values({"setup.axes": 2}) if space else scenario)
        simulator = bent(simulator, rng) if adapted else simulator
        found = simulator.rollout(simulator.start(roll), controls, outputs=("energy",))
        tips, energy, converged = found.tips, found.energy, found.converged
        _repeat_by_step(simulator, controls[batch % count], roll, tally)
    except Exception as error:  # noqa: BLE001  the study counts exceptions
        tally.exceptions += 1
        tally.failures.append(f"{options}  # {type(error).__name__}: {error}")
        return
    finite = np.isfinite(tips).all(axis=2) & np.isfinite(energy)
    tally.sequences += count
    tally.steps += converged.size
    tally.unconverged += int((~converged).sum())
    tally.not_finite += int((~finite).sum())
    for j, k in np.argwhere(~(finite & converged))[:1]:
        kind = "unconverged" if finite[j, k] else "not finite"
        tally.failures.append(f"{options}  # sequence {j}, step {k}: {kind}")


def _repeat_by_step(simulator: Simulator, rows: np.ndarray, roll: float, tally: Tally) -> None:
    """Run one sequence step by step, for residual and iterations, which a rollout does not report."""
    state = simulator.start(roll)
    for row in rows:
        state = simulator.step(state, Control.of(row))
        tally.most_iterations = max(tally.most_iterations, state.iterations)
        tally.fallback_steps += state.iterations > COUPLED_ITERATIONS  # theory section 6
        tally.worst_residual_mm = max(tally.worst_residual_mm, state.residual)
        tally.checked_steps += 1


def main(arguments: list[str] | None = None) -> int:
    """Run the study; 0 if nothing failed, 1 otherwise, 130 if interrupted."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--sequences", type=int, default=100_000)
    parser.add_argument("--space", action="store_true", help="two lateral axes (default: in the plane)")
    parser.add_argument("--adapted", action="store_true", help="with bends and clearances (default: without)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--batch", type=int, help="only this batch, to reproduce a failure")
    options = parser.parse_args(arguments)
    if options.sequences < 1:
        parser.error("--sequences must be 1 or more")
    tally, start, interrupted = Tally(), time.perf_counter(), False
    last = -(-options.sequences // BATCH)
    batches = range(last) if options.batch is None else [options.batch]
    try:
        for done, batch in enumerate(batches):
            left = options.sequences - done * BATCH
            count, kind = min(BATCH, left), {"space": options.space, "adapted": options.adapted}
            run_batch(options.seed, batch, count, tally, **kind)
            _progress(tally, len(batches), done + 1, start)
    except KeyboardInterrupt:
        interrupted = True
        print("\ninterrupted", file=sys.stderr)
    return tally.conclude("robustness.py", options.seed, start, interrupted)


def _progress(tally: Tally, batches: int, done: int, start: float) -> None:
    end = "\n" if done == batches else "\r"
    seconds = time.perf_counter() - start
    text = (
        f"{tally.sequences} sequences, {tally.steps} steps, {len(tally.failures)} failures, {seconds:.0f} s"
    )
    print(f"batch {done}/{batches}: {text}", end=end, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
