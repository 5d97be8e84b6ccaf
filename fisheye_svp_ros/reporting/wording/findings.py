"""Why an effect was accepted, is not confirmed, or is not needed; chances, errors in pixels."""

from __future__ import annotations

from fisheye_svp_ros.diagnosis import Cause, Finding, Reason, Status

_CERTAIN = 0.99  # more cannot be said of models and bootstraps

_REASONS = {
    Reason.PREDICTS_BETTER: 'significant and predicts better',
    Reason.BEYOND_BULK: 'further off than the bulk of landmarks',
    Reason.NO_CONVINCING_GAIN: 'does not predict better',
    Reason.EXPLAINED_BY_OTHERS: 'removed: the other causes explain it',
    Reason.NO_LASTING_GAIN: 'removed: it does not predict better any more',
    Reason.REFUTED_BY_FRAMES: 'held-out frames refute it',
    Reason.REFUTED_BY_FILE: 'the held-out file refutes it',
    Reason.NO_GAIN: 'does not improve the prediction of left-out frames',
    Reason.NO_OTHER_FRAME: 'there is no other frame to confirm it',
    Reason.NEEDLESS_BESIDE_RIVAL: 'not significant if {effect} replaces {replaced}',
    Reason.NO_GAIN_BESIDE_RIVAL: 'no significant gain on held-out frames if {effect} replaces '
    '{replaced}',
}


def chance(probability: float) -> str:
    """Return a probability in percent."""
    if probability > _CERTAIN:
        return f'more than {100 * _CERTAIN:.0f} %'
    if probability < 1 - _CERTAIN:
        return f'less than {100 * (1 - _CERTAIN):.0f} %'
    return f'{100 * probability:.0f} %'


def pixels(value: float) -> str:
    """Return an error without its unit: three decimals, or three digits where these say less."""
    return f'{value:.3f}' if 0.0005 <= value < 9.9995 else f'{value:.3g}'


def belief(status: Status, probability: float) -> str:
    """Return status and probability, as the terminal, the report and the node show them."""
    return f'{status.value}, {chance(probability)}'


def with_odds(cause: Cause, name: str) -> str:
    """Return one of the names of a confounded set, with its share in the probability of all."""
    return f'{name} ({chance(cause.odds[name])})' if name in cause.odds else name


def finding_reason(finding: Finding) -> str:
    """Return why, as a clause that begins in lower case and ends without a stop."""
    if finding.reason is Reason.IMPLAUSIBLE:
        size = next(abs(entry['value']) for entry in finding.parameters.values())
        return f'a shift of {1e3 * size:.0f} mm is larger than in any real lens: are lengths in m?'
    rival = finding.rival._asdict() if finding.rival else {}
    return _REASONS[finding.reason].format(**rival)
