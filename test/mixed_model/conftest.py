"""Models that dense algebra holds, too."""

import pytest
from helpers.mixed_models import mixed_model


@pytest.fixture(scope='session', params=[True, False], ids=['by group', 'by unit'])
def model(request):
    """Return a model in which groups, or units, are the eliminated blocks."""
    made = mixed_model(request.param)
    assert made.equations().by_group == request.param
    return made
