"""The stages of a diagnosis, from checked inputs to the answer.

Problem -> NullModel -> EffectTests -> Selection -> FittedModel -> Evaluation -> Diagnosis.
Before the last, causes that held-out frames refute, or another effect explains, are taken out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from threading import Event, Thread
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.diagnosis.causes import (
    Cause,
    confounded_effects,
    growth_cause,
    outlier_rows,
    parameters_of,
    table_causes,
)
from fisheye_svp_ros.diagnosis.checks.medium import Medium, behind_port, find_medium
from fisheye_svp_ros.diagnosis.checks.turned_boards import (
    TurnedFrame,
    find_turned_frames,
    find_turned_views,
    turn_frames,
)
from fisheye_svp_ros.diagnosis.checks.two_cameras import TwoCameras, agree_on_target
from fisheye_svp_ros.diagnosis.checks.two_datasets import (
    DatasetModel,
    compare_datasets,
    measure_travel,
)
from fisheye_svp_ros.diagnosis.conclusion import advice_on_lens, advise, conclude, turn_advice
from fisheye_svp_ros.diagnosis.cross_validation import HeldOut, cross_validate
from fisheye_svp_ros.diagnosis.diagnosis import Diagnosis
from fisheye_svp_ros.diagnosis.effect_tests import SIGNIFICANCE, EffectTests
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.findings import (
    Evidence,
    Finding,
    Reason,
    Rival,
    Status,
    find_doubt,
    is_implausible,
)
from fisheye_svp_ros.diagnosis.model_errors import with_uncertainty
from fisheye_svp_ros.diagnosis.problem import (
    DiagnosisOptions,
    Inputs,
    Progress,
    Provisional,
    find_hand_eye,
    ignore_progress,
    prepare_problem,
)
from fisheye_svp_ros.diagnosis.selection import (
    Selection,
    first_causes,
    select_causes,
    without_cause,
)
from fisheye_svp_ros.diagnosis.variance_budget import (
    Component,
    Structure,
    add_outliers,
    remaining_structure,
    significant_components,
)
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.table_checks import ROUNDING, check_distinct, dither
from fisheye_svp_ros.solve.measured_poses import rig_lenses

_FIRST_LOOK, _FIRST_LOOK_FRAMES = 1000, 6  # points, or some more, and frames of a first look


def diagnose(
    observations: Observations,
    lens: Lens | Mapping[str, Lens],
    *,
    free_intrinsics: bool | None = None,
    poses: dict[int, Pose] | None = None,
    held_out: Observations | None = None,
    options: DiagnosisOptions | None = None,
    progress: Progress = lambda *_: None,
    provisional: Provisional = ignore_progress,
) -> Diagnosis:
    """Find what a lens's simulation gets wrong about observations.

    observations: as `usable_observations` returns them; lens: of every camera, or the lenses of a
    rig by camera.
    free_intrinsics: whether they were (or are to be) fitted; None asks the lens's `calibration`.
    poses: by frame, of the camera (of a rig: its right one), or of the flange of a robot that
    carries it, which the data tell apart; held_out: other frames of the same camera
    and target; options: effects to include or leave out; progress: told what is being done, and
    which share is done; provisional: told the names of the causes that a part of many points
    shows, from a thread of its own, and then those that the first round finds.
    Raises GeometryError or ObservationError where the data cannot be solved at all.
    """
    inputs = Inputs.check(
        observations,
        lens,
        options or DiagnosisOptions(),
        free_intrinsics=free_intrinsics,
        poses=poses,
        held_out=held_out,
    )
    if provisional is not ignore_progress:
        inputs = replace(inputs, provisional=_begin_first_look(inputs, provisional))
    diagnosis = _run_stages(inputs, progress)
    if diagnosis.noise_px > ROUNDING:
        return diagnosis
    return _run_stages(replace(inputs, observations=dither(inputs.observations)), progress)


def _begin_first_look(inputs: Inputs, provisional: Provisional) -> Provisional:
    """Have a part of many points looked at meanwhile; return what the first round tells.

    It says what will probably be found, long before a round of all points does.
    """
    table, told = inputs.observations, Event()
    frames, landmarks = np.unique(table.frame), np.unique(table.landmark)
    step = round(np.sqrt(len(table) / _FIRST_LOOK))
    every = max(min(step, len(frames) // _FIRST_LOOK_FRAMES), 1)

    def look() -> None:
        part = np.isin(table.landmark, landmarks[::step]) & np.isin(table.frame, frames[::every])
        some = table.take(np.flatnonzero(part))
        # What cannot be solved has no first look; the whole says why.
        with suppress(FisheyeSvpError, np.linalg.LinAlgError):
            problem, _ = prepare_problem(replace(inputs, observations=some, held_out=None))
            names = first_causes(problem)
            if not told.is_set():
                provisional(names)

    def tell_of_round(names: tuple[str, ...]) -> None:
        told.set()
        provisional(names)

    if step > 1:
        Thread(target=look, daemon=True).start()
    return tell_of_round


def diagnose_against(
    observations: Observations,
    other: Observations,
    lens: Lens | Mapping[str, Lens],
    *,
    options: DiagnosisOptions | None = None,
    progress: Progress = lambda *_: None,
    free_intrinsics: bool | None = None,
    **settings: Any,
) -> Diagnosis:
    """Diagnose a data set, and ask another one of the same camera whether the lens's causes hold.

    other: its target may be another one; the rest as in `diagnose`.  Causes of the lens that the
    other set refutes are given up; what both lenses predict of it is measured.
    Raises ObservationError for data sets of several cameras, and what `diagnose` raises.
    """
    for table in (observations, other):
        if len(np.unique(table.camera)) > 1:
            raise ObservationError(
                f'{table.source}: two data sets of one camera are compared; '
                'choose the rows of one camera'
            )
    check_distinct(observations, other)
    options = options or DiagnosisOptions()

    def diagnose_one(
        table: Observations,
        options: DiagnosisOptions,
        begin: float,
        end: float,
        prefix: str = '',
        **settings: Any,
    ) -> Diagnosis:
        return diagnose(
            table,
            lens,
            free_intrinsics=free_intrinsics,
            options=options,
            progress=lambda stage, done: progress(prefix + stage, begin + done * (end - begin)),
            **settings,
        )

    found = diagnose_one(observations, options, 0.0, 0.35, **settings)
    second = diagnose_one(other, options, 0.35, 0.7, 'the other set: ')
    progress('validating each data set by the other', 0.7)
    models = [
        DatasetModel(answer.evaluation.simulation, answer.evaluation.null)
        for answer in (found, second)
    ]
    datasets = compare_datasets(models[0], models[1], observations.source, other.source)
    gone = tuple(name for name in datasets.refuted_causes if name not in options.included)
    if gone:
        found = diagnose_one(
            observations,
            options.leave_out(*gone),
            0.7,
            0.85,
            'without what the other set refutes: ',
            **settings,
        )
        datasets = replace(datasets, withdrawn=gone)
    given = next(iter(rig_lenses(observations, lens).values()))
    travel = measure_travel(second.evaluation.null.linear.data, given, found.lens)
    datasets = replace(datasets, travel=travel)
    return replace(found, against=datasets)


class _EvaluationResult(NamedTuple):
    """What the stages up to the evaluation return.

    of_robot: the poses are those of a flange; turned: views that were put in the order of the
    other cameras.
    """

    evaluation: Evaluation
    candidates: list[Finding]
    cameras: list[TwoCameras]
    of_robot: bool
    turned: tuple[TurnedFrame, ...]


def _run_stages(inputs: Inputs, progress: Progress) -> Diagnosis:
    """Take checked inputs through all stages, twice where frames were in another order."""
    evaluated = _evaluate(inputs, progress)
    # The problem of a robot has no poses any more.
    observations = evaluated.evaluation.problem.observations
    inputs, views = replace(inputs, observations=observations), evaluated.turned
    # Beside a large effect that is held back, offsets of landmarks are no sign of another order.
    turned = (
        []
        if inputs.poses is not None or _holds_back(evaluated.candidates)
        else find_turned_frames(evaluated.evaluation.null, evaluated.evaluation.fitted)
    )
    if any(one.corrected for one, _ in turned):
        table = turn_frames(inputs.observations, turned)
        evaluated = _evaluate(replace(inputs, observations=table), progress)
    found = _conclude(evaluated.evaluation, evaluated.candidates, evaluated.cameras)
    frames = (*views, *(one for one, _ in turned))
    found = replace(
        found,
        advice=[*turn_advice(frames), *found.advice],
        turned=frames,
    )
    if inputs.poses is None or not evaluated.of_robot:
        return found
    hand_eye = find_hand_eye(found.evaluation.fixed_model, inputs.poses)
    return replace(found, hand_eye=hand_eye)


def _evaluate(inputs: Inputs, progress: Progress) -> _EvaluationResult:
    """Take checked inputs through the stages up to the evaluation of confirmed causes."""
    progress('fitting the simulation as it is', 0.0)
    problem, of_robot = prepare_problem(inputs)
    turned = find_turned_views(problem) if problem.inputs.poses is None else []
    if turned:
        table = turn_frames(inputs.observations, turned)
        problem, of_robot = prepare_problem(replace(inputs, observations=table))
    medium = find_medium(problem, progress)
    if medium is not None:
        problem = behind_port(problem, medium)
    selection = select_causes(problem, progress)
    if medium is not None and (thinner := medium.without_glass(selection.null)) is not None:
        # What stood in for a cause was no glass.
        medium = thinner
        selection = select_causes(behind_port(problem, medium), progress)
    selection, cameras = agree_on_target(selection, progress)
    progress('measuring the gain on held-out data', 0.8)
    evaluation, candidates = _confirm(selection, medium)
    return _EvaluationResult(
        evaluation, candidates, cameras, of_robot, tuple(one for one, _ in turned)
    )


def _conclude(
    evaluation: Evaluation, candidates: list[Finding], cameras: list[TwoCameras]
) -> Diagnosis:
    """Return the diagnosis of an evaluated selection."""
    evaluation.prepare_conclusion()
    selection, averaged = evaluation.selection, evaluation.averaged_model
    problem, observations = selection.problem, selection.problem.observations
    noise_causes = growth_cause(selection.revision.growth)
    noise_causes += table_causes(observations, selection.revision.outliers, problem.step)
    components = evaluation.components({c.effect: c.p_value for c in noise_causes})
    causes = evaluation.causes(components) + noise_causes
    significant = significant_components(components)
    lenses = with_uncertainty(
        evaluation.model_errors,
        averaged.linear,
        evaluation.noise_px,
        evaluation.uncertainty['image_px']['misfit'],
        evaluation.extended_lenses,
    )
    known = evaluation.posterior.probabilities
    candidates = [replace(one, posterior=known.get(one.effect)) for one in candidates]
    advice = advise(evaluation, causes, significant, _holds_back(candidates))
    conclusion = conclude(
        evaluation,
        causes,
        components,
        advice,
        candidates,
        any(pair.verdict == 'contradict' for pair in cameras),
    )
    field = evaluation.written_field
    for camera, (name, lens) in enumerate(lenses.items()):
        lens = conclusion.with_ray_error(averaged.with_entry(lens, name), name)
        lenses[name] = lens if field is None else field.add_to(lens, camera)
    return Diagnosis(
        **vars(conclusion),
        evaluation=evaluation,
        figures=evaluation.figures,
        noise_px=evaluation.noise_px,
        components=components,
        causes=causes,
        remaining=_remaining(evaluation, noise_causes, significant),
        advice=advice_on_lens(advice, conclusion),
        lenses=lenses,
        trace=list(selection.trace),
        untestable=EffectTests(selection.first).untestable,
        gross=_outliers(evaluation),
        cameras=cameras,
        turned=(),
    )


def _outliers(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Return the outliers of the data and of held-out data, as diagnosis.json has them."""
    selection = evaluation.selection
    rows = outlier_rows(selection.problem.observations, selection.revision.outliers)
    table, test = selection.problem.inputs.held_out, evaluation.held_out
    if table is not None and test is not None:
        rows += outlier_rows(table, test.outliers, 'held out: ')
    return rows


