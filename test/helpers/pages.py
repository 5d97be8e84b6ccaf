"""What a page shows as the output of a command, beside what the command printed."""

from __future__ import annotations

import re

_NUMBER = re.compile(r'(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?!\w)')
_SHOWN = re.compile(r'^```text\n(.*?)^```', re.DOTALL | re.MULTILINE)
# A last digit may round the other way on another machine.
_LAST_DIGITS = 1.01


def shown_output(text: str) -> list[str]:
    """Return the lines that a piece of a page shows as printed; not rules and left-out rows."""
    lines = '\n'.join(_SHOWN.findall(text)).splitlines()
    return [line for line in lines if re.search(r'\w', line)]


def differing_lines(shown: list[str], printed: str) -> list[str]:
    """Return those of the `shown` lines that are not among those printed, within rounding."""
    lines = [_split(line) for line in printed.splitlines()]
    return [line for line in shown if not any(_agrees(_split(line), other) for other in lines)]


def _split(line: str) -> tuple[str, list[str]]:
    return ' '.join(_NUMBER.sub('#', line).split()), _NUMBER.findall(line)


def _agrees(shown: tuple[str, list[str]], printed: tuple[str, list[str]]) -> bool:
    return shown[0] == printed[0] and all(
        abs(float(a) - float(b)) <= _LAST_DIGITS * max(_last_digit(a), _last_digit(b))
        for a, b in zip(shown[1], printed[1], strict=True)
    )


def _last_digit(number: str) -> float:
    """Return the value of one unit in the last decimal printed; of whole numbers none."""
    mantissa, _, power = number.partition('e')
    decimals = mantissa.partition('.')[2]
    if not decimals and not power:
        return 0.0
    return 10.0 ** (int(power or 0) - len(decimals))
