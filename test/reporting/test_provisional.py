"""The provisional answer, and what has become of it."""

from types import SimpleNamespace

from fisheye_svp_ros.diagnosis import Finding, Reason
from fisheye_svp_ros.reporting.wording.first_screen import headline_changes, provisional_headline


def answer(*names: str, candidates: tuple[Finding, ...] = ()) -> SimpleNamespace:
    causes = [SimpleNamespace(effect=name) for name in names]
    return SimpleNamespace(causes=causes, trace=[], candidates=[*candidates])


def test_the_first_cause_is_the_headline() -> None:
    assert provisional_headline(()) == 'Provisional: no model error found yet'
    said = provisional_headline(('viewpoint_shift', 'skew', 'skew'))
    assert said == 'Provisional: The viewpoint of the lens shifts with the angle (also skew)'


def test_what_has_changed_since_is_said() -> None:
    assert headline_changes(('skew',), answer('skew')) == []
    refuted = Finding(form='skew', reason=Reason.REFUTED_BY_FRAMES, p_value=0.0, p_corrected=0.0)
    assert headline_changes(('skew',), answer('aspect', candidates=(refuted,))) == [
        'Since the provisional answer: found: aspect; not confirmed: skew (held-out frames refute '
        'it).'
    ]
