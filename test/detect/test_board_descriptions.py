"""What is wrong with the description of a board is what its refusal names."""

from __future__ import annotations

import pytest

from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.errors import ParameterError


@pytest.mark.parametrize(
    ('spec', 'reason'),
    [
        ('chessboard:0x0:25mm', 'at least 3 each way, and at most 10000 in all, are needed'),
        ('circles:200x200:1mm', 'at least 3 each way, and at most 10000 in all, are needed'),
        ('circles:7x5:20mm:foo', "'foo' is too much; .* only `asymmetric` may follow"),
        ('charuco:7x5:30mm:22mm:DICT_5X5_100:x', "'x' is too much"),
        ('chessboard:9x6:25mm:18mm', "'18mm' is too much; the form is chessboard:9x6:24mm$"),
        ('squares:3x4:30mm', 'as in squares:3x4:30mm:30mm'),
    ],
)
def test_a_refusal_names_the_fault(spec: str, reason: str) -> None:
    with pytest.raises(ParameterError, match=reason):
        parse_pattern(spec)