def _remaining(
    evaluation: Evaluation, noise_causes: Sequence[Cause], components: Sequence[Component]
) -> list[Structure]:
    """Return what residuals still depend on."""
    selection = evaluation.selection
    observations = selection.problem.observations
    # The weights are relative where the noise itself is a cause: sigma is no longer tested.
    stated = bool(np.isfinite(observations.sigma).all()) and not noise_causes
    remaining = remaining_structure(
        EffectTests(selection.null), evaluation.fitted, components, stated
    )
    remaining = add_outliers(remaining, selection.revision.outliers, len(observations))
    hidden = {name for cause in noise_causes for name in cause.effect_class.hidden_structure}
    return [structure for structure in remaining if structure.variable not in hidden]


def _weakest_cause(evaluation: Evaluation) -> tuple[ModelTerm, Finding] | None:
    """Return the cause that is confirmed least and why it is not, if there is one."""
    doubts = [doubt for part in _evidence(evaluation) if (doubt := find_doubt(part))]
    if not doubts:
        return None
    cause, reason, z, rival = min(doubts, key=lambda doubt: doubt.z)
    effect = cause.effect
    tests = EffectTests(evaluation.null)
    p_value = tests.test_removal(evaluation.null.included_columns, cause.columns, effect).p_value
    return cause, Finding(
        form=effect.key,
        reason=reason,
        p_value=p_value,
        p_corrected=tests.correct(effect, p_value),
        parameters=parameters_of(cause, evaluation.errors),
        rival=rival,
        z=z,
    )


