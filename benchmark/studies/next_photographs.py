"""How many photographs it takes: `python -m benchmark.studies.next_photographs --cameras 100`.

For simulated cameras (Kannala-Brandt free, a viewpoint shift unknown, 0.1 px) photographs of a
board are chosen (`planning.optimal_design`), taken at random from the same candidates, or
chosen for the intrinsics alone: where they expect the least error over the image, which is the
criterion of the Calibration Wizard (Peng and Sturm, ICCV 2019).  Counted is how many it takes for
a standard error of e0, and to be 95 % sure that a shift of 2 mm is not a lens curve or a bent
board.  Predicted errors are held against refits.  With --data the same is done by choosing among
the frames that there are, and counted is, too, how many it takes for `diagnose` to name the shift.
Writes docs/results/next/*.json.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmark import study
from benchmark.studies.boards import directions
from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.base import Effect, ModelTerm
from fisheye_svp_ros.effects.ray_effects import ViewpointShiftEffect
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.optics.camera import lens_columns, project_with_jacobian
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens, intrinsic_names
from fisheye_svp_ros.planning.optimal_design import (
    Criterion,
    Design,
    FlatBoard,
    ViewLimits,
    candidate_shots,
    information,
    richest_forms,
)
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.simulate.render import Print
from fisheye_svp_ros.simulate.simulation import blank_views
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, group_by_frame

NOISE, SHIFT, MOST, RANDOM = 0.1, 0.002, 60, 10
_ORDERS = 10  # random orders of real frames that are diagnosed
SURE = 0.95
EFFECT = ViewpointShiftEffect(1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study, write it, print what came of it."""
    parser = study.parser(
        'next_photographs',
        __doc__,
        study.RESULTS / 'next',
        workers=False,
        cameras=(100, 'simulated ones'),
        image_size=('1280x800', 'of --data'),
    )
    parser.add_argument('--data', type=Path, help='observations CSV: choose among its frames')
    asked = parser.parse_args(arguments)
    if asked.data:
        found = on_data(asked.data, study.image_size(asked.image_size))
        name = asked.data.parent.name
    else:
        cameras = study.in_turn('cameras', camera, range(asked.cameras))
        found, name = {'cameras': cameras, 'summary': summary(cameras)}, 'simulated'
    lines = ',\n'.join(f'{json.dumps(key)}: {_lines(value)}' for key, value in found.items())
    write_text(asked.output / f'{name}.json', f'{{{lines}}}\n')
    sys.stdout.write(json.dumps(found.get('summary', found), indent=1) + '\n')


def _lines(value: Any) -> str:
    """Return JSON with one entry of a list a line."""
    return study.json_lines(value).rstrip() if isinstance(value, list) else json.dumps(value)


def camera(number: int) -> dict[str, Any]:
    """Return how many photographs one camera needs, by method."""
    rng = np.random.default_rng([3, number])
    design, linear = simulated(rng)
    e0 = without(design, design.question('e0'))
    wizard = over_the_image(linear, design)
    design.values[design.columns('e0')] = SHIFT
    name = design.question('viewpoint_shift', ('radial_profile', 'target_shape'))
    alone = answers(design, e0)
    count = len(design.shots.distance)
    random = [rng.permutation(count)[:MOST] for _ in range(RANDOM)]
    goal = float(np.median([alone(order[:20]) for order in random]))
    by_shift = design.choose(e0, 20)[0]
    by_image = greedy(design, wizard, 30)
    return {
        'goal_m': goal,
        'e0': needed(design, e0, lambda error: error <= goal, by_image, random),
        'named': needed(design, name, lambda sure: sure >= SURE, by_image, random),
        'at_20_m': {
            'chosen': alone(by_shift[:20]),
            'random': goal,
            'intrinsics': alone(by_image[:20]),
        },
        'pull': refitted(linear, design, by_shift[:8], rng) if number < 20 else None,
    }


