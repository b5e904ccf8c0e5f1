"""Messages and frames of an insertion in space as a server sends them, from closed curves without mechanics.

The needle begins at x = -90 mm, its guide is at -41 mm, its tip at the start at -28.5 mm; the skin is x = 0.
"""

from itertools import product

import numpy as np

from flexneedle.lab.page.protocol import (
    ClientsMessage,
    DisturbancesMessage,
    EstimateMessage,
    InsertionMessage,
    IterationMessage,
    JobMessage,
    NearestZone,
    PageZone,
    PlanMessage,
    ReachMessage,
    RowsMessage,
    RunsMessage,
    SceneMessage,
    SessionMessage,
    StudyRow,
    StudyRowsMessage,
    WelcomeMessage,
    ZonesMessage,
    ZoneSurface,
)
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, make_frame, pack_frame

TARGET = (40.0, 5.0, 3.0)
PERIODS = 70
ITERATIONS = 8
START, LENGTH, NODES = -28.5, 90.0, 46

WELCOME = WelcomeMessage(
    client=1,
    presets=["phantom", "phantom3d"],
    controllers=[
        {"name": "adaptive-mpc", "summary": "Estimates stiffness and bevel, and searches."},
        {"name": "ce-mpc", "summary": "The paper's."},
    ],
    strategies=["manipulation", "steering"],
)


def clients(clients=1, steering=None):
    return ClientsMessage(clients=clients, steering=steering)