def _evidence(evaluation: Evaluation) -> Iterator[Evidence]:
    """Yield what is known of each cause that is to be confirmed."""
    selection, null = evaluation.selection, evaluation.null
    tests, full = EffectTests(null), cross_validate(null)
    kept = full.is_predictable
    confounded = [
        (term.name, term.columns, confounded_effects(tests, evaluation.posterior, term))
        for term in null.terms
        if not term.effect.per_frame
    ]
    predicted = None if evaluation.held_out is None else evaluation.predict()
    for cause in selection.causes:
        name = cause.name
        if name not in selection.problem.options.included and not cause.effect.per_frame:
            z = _gain_in_sigmas(cross_validate(null, [name]).take(kept), full.take(kept))
            yield _HeldOutEvidence(cause, len(kept), z, evaluation, predicted, tests, confounded)


@dataclass(frozen=True)
class _HeldOutEvidence:
    """The `Evidence` of an evaluation for a cause.

    predicted: the file that was held out, if any, by all causes; confounded: as of `find_rival`.
    """

    cause: ModelTerm
    frames: int
    z: float
    evaluation: Evaluation
    predicted: HeldOut | None
    tests: EffectTests
    confounded: Sequence[tuple[str, Index, list[str]]]

    def z_of_file(self) -> float | None:
        evaluation, effect = self.evaluation, self.cause.effect
        if self.predicted is None or evaluation.held_out is None:
            return None
        z = _gain_in_sigmas(evaluation.predict([self.cause.name]), self.predicted)
        times = (
            one.observations.t for one in (evaluation.held_out.data, self.tests.null.linear.data)
        )
        return z if z > 0 or effect.is_refutable_by(*times) else None

    def adds_density(self) -> bool:
        """See `Evidence`: the sum of squares may be one frame's doing, of few, or a near one."""
        cause = self.cause
        rest = np.setdiff1d(self.tests.null.included_columns, cause.columns)
        return self.tests.held_out_gain(rest, cause.columns, cause.effect).sufficient

    def find_rival(self) -> tuple[Reason | None, Rival | None]:
        return find_rival(self.tests, self.cause, self.confounded)