def simulated(rng: np.random.Generator) -> tuple[Design, Linearization]:
    """Return a random camera with nothing known, and all photographs that may be taken."""
    half = np.radians(rng.uniform(65, 95))
    curve = KannalaBrandt(rng.normal(scale=0.02), rng.normal(scale=0.004), 0.0, 0.0)
    f = 640 / float(curve.value_and_slope(np.array(half))[0])
    lens = Lens(
        'lens', 1280, 960, f, f, 640 + rng.normal(scale=9), 480 + rng.normal(scale=9), curve, half
    )
    points = Print(9, 6, rng.uniform(0.02, 0.04)).corners
    board = FlatBoard(np.arange(len(points)), points, np.zeros(len(points), int), np.eye(3))
    room = ViewLimits(float(rng.uniform(0.15, 0.25)), float(rng.uniform(0.8, 1.5)))
    shots = candidate_shots(RigState(identity(1), identity(1), lens, ()), board, room, rng)
    count = len(shots.distance)
    data = RigViews.of_one_camera(blank_views(board.landmark, points, count))
    state = RigState(shots.camera, identity(1), lens, ())
    linear = Linearization(data, state, intrinsic_names(lens))
    alike = richest_forms(linear, ('radial_profile', 'target_shape'))
    return Design(linear, [EFFECT, *alike], board, shots, NOISE, known=False), linear


def without(design: Design, question: Criterion) -> Criterion:
    """Return the question with confounded effects left out of it: they are taken as absent."""
    own = [
        i
        for i, name in enumerate(design.names)
        if '.' not in name or name.startswith('viewpoint_shift')
    ]
    return replace(question, nuisance=np.setdiff1d(own, question.interest))


def answers(design: Design, question: Criterion) -> Callable[[Index], float]:
    """Return what answers a question from some photographs: a standard error, or how sure."""
    return lambda taken: question.answer(design.known + design.added[taken].sum(axis=0))


def fewest(settled: Callable[[int], bool], counts: Iterable[int]) -> float:
    """Return how many photographs settle a question; infinity if none do."""
    return next((float(count) for count in counts if settled(count)), np.inf)


def needed(
    design: Design,
    question: Criterion,
    settles: Callable[[float], bool],
    by_image: Index,
    random: Sequence[Index],
) -> dict[str, float]:
    """Return by method how many photographs settle a question.

    The chosen ones of each number are chosen together.
    """
    answer = answers(design, question)

    def of(order: Index) -> float:
        return fewest(lambda n: settles(answer(order[:n])), range(1, len(order) + 1))

    return {
        'chosen': fewest(lambda n: settles(design.choose(question, n)[1][-1]), range(1, 21)),
        'intrinsics': of(by_image),
        'random': float(np.median([of(one) for one in random])),
    }


def over_the_image(linear: Linearization, design: Design) -> Array:
    """Return W (K, K): trace(W cov) is the mean variance that the lens gives image points."""
    lens = linear.state.lens
    angle, turn = np.meshgrid(
        np.linspace(0.05, 0.98, 16) * lens.max_incidence,
        np.linspace(0, 2 * np.pi, 24, endpoint=False),
    )
    points = directions(angle, turn).reshape(-1, 3)
    columns = lens_columns(lens, project_with_jacobian(lens, points), list(linear.free))
    return np.asarray(np.einsum('mik,mil->kl', columns, columns) / len(points))


def greedy(design: Design, weight: Array, count: int) -> Index:
    """Return photographs chosen for the least error over the image, the shift taken as none."""
    own, order, known = np.arange(len(weight)), [], design.known
    for _ in range(count):
        every = (known + design.added)[:, own[:, None], own]
        merit = -np.trace(weight @ np.linalg.inv(every), axis1=1, axis2=2)
        merit[order] = -np.inf
        order.append(int(np.argmax(merit)))
        known = known + design.added[order[-1]]
    return np.array(order)


def refitted(
    linear: Linearization, design: Design, taken: Index, rng: np.random.Generator
) -> float:
    """Return the error of e0 in a refit of simulated photographs over its predicted error."""
    state = linear.state
    true = state.lens.with_shift(Gennery(0.0, SHIFT))
    shots, board = design.shots.take(taken), design.board
    model = replace(state, pose=shots.camera, lens=true)
    views = blank_views(board.landmark, board.points, len(taken))
    data = RigViews.of_one_camera(views)
    uv = Linearization(data, model, ()).linear.uv
    data = replace(data, views=views._replace(uv=uv + NOISE * rng.normal(size=uv.shape)))
    begun = replace(model, lens=state.lens, terms=(ModelTerm(EFFECT, np.zeros(1)),))
    fitted = adjust(data, begun, linear.free)
    predicted = answers(design, without(design, design.question('e0')))(taken)
    return float((fitted.terms[0].values[0] - SHIFT) / predicted)


