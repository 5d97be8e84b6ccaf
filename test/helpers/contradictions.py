"""What in a diagnosis contradicts what: its document, and the lines that are read first."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from math import isnan
from typing import Any

from fisheye_svp_ros.diagnosis import Diagnosis, FlawKind
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.reporting.wording.first_screen import first_screen, terminal_lines

Document = Mapping[str, Any]
ROUNDING = 1e-9
# What the line of the lens starts with.
LENS = {
    'keep': r'Use (this lens|these lenses)( \(|$)',
    'use_extended': r'Use (extended_lens\.yaml|the extended lenses)',
    'recalibrate': 'Do not use (this lens|these lenses);',
    'undecided': 'Use (this lens|these lenses) only w|Do not use (this lens|these lenses) yet|'
    'Do not use a lens calibrated from these data',
}
# Status: least and largest probability.
RANGES = {
    'confirmed': (0.95, 1.0),
    'likely': (0.5, 1.0),
    'refuted': (0.0, 0.5),
    'not needed': (0.0, 0.5),
}


def check(found: Diagnosis) -> None:
    """Assert that nothing in a diagnosis contradicts anything else."""
    check_document(
        diagnosis_document(found), '\n'.join(terminal_lines(first_screen(found, 'table')))
    )


def check_document(document: Document, screen: str) -> None:
    """Assert that nothing in diagnosis.json contradicts anything else, or the first screen."""
    found = [*contradictions(document), *_screen(document, screen)]
    assert not found, '\n'.join([*found, screen])


def contradictions(document: Document) -> Iterator[str]:
    """Yield what contradicts what in diagnosis.json."""
    for part in (_beliefs, _confounded, _lens, _target, _adequacy, _intervals, _bounds):
        yield from part(document)


def _beliefs(document: Document) -> Iterator[str]:
    causes, candidates = document['causes'], document['candidates']
    for entry in (*causes, *candidates):
        low, high = RANGES[entry['status']]
        if not low <= entry['probability'] <= high:
            yield f'{entry["effect"]} is {entry["status"]} at {entry["probability"]:.2f}'
    names = [cause['effect'] for cause in causes]
    if set(names) & {entry['effect'] for entry in candidates}:
        yield f'{names}: both a cause and not confirmed'
    if set(names) & {entry['effect'] for entry in document['untestable']}:
        yield f'{names}: both a cause and untestable'
    for entry in candidates:
        if entry['status'] == 'confirmed':
            yield f'{entry["effect"]} is confirmed and a candidate'
    for cause in causes:
        if cause['status'] != 'confirmed':
            continue
        if _moves_predictions(cause) and not cause['gain'] > 0:
            yield f'{cause["effect"]} is confirmed and gains {cause["gain"]:.3f}'
        if all(abs(one['value']) < one['stderr'] for one in cause['parameters'].values()):
            yield f'{cause["effect"]} is confirmed, and within its error'
    for written in document['lens'].get('averaged_effects', []):
        if written['effect'] in names:
            yield f'{written["effect"]} is a cause, and written without being one'


def _moves_predictions(cause: Mapping[str, Any]) -> bool:
    rms = cause['heldout_rms_px']
    return rms is not None and not isnan(rms)


def _confounded(document: Document) -> Iterator[str]:
    causes = {cause['effect'] for cause in document['causes']}
    for cause in document['causes']:
        alike, odds = set(cause['indistinguishable_from']), cause.get('odds')
        names = {cause['effect'], *alike}
        told = names <= {*odds} <= {*names, 'frame_sag'} if odds else True
        if not told or (odds and abs(sum(odds.values()) - 1) > 1e-9):
            yield f'{cause["effect"]} or {alike}: {odds}'
        if alike & causes:
            yield f'{cause["effect"]} is not told from {alike & causes}, a cause too'


def _lens(document: Document) -> Iterator[str]:
    lens, file = document['decision']['lens'], document['file']
    causes, say = document['causes'], lens['say']
    rays = document['lens']['ray_error_mrad']
    if say == 'use_extended':
        halves = rays and all(
            after['value'] < before['value']
            for before, after in zip(rays['given'], rays['extended'], strict=True)
        )
        if not (file['low'] > 0 or (file['gain'] > 0 and halves)):
            yield f'offered, with a gain of {file["gain"]:.2f} from {file["low"]:.2f} on'
    if say == 'keep':
        if any(CATALOGUE[one['effect']].budget_stage() == 'lens' for one in causes):
            yield 'the lens is kept beside a cause in it'
        costs = {one['effect']: one['edge_mrad'] for one in lens['bound']}
        for entry in (*document['candidates'], *document['lens'].get('averaged_effects', [])):
            effect, likely = entry['effect'], entry['probability'] > 0.5
            of_lens = CATALOGUE[effect].budget_stage() == 'lens'
            if likely and of_lens and costs[effect] > 1.0:
                yield f'the lens is kept beside a likely {effect} that costs over 1 mrad'
    if say == 'recalibrate' and lens['figure']['name'] == 'ray_error' and rays:
        most = max(one['value'] for one in rays['given'] if one['range_m'] == 1.0)
        if lens['figure']['value'] > most:
            yield f'off by at least {lens["figure"]["value"]:.2g}, expected {most:.2g} mrad'
    offered = [one for one in document['advice'] if 'extended lens file' in one['what']]
    if offered and say not in ('use_extended', 'recalibrate'):
        yield f'advice {offered[0]["what"]!r} beside {say}'
    explained = document['verdict'] in ('explained', 'partly_explained')
    if explained != (bool(causes) or say == 'recalibrate') and not document['adequacy']:
        yield f'{document["verdict"]} with causes {[one["effect"] for one in causes]}, {say}'
    told = document['frames'] > 1 and not document['adequacy']
    if document['verdict'] == 'adequate' and say == 'undecided' and told:
        yield 'adequate, and the lens is undecided'


def _target(document: Document) -> Iterator[str]:
    say = document['decision']['target']['say']
    there = [
        one['effect']
        for one in document['causes']
        if CATALOGUE[one['effect']].budget_stage() == 'target'
    ]
    if say == 'correct' and not there:
        yield 'the target is corrected, and no cause is in it'
    if say == 'keep' and there:
        yield f'the target is kept beside {there}'
    photographs = document['decision']['photographs']['say']
    if photographs == 'enough' and document['decision']['lens']['say'] == 'undecided':
        yield 'enough photographs, and the lens is undecided'


def _adequacy(document: Document) -> Iterator[str]:
    if not document['adequacy']:
        return
    for name, one in document['decision'].items():
        if one['say'] in ('keep', 'enough') or one.get('bound') or one['confidence'] is not None:
            yield f'inadequate data, and {name}: {one["say"]}, {one["confidence"]}'


def _intervals(document: Document) -> Iterator[str]:
    rays = document['lens']['ray_error_mrad']
    sides = [one for side in ('given', 'extended') for one in rays.get(side, [])]
    for one in (document['gain'], *sides):
        if not one['low'] - ROUNDING <= one['value'] <= one['high'] + ROUNDING:
            yield f'{one} is outside its interval'
    file = document['file']
    if not file['low'] - ROUNDING <= file['gain'] <= file['high'] + ROUNDING:
        yield f'{file} is outside its interval'
    if (file['gain'] > 0) != (file['extended_px'] < file['given_px']) and abs(
        file['gain']
    ) > ROUNDING:
        yield f'{file}: gain and errors differ in sign'


def _bounds(document: Document) -> Iterator[str]:
    causes = {one['effect'] for one in document['causes']}
    for bound in document['decision']['lens'].get('bound', []):
        if bound['effect'] in causes:
            yield f'{bound["effect"]} is a cause, and bounded'
        if bound['effect'] == 'viewpoint_shift':
            for written in document['lens'].get('averaged_effects', []):
                e0 = written['parameters'].get('e0', {'value': 0.0})['value']
                if abs(e0) > bound['value']:
                    yield f'a shift of {e0:.2g}, at most {bound["value"]:.2g} m'


def _line(screen: str, head: str) -> str:
    return screen.partition(head)[2].partition('. ')[0]


def _screen(document: Document, screen: str) -> Iterator[str]:
    """Yield where the first screen says something else than the document."""
    screen, say = ' '.join(screen.split()), document['decision']['lens']['say']
    line = _line(screen, 'Lens: ')
    for answer, words in LENS.items():
        if bool(re.match(words, line)) != (answer == say):
            yield f'{say}, and the screen {"has" if answer != say else "lacks"} {words!r}'
    beside_bounds = screen.replace('95 % sure', '')
    if document['adequacy'] and ('Enough' in screen or '% sure' in beside_bounds):
        yield 'inadequate data, and the screen reassures'
    causes = re.split(
        'Against the (?:truth|target):|Not confirmed:|Next:', screen.partition('Causes:')[2]
    )[0]
    misfit = any(FlawKind[one['flaw'].upper()].is_misfit for one in document['adequacy'])
    if misfit and causes:
        yield 'no cause can be trusted in such data, and the screen names some'
    for cause in () if misfit else document['causes']:
        if cause['effect'] not in causes:
            yield f'{cause["effect"]} is not among the causes of the screen'
        if cause['status'] != 'confirmed' and f'{cause["status"]}, ' not in causes:
            yield f'{cause["effect"]} is {cause["status"]}, which the screen does not say'
    for entry in document['candidates']:
        for word in re.findall(
            rf'(\w+)(?: \([^)]*\))? but not confirmed[^:]*: {entry["effect"]}', screen
        ):
            if entry['status'] == 'refuted':
                yield f'{entry["effect"]} is refuted and {word}'
            if word.lower() == 'likely' and entry['probability'] < 0.5:
                yield f'{entry["effect"]} is {word} at {entry["probability"]:.2f}'
    for written in document['lens'].get('averaged_effects', []):
        name, chance = written['effect'], written['probability']
        if chance < 0.5 and re.search(f'ikely[^;]* not confirmed[^:]*: {name}', screen):
            yield f'{name} of probability {chance:.2f} is likely'