def _gain_in_sigmas(before: HeldOut, after: HeldOut) -> float:
    """Return by how much the sum of squares falls, over its error over the frames."""
    change, count = before.squares - after.squares, len(before.squares)
    error = float(change.std(ddof=1) * np.sqrt(count)) if count > 1 else np.inf
    return float(change.sum()) / max(error, 1e-300)


def find_rival(
    tests: EffectTests, cause: ModelTerm, confounded: Sequence[tuple[str, Index, list[str]]]
) -> tuple[Reason | None, Rival | None]:
    """Return which effect in the place of another cause makes this one needless, and how.

    confounded: name, columns and confounded effects of each term of the model.
    """
    null, columns = tests.null, cause.columns
    for other, theirs, names in confounded:
        if other == cause.name or not names:
            continue
        rest = np.setdiff1d(null.included_columns, np.concatenate([columns, theirs]))
        # One with as many parameters as both causes explains nothing more simply than they do.
        for form in tests.likeliest_forms(rest, names, len(theirs) + len(columns) - 1):
            beside = np.concatenate([rest, null.form_columns(form.form)])
            rival = Rival(form.effect.name, other)
            p_value = tests.score_beside(beside, columns).p_value
            if tests.correct(cause.effect, p_value) > SIGNIFICANCE:
                return Reason.NEEDLESS_BESIDE_RIVAL, rival
            if not tests.held_out_gain(beside, columns, cause.effect).sufficient:
                return Reason.NO_GAIN_BESIDE_RIVAL, rival
    return None, None


def _holds_back(candidates: Sequence[Finding]) -> bool:
    """Say whether an effect is held back for its size: frames scatter by what it leaves."""
    return any(candidate.reason is Reason.IMPLAUSIBLE for candidate in candidates)


def _confirm(selection: Selection, medium: Medium | None) -> tuple[Evaluation, list[Finding]]:
    """Take out causes that are not confirmed, the weakest first; fit the rest anew each time."""
    candidates: dict[str, Finding] = {}
    while True:
        evaluation = Evaluation.of_selection(selection, medium)
        weakest = _weakest_cause(evaluation)
        if weakest is None:
            return evaluation, _add_refused_causes(selection, candidates)
        cause, finding = weakest
        candidates[cause.name] = finding
        selection = without_cause(selection, cause.name)
        if finding.status is Status.REFUTED or is_implausible(cause):
            selection = replace(selection, refuted=(*selection.refuted, cause.name))


def _add_refused_causes(selection: Selection, found: Mapping[str, Finding]) -> list[Finding]:
    """Return also what was significant in the selection and did not predict better."""
    known = {cause.name for cause in selection.causes}
    every = dict(found)
    alone = selection.null.linear.data.frames < 2
    reason = Reason.NO_OTHER_FRAME if alone else Reason.NO_GAIN
    for step in selection.trace:
        if step.reason is Reason.NO_CONVINCING_GAIN and step.effect not in known:
            every.setdefault(step.effect, replace(step, reason=reason))
    return list(every.values())
