"""Every function of the library says what it takes and what it returns."""

from __future__ import annotations

import inspect

import pytest

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.simulate.scenario import Scenario

FUNCTIONS = [name for name in fsvp.__all__ if not isinstance(getattr(fsvp, name), type)]


@pytest.mark.parametrize('name', FUNCTIONS)
def test_a_signature_can_be_read(name: str) -> None:
    signature = inspect.signature(getattr(fsvp, name))
    assert signature.return_annotation is not inspect.Signature.empty
    for one in signature.parameters.values():
        assert one.annotation is not inspect.Parameter.empty, one
        assert one.kind is not inspect.Parameter.VAR_KEYWORD and one.name != 'args'


def test_keywords_of_a_scenario_are_its_parameters() -> None:
    keywords = inspect.signature(fsvp.simulate_scenario).parameters
    assert {name: one.default for name, one in keywords.items()} == vars(Scenario())
