"""The verdict of a diagnosis in one line."""

from __future__ import annotations

from fisheye_svp_ros.diagnosis import Diagnosis

VERDICTS = {
    'adequate': 'Adequate: the simulation describes these data',
    'explained': 'Explained: what is wrong has a name',
    'partly_explained': 'Partly explained: something remains without a name',
    'unexplained': 'Unexplained: something is wrong that no effect accounts for',
}


def headline(d: Diagnosis) -> str:
    """Return the verdict; points that are set aside and nothing else are no riddle."""
    if not only_gross(d):
        return VERDICTS[d.verdict]
    count = len(d.gross)
    rest = f'{count} points lie far off' if count > 1 else 'a point lies far off'
    if d.causes:
        return f'Partly explained: {rest}, all else that is wrong has a name'
    return f'Unexplained: {rest}, and these data show nothing else wrong'


def only_gross(d: Diagnosis) -> bool:
    """Say whether all that remains is points that were set aside, by name."""
    return bool(d.gross) and {one.variable for one in d.remaining} == {'outliers'}