def cube(center, half):
    """The surface of a cube."""
    points = [np.array(center) + half * np.array(sides) for sides in product((-1.0, 1.0), repeat=3)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [index for a, b, c, d in faces for index in (a, b, c, a, c, d)]
    return ZoneSurface(points=np.ravel(points).tolist(), triangles=triangles)


ZONE = (20.0, 6.0, 2.0)


def zones(of="scene", center=ZONE):
    """A cubic zone that can be moved, and one of a file."""
    surfaces = {"surface": cube(center, 2.0), "margin": cube(center, 4.0)}
    moved = PageZone(name="node", margin_mm=2.0, places={"zone.0.center_mm": center}, **surfaces)
    fixed = PageZone(
        name="vessel",
        margin_mm=2.0,
        places={},
        surface=cube((30.0, -6.0, 0.0), 1.0),
        margin=cube((30.0, -6.0, 0.0), 3.0),
    )
    return ZonesMessage(of=of, zones=[moved, fixed])


NEAREST = NearestZone(zone="node", clearance_mm=1.25, needle=(20.0, 2.0, 1.0), surface=(20.0, 4.0, 1.0))


def session(revision=1, target=TARGET, reach_since=None, **changes):
    values = {
        "name": "Two-layer tissue phantom in space",
        "needle.outer_diameter_mm": 0.819,
        "setup.axes": 2,
        "tissue.0.name": "superficial",
        "tissue.0.thickness_mm": 20.0,
        "tissue.0.shear_modulus_kpa": 1.82,
        "tissue.1.name": "deep",
        "tissue.1.shear_modulus_kpa": 3.63,
        **dict(zip(("target.depth_mm", "target.lateral_mm", "target.lateral_z_mm"), target, strict=True)),
    }
    given = {
        "name": "phantom3d",
        "seed": 0,
        "strategy": "manipulation",
        "controller": "adaptive-mpc",
        **changes,
    }
    since = revision if reach_since is None else reach_since
    return SessionMessage(revision=revision, reach_since=since, values=values, changed=[], doubts=[], **given)


def scene(revision=1, target=TARGET, axes=2, point=(0.0, 0.0), places=()):
    return SceneMessage(
        revision=revision,
        axes=axes,
        layers=[
            {"name": "superficial", "top_mm": 0.0, "bottom_mm": 20.0, "shear_modulus_kpa": 1.82},
            {"name": "deep", "top_mm": 20.0, "bottom_mm": None, "shear_modulus_kpa": 3.63},
        ],
        guide=(-41.0, 0.0, 0.0),
        base=(START - LENGTH, 0.0, 0.0),
        needle_length_mm=LENGTH,
        needle_radius_mm=0.41,
        axis={"point": point, "slope": (0.0, 0.0)},
        target=target,
        zones=list(places),
    )


def _reach():
    """In the plane of the target."""
    y, z = np.array(TARGET[1:]) / np.hypot(*TARGET[1:])
    ends = {"low": ((5.0, -1.0), (45.0, -12.0)), "high": ((5.0, 1.0), (44.0, 12.0))}
    edges = {edge: [(x, u * y, u * z) for x, u in points] for edge, points in ends.items()}
    return ReachMessage(revision=1, angle_deg=np.degrees(np.arctan2(z, y)), **edges)


REACH = _reach()


def curve(x, target=TARGET, sway=0.0):
    """Points (n, 3) of a path from the axis to the target: cubic in depth, with a sway (mm) on the way."""
    along = np.clip((np.asarray(x) - START) / (target[0] - START), 0.0, None)
    shape = 3.0 * along**2 - 2.0 * along**3
    wave = sway * np.sin(np.pi * along)
    return np.column_stack([x, target[1] * shape + wave, target[2] * shape - 0.5 * wave])


def needle(tip_x, target=TARGET, sway=0.0):
    return curve(np.linspace(tip_x - LENGTH, tip_x, NODES), target, sway)


def _tip_x(period):
    return START + (TARGET[0] - START) * (period + 1) / PERIODS


def shape(kind, source, number, *paths):
    return pack_frame(make_frame(kind, source, number, *paths))


def scene_frames(target=TARGET):
    return [shape(FrameKind.NEEDLE, FrameSource.SCENE, 0, needle(START, target))]


def plan_frames(source=FrameSource.MANIPULATION, sway=0.4):
    tips = curve(np.linspace(START, TARGET[0], PERIODS), sway=sway)
    sweep = [needle(x, sway=sway) for x in np.linspace(START, TARGET[0], 12)]
    return [shape(FrameKind.PATH, source, 0, tips), shape(FrameKind.SWEEP, source, 0, *sweep)]


def iteration(number, strategy="manipulation"):
    best = [2.0 / (1 + k) ** 2 for k in range(number + 1)]
    return IterationMessage(
        revision=1,
        strategy=strategy,
        iteration=number,
        iterations=ITERATIONS,
        best=best,
        elite=[1.3 * cost for cost in best],
        median=[2.0 * cost for cost in best],
    )


def samples(number, count=32, source=FrameSource.MANIPULATION, x=(START, TARGET[0])):
    """Frame of sampled paths, narrower with each iteration."""
    spread = 6.0 / (1 + number)
    ends = [
        (
            TARGET[0],
            TARGET[1] + spread * np.cos(2.4 * k) * k / count,
            TARGET[2] + spread * np.sin(2.4 * k) * k / count,
        )
        for k in range(count)
    ]
    paths = [
        np.column_stack([curve(np.linspace(*x, 24), end), np.full(24, k / count)])
        for k, end in enumerate(ends)
    ]
    return shape(FrameKind.SAMPLES, source, number, *paths)


def reach_frame():
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    outlines = [
        np.column_stack([np.full(49, x), 0.3 * x * np.cos(angle), 0.25 * x * np.sin(angle)])
        for x in (15.0, 25.0, 35.0, 45.0)
    ]
    return shape(FrameKind.REACH, FrameSource.SCENE, 0, *outlines)


def load(energies, rolls):
    """Return the load of a plan or an insertion, as text by name."""
    return {"tissue energy: peak, mean, end": f"{energies} µJ", "bevel rolls": str(rolls)}


def plan(strategy="manipulation", **changes):
    given = {
        "revision": 1, "reached": True, "summary": "ends 0.001 mm off", "error_mm": 0.001,
        "load": load("3.2, 1.1, 2.1", 0), "roll_deg": 0.0, "cost": 0.19,
        "terms": {"accuracy": 0.02, "energy": 0.12, "rolls": 0.05},
        "seconds": 0.3, **changes,
    }  # fmt: skip
    return PlanMessage(strategy=strategy, **given)


def estimate(revision=1, roll_deg=0.0):
    return EstimateMessage(
        revision=revision, summary="ends 0.310 mm from the target", error_mm=0.31, roll_deg=roll_deg
    )


def row(index):
    x, y, z = needle(_tip_x(index), sway=0.3)[-1]
    true = needle(_tip_x(index), sway=0.6)[-1]
    return {
        "index": index, "time": 0.2 * index, "action": "advance", "decision": "advance as planned", "verdict": "ok",
        "measured": (x + 0.05 * np.sin(index), y + 0.1 * np.cos(7 * index), z + 0.1 * np.sin(5 * index)),
        "estimate": (x, y, z), "true": tuple(true), "error_mm": float(np.hypot(*(true[1:] - (y, z)))),
        "guide": (0.02 * index, 0.01 * index), "roll_deg": 3.0 * index, "indicator": 0.1,
        "energy_uj": 0.02 * index, "true_energy_uj": 0.021 * index,
        "miss_mm": (0.3 * (1 - index / PERIODS), -0.1), "miss_sd_mm": 0.5 * (1 - index / PERIODS) + 0.05,
        "clearance_mm": 6.0 - 0.05 * index, "true_clearance_mm": 5.9 - 0.05 * index,
        "decide_ms": 12.0, "late": False, "warning": "", "sensors": [], "tip_covariance": None,
    }  # fmt: skip


def rows(first=0, count=PERIODS, of="live"):
    return RowsMessage(of=of, first=first, rows=[row(k) for k in range(first, first + count)])


def insertion(state="running", of="live", periods=PERIODS, **changes):
    given = {
        "name": "phantom3d", "summary": "", "controller": "adaptive-mpc", "seed": 0, "target": TARGET, "pace": 1.0,
        "error_mm": None, "scene": scene(), **changes,
    }  # fmt: skip
    return InsertionMessage(of=of, state=state, periods=periods, **given)


def period_frames(period, source=FrameSource.LIVE):
    """Shapes at a control period."""
    tip = _tip_x(period)
    estimate, true = needle(tip, sway=0.3), needle(tip, sway=0.6)
    remaining = np.linspace(0.0, 1.0, NODES) * (1 - period / PERIODS)
    predicted = np.column_stack([needle(TARGET[0], sway=0.1), 0.2 + 1.2 * remaining])
    cut = np.linspace(0.0, max(tip, 0.1), 24)
    stretch = 1.0 + 0.35 * np.sin(np.pi * cut / (TARGET[0] + 5.0))
    frames = [
        shape(FrameKind.NEEDLE, source, period, estimate),
        shape(FrameKind.TRUE, source, period, true),
        shape(FrameKind.PREDICTED, source, period, predicted),
    ]
    if tip > 0.0:
        frames.append(
            shape(FrameKind.CHANNEL, source, period, np.column_stack([curve(cut, sway=0.3), stretch]))
        )
    return frames


MANY = {"name": "many", "kind": "study", "summary": "Many targets: 150 insertions", "made": 1.7e9}


def study_rows(request):
    """Return the server's message about rows of a study: the worst, or one from an index on."""

    def row(index, **changes):
        given = {
            "settings": "base", "controller": "adaptive-mpc", "target": (40.0, 5.0, 0.0), "error_mm": 0.2214,
            "outcome": "done", "reason": "", "opens": True, **changes,
        }  # fmt: skip
        return StudyRow(index=index, **given)

    refused = {"error_mm": None, "outcome": "refused", "reason": "plan misses", "opens": False}
    worst = [row(17), row(3, error_mm=0.02), row(9, target=(40.0, 5.0, 3.0), **refused)]
    index = request.get("index")
    about = {"title": "Many targets", "insertions": 150, "finished": 149}
    found = worst if index is None else [row(index)]
    return [StudyRowsMessage(name=request["name"], index=index, rows=found, **about)]


def opening(**changes):
    """Return what a new client gets: a scene, nothing planned."""
    return [
        WELCOME,
        clients(),
        session(**changes),
        scene(),
        *scene_frames(),
        DisturbancesMessage(active=[]),
        RunsMessage(runs=[{"name": "first", "kind": "insertion", "summary": "reached", "made": 1.7e9}]),
    ]


def planned():
    """Return the state after plans with both strategies and a reach."""
    return [
        *opening(),
        iteration(ITERATIONS - 1),
        samples(2),
        plan(),
        *plan_frames(),
        plan(
            "steering",
            reached=False,
            error_mm=2.1,
            cost=4.2,
            load=load("9, 4, 9", 2),
            terms={"accuracy": 4.2, "rolls": 9.98e-5},
        ),
        *plan_frames(FrameSource.STEERING, sway=-1.5),
        reach_frame(),
    ]


def inserting(period=50):
    """Return the state in the middle of an insertion."""
    return [
        *planned(),
        insertion(periods=period + 1),
        rows(0, period + 1),
        *(frame for each in range(period + 1) for frame in period_frames(each)),
        samples(3, source=FrameSource.LIVE, x=(_tip_x(period), TARGET[0])),
        JobMessage(
            job=3,
            kind="insertion",
            state="running",
            share=(period + 1) / PERIODS,
            text=f"period {period + 1}",
        ),
    ]
