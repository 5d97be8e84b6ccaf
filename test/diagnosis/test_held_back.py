"""While a large effect is held back, no frame is renumbered, and none is to be taken again."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from fisheye_svp_ros.diagnosis import conclusion, stages
from fisheye_svp_ros.diagnosis.conclusion import Action, Advice
from fisheye_svp_ros.diagnosis.findings import Reason


@pytest.mark.parametrize('reason', [Reason.IMPLAUSIBLE, Reason.NO_GAIN])
def test_no_frame_is_renumbered_beside_an_implausible_shift(reason, monkeypatch):
    asked = []
    problem = SimpleNamespace(observations=None)
    evaluation = SimpleNamespace(problem=problem, null=0, fitted=0)
    evaluated = SimpleNamespace(
        evaluation=evaluation,
        candidates=[SimpleNamespace(reason=reason)],
        cameras=[],
        of_robot=False,
        turned=(),
    )
    monkeypatch.setattr(stages, '_evaluate', lambda *_: evaluated)
    monkeypatch.setattr(stages, 'replace', lambda one, **_: one)
    monkeypatch.setattr(stages, 'turn_advice', lambda _: [])
    monkeypatch.setattr(stages, 'find_turned_frames', lambda *_: asked.append(1) or [])
    monkeypatch.setattr(stages, '_conclude', lambda *_: SimpleNamespace(advice=[]))
    stages._run_stages(SimpleNamespace(poses=None), lambda *_: None)
    assert bool(asked) == (reason is not Reason.IMPLAUSIBLE)


@pytest.mark.parametrize('held_back', [True, False])
def test_no_frame_is_taken_again_for_what_a_held_back_effect_leaves(held_back, monkeypatch):
    again = Advice(Action.RETAKE, frames=[3])
    monkeypatch.setattr(conclusion, '_retake_frames', lambda _: [again])
    for name in ('_use_causes', '_check_photographs', '_check_held_out'):
        monkeypatch.setattr(conclusion, name, lambda *_: [])
    evaluation = MagicMock(medium=None)
    evaluation.offsets.views = None
    advice = conclusion.advise(evaluation, [], [], held_back)
    assert advice == ([] if held_back else [again])