def on_data(path: Path, image_size: tuple[int, int]) -> dict[str, Any]:
    """Choose among the frames of a real table: how many tell e0 nearly as well as all."""
    table = read_observations(path)
    lens = study.calibrated(table, image_size)
    data, free = group_by_frame(table), intrinsic_names(lens)
    state = initial_state(data, lens)
    state = adjust(data, replace(state, terms=(ModelTerm(EFFECT, np.zeros(1)),)), free)
    linear = Linearization(data, state, free)
    square = float((linear.residual**2).sum()) / int(linear.row_mask.sum())
    design = Taken(linear, richest_forms(linear, ('radial_profile', 'target_shape')), square)
    e0 = without(design, design.question('e0'))
    name = design.question('viewpoint_shift', ('radial_profile', 'target_shape'))
    count = len(design.added)
    error = answers(design, e0)
    by_image = greedy(design, over_the_image(linear, design), count)
    rng = np.random.default_rng(0)
    random = [rng.permutation(count) for _ in range(200)]
    everything = error(np.arange(count))
    goal = 1.5 * everything
    return {
        'frames': count,
        'stderr_all_m': everything,
        'goal_m': goal,
        'e0': needed(design, e0, lambda error: error <= goal, by_image, random),
        'named': needed(design, name, lambda sure: sure >= SURE, by_image, random),
        'diagnosed': {
            'chosen': diagnosed(table, lens, lambda n: design.choose(name, n)[0]),
            'intrinsics': diagnosed(table, lens, lambda n: by_image[:n]),
            'random': [diagnosed(table, lens, lambda n, o=o: o[:n]) for o in random[:_ORDERS]],
        },
        'stderr_m': {
            str(n): {
                'chosen': design.choose(e0, n)[1][-1],
                'intrinsics': error(by_image[:n]),
                'random': float(np.median([error(o[:n]) for o in random])),
            }
            for n in (3, 5, 10)
        },
    }


def diagnosed(table: Observations, lens: Lens, chosen: Callable[[int], Index]) -> float:
    """Return how many frames of a table it takes for `diagnose` to name the viewpoint shift."""

    def named(count: int) -> bool:
        some = table.take(np.isin(table.frame, table.frames[chosen(count)]))
        try:
            found = study.calibrated_and_diagnosed(
                some, (lens.width, lens.height), free_intrinsics=True
            )[1]
        except FisheyeSvpError:
            return False  # too few to tell anything
        return any(cause.effect == EFFECT.name for cause in found.causes)

    return fewest(named, range(1, len(table.frames) + 1))


class Taken(Design):
    """The photographs that there are, in place of those that might be taken."""

    def __init__(self, linear: Linearization, effects: Sequence[Effect], square: float) -> None:
        """Take a fit, effects that are not in it, and the mean square of whitened residuals."""
        terms = [
            *linear.state.terms,
            *(ModelTerm(e, np.zeros(len(e.parameters))) for e in effects),
        ]
        self.names = (
            *linear.free,
            *(f'{t.name}.{p.name}' for t in terms for p in t.effect.parameters),
        )
        self.values = np.concatenate([np.zeros(len(linear.free)), *(t.values for t in terms)])
        self.added = information(linear, effects) / square
        self.known = np.diag(1e-9 * np.diag(self.added.sum(axis=0)))


def summary(cameras: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return medians over the cameras, and in how many choosing needs at most half."""
    found: dict[str, Any] = {'cameras': len(cameras)}
    for what in ('e0', 'named'):
        table = {
            m: np.array([one[what][m] for one in cameras])
            for m in ('chosen', 'intrinsics', 'random')
        }
        found[what] = {
            **{method: float(np.median(values)) for method, values in table.items()},
            **{
                f'at_most_half_of_{m}': float(np.mean(2 * table['chosen'] <= table[m]))
                for m in ('random', 'intrinsics')
            },
            **{
                f'ratio_to_{m}': float(np.median(table['chosen'] / table[m]))
                for m in ('random', 'intrinsics')
            },
        }
    found['at_20_mm'] = {
        m: 1e3 * float(np.median([one['at_20_m'][m] for one in cameras]))
        for m in ('chosen', 'intrinsics', 'random')
    }
    pulls = np.array([one['pull'] for one in cameras if one['pull'] is not None])
    found['error_over_predicted_rms'] = float(np.sqrt(np.mean(pulls**2)))
    return found


if __name__ == '__main__':
    main()
