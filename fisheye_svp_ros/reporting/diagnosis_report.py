"""The report of a diagnosis: one self-contained HTML page, and its pictures beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from fisheye_svp_ros.diagnosis import (
    NAMED_P,
    Comparison,
    Diagnosis,
    Finding,
    map_lens_rays,
    stage_shares,
)
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.target_map import BoardMap
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.planning.plan import NextViews
from fisheye_svp_ros.reporting.blocks import data_uri, page, png_uri
from fisheye_svp_ros.reporting.diagnosis_plots import PlotData, residual_pictures
from fisheye_svp_ros.reporting.evidence_plots import draw_evidence, draw_target
from fisheye_svp_ros.reporting.ray_plots import draw_uncertainty
from fisheye_svp_ros.reporting.shot_plots import draw_shots
from fisheye_svp_ros.reporting.terminal import draw_or_note
from fisheye_svp_ros.reporting.wording import shots
from fisheye_svp_ros.reporting.wording.actions import photographs_reason, photographs_words
from fisheye_svp_ros.reporting.wording.causes import (
    bare_probability,
    belief,
    budget_rows,
    cause_rows,
    describe_effect,
    finding_reason,
    intrinsic_rows,
    outlier_rows,
    percent,
    quantity,
    uncertainty_rows,
)
from fisheye_svp_ros.reporting.wording.decisions import separation
from fisheye_svp_ros.reporting.wording.diagnosis import (
    CAPTIONS,
    STAGE_WORDS,
    VARIABLES,
    advice_text,
    count_frames,
    frame_ranges,
    join_names,
    known_rows,
    lens_contents,
    refusal_reason,
    remaining_text,
    verdict_sentences,
)
from fisheye_svp_ros.reporting.wording.external import (
    CARRIED_HEADER,
    sections,
)
from fisheye_svp_ros.reporting.wording.first_screen import first_screen
from fisheye_svp_ros.reporting.wording.headline import tone, verdict_words
from fisheye_svp_ros.reporting.wording.next_steps import (
    ReportInputs,
    follow_up_files,
    next_step,
)

_PICTURE_OF = {
    'image': 'field',
    'theta': 'theta',
    'range': 'range',
    'landmark': 'landmark',
    'frame': 'frame',
    'time': 'frame',
    'pixel_phase': 'phase',
    'outliers': 'histogram',
    'scatter_vs_theta': 'theta',
    'scatter_vs_frame': 'frame',
    'size': 'histogram',
}
_QUICK_PICTURES = ('field', 'theta', 'range')  # beside those of what remains
_BAR = 220  # px of a share of 1
_ROWS = 24
_STRIPE = 5e-4  # of the variance: what is less is not drawn


def write_report(
    diagnosis: Diagnosis,
    known: Mapping[str, Comparison],
    inputs: ReportInputs,
    wanted: NextViews | None = None,
) -> list[Path]:
    """Write report.html and its pictures into a folder; return the files.

    wanted: the photographs to take next, if they were asked for.
    Raises OutputError where one cannot be written.
    """
    pictures, narrow = [], {}
    for name, draw, arguments in _picture_tasks_of(diagnosis, wanted):
        path, below = inputs.folder / f'{name}.png', BytesIO()
        if draw_or_note(path, _draw_both, below, draw, arguments):
            pictures.append(path)
            narrow[name] = png_uri(below.getvalue())
    drawn = {p.stem: data_uri(p) for p in pictures}
    report = inputs.folder / 'report.html'
    write_text(
        report,
        page(
            'diagnosis.html',
            d=diagnosis,
            inputs=inputs,
            percent=percent,
            significance=NAMED_P,
            moving=any(cause.effect_class.stage != 'noise' for cause in diagnosis.causes),
            removed=diagnosis.evaluation.gains['named'],
            screen=first_screen(diagnosis, inputs.observations, known),
            step=next_step(diagnosis, inputs),
            verdict=verdict_words(diagnosis),
            tone=tone(diagnosis),
            sentences=verdict_sentences(diagnosis, known),
            pictures={**dict.fromkeys(('target', 'evidence', 'next', 'uncertainty')), **drawn},
            narrow=narrow,
            shown=[(name, text) for name, text in CAPTIONS.items() if name in drawn],
            **_cause_rows(diagnosis),
            **_budget(diagnosis),
            **_evidence_section(diagnosis),
            **_remaining_structures(diagnosis),
            next={}
            if wanted is None
            else {
                'purpose': shots.purpose(wanted),
                'header': shots.HEADER,
                'rows': shots.rows(wanted),
            },
            uncertainty=list(uncertainty_rows(diagnosis)),
            known=list(known_rows(diagnosis, known)),
            free=_free(inputs, diagnosis),
            external=sections(diagnosis),
            carried_header=CARRIED_HEADER,
            contents=lens_contents(diagnosis),
            count=count_frames(diagnosis),
            extended=follow_up_files(diagnosis, inputs),
            not_offered=refusal_reason(diagnosis),
        ),
    )
    return [report, *pictures]


def _draw_both(
    path: Path, below: BytesIO, draw: Callable[..., None], arguments: Sequence[Any]
) -> None:
    """Draw a picture into a file, and its panels one below the other for a narrow window."""
    draw(path, *arguments)
    draw(below, *arguments, narrow=True)


def _picture_tasks_of(
    diagnosis: Diagnosis, wanted: NextViews | None
) -> Iterator[tuple[str, Callable[..., None], Sequence[Any]]]:
    """Yield the pictures: name, what draws it into a file, arguments."""
    quick = diagnosis.evaluation.problem.options.quick
    remaining = {_PICTURE_OF.get(structure.variable) for structure in diagnosis.remaining}
    for name, draw, arguments in residual_pictures(PlotData.from_evaluation(diagnosis.evaluation)):
        if not quick or name in _QUICK_PICTURES or name in remaining:
            yield name, draw, arguments
    if diagnosis.trace and not quick:
        yield 'evidence', draw_evidence, (diagnosis,)
    maps = [] if quick else list(_target_maps(diagnosis))
    if maps:
        yield 'target', draw_target, (maps,)
    if rays := map_lens_rays(diagnosis.evaluation):
        yield 'uncertainty', draw_uncertainty, (rays,)
    if wanted is not None:
        state = diagnosis.evaluation.fixed_model.state
        yield 'next', draw_shots, (ForwardModel(state.lens, state.terms), wanted)


def _target_maps(diagnosis: Diagnosis) -> Iterator[tuple[str, BoardMap]]:
    """Yield maps of the boards where landmarks are displaced other than all together."""
    mapped = [c.effect for c in diagnosis.causes if c.effect_class.target_map]
    shown: list[tuple[str, tuple[str, ...]]] = []
    if mapped:
        shown.append(('the target in the extended model', ()))
    if len(mapped) > 1:
        shown += [
            (f'{name} alone', (name,)) for name in mapped if CATALOGUE[name].target_map == 'smooth'
        ]
    for title, names in shown:
        yield from ((title, m) for m in diagnosis.board_maps(names) if m.spans_plane)


def _free(inputs: ReportInputs, diagnosis: Diagnosis) -> str:
    free = {
        'poses': diagnosis.evaluation.fixed_model.data.poses is None,
        'intrinsics': inputs.free_intrinsics,
    }
    return join_names([name for name, fitted in free.items() if fitted]) or 'nothing'


def _cause_rows(diagnosis: Diagnosis) -> dict[str, Any]:
    causes = []
    for cause, row in zip(diagnosis.causes, cause_rows(diagnosis), strict=True):
        fields = dict(
            zip(('effect', 'size', 'p', 'share', 'rms', 'gain', 'same'), row, strict=True)
        )
        shown = list(cause.parameters.items())[:_ROWS]
        causes.append(
            {
                **fields,
                'what': describe_effect(cause.effect),
                'belief': belief(cause.status, cause.probability),
                'to_separate': separation(cause) if cause.indistinguishable_from else '',
                'refuted': frame_ranges(diagnosis, cause.refuted_by_frames),
                'parameters': [
                    (
                        name,
                        quantity(entry),
                        f'{entry["value"]:.6g} {entry["unit"]}'.removesuffix(' 1'),
                    )
                    for name, entry in shown
                ],
                'count': len(cause.parameters),
            }
        )
    stages = {cause.effect_class.stage for cause in diagnosis.causes}
    return {'causes': causes, 'on_target': 'target' in stages}


def _evidence_section(diagnosis: Diagnosis) -> dict[str, Any]:
    withdrawn = {candidate.effect: finding_reason(candidate) for candidate in diagnosis.candidates}
    return {
        'steps': [_step_row(step, withdrawn) for step in diagnosis.trace],
        'tested': len(CATALOGUE) - len(diagnosis.untestable),
    }


def _step_row(step: Finding, withdrawn: Mapping[str, str]) -> dict[str, Any]:
    """Return a row of the evidence; withdrawn: why accepted effects were not confirmed."""
    why = withdrawn.get(step.effect) if step.is_accepted else None
    reason = finding_reason(step)
    tried = step.statistic > 0
    held_out = ''
    if math.isfinite(step.held_out):
        held_out = f'{step.held_out:.1f} ± {step.held_out_stderr:.1f}'
    return {
        'effect': step.form,
        'accepted': step.is_accepted and not why,
        'why': f'{reason}; not confirmed: {why}' if why else reason,
        'rank': step.rank if tried else '',
        'explains': f'{step.statistic:.1f}' if tried else '',
        'p': bare_probability(step.p_corrected) if tried else '',
        'held_out': held_out,
    }


def _budget(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the bars of the budget: stage, percent without and with a name, the names."""
    shares = stage_shares(diagnosis.components)
    names = {
        stage: ', '.join(cause.effect for cause in diagnosis.causes if cause.stage == stage)
        for stage in shares
    }
    total = diagnosis.figures.base.rms_px**2
    return {
        'bars': [
            (stage, STAGE_WORDS[stage], 100 * (share - named), 100 * named, names[stage])
            for stage, (share, named) in shares.items()
        ],
        'striped': join_names(
            [
                cause.effect
                for cause in diagnosis.causes
                if shares.get(cause.stage, (0.0, 0.0))[1] > _STRIPE
            ]
        ),
        'total_px2': f'{total:.3g}',
        'budget_rows': list(budget_rows(diagnosis)),
        'intrinsics': list(intrinsic_rows(diagnosis)),
        'advice': _flaw_advice(diagnosis)
        + [
            (advice_text(advice), percent(advice.gain) if advice.gain > 0 else '')
            for advice in diagnosis.advice
        ],
    }


def _flaw_advice(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Return what to do about photographs that are no ground for an answer, as on the screen."""
    if not diagnosis.adequacy.flaws:
        return []
    words = photographs_words(diagnosis)
    return [(f'{words[0].lower()}{words[1:]}: {photographs_reason(diagnosis)}', '')]


def _remaining_structures(diagnosis: Diagnosis) -> dict[str, Any]:
    strongest = sorted(diagnosis.remaining, key=lambda structure: -structure.share)
    return {
        'remaining': [
            {
                'words': remaining_text(diagnosis, s.variable),
                'link': _PICTURE_OF.get(s.variable),
                'p': bare_probability(s.p_value),
                'share': percent(s.share) if s.variable in VARIABLES else '',
                'width': round(_BAR * min(s.share, 1.0)),
            }
            for s in {s.variable: s for s in strongest}.values()
        ],
        'looked_at': join_names(list(VARIABLES.values()), 'or'),
        'untestable': [
            (effect, why, CATALOGUE[effect].signature)
            for effect, why in diagnosis.untestable.items()
        ],
        'outlier_count': len(diagnosis.gross),
        'outliers': outlier_rows(diagnosis.gross)[:_ROWS],
    }
