"""Valid input made invalid: of bytes, of the words of a text, of messages."""

from __future__ import annotations

import re
from random import Random

NUMBERS = (
    '0',
    '-0',
    '-1',
    '1',
    '2',
    '0.5',
    '1.5',
    '-1e-300',
    '1e-320',
    '1e300',
    '-1e308',
    '1e999',
    'nan',
    'inf',
    '-inf',
    '.nan',
    '.inf',
    '4294967295',
    '4294967296',
    '9007199254740993',
    '1e20',
    '0x10',
    '010',
    '1_000',
    '9' * 5000,
    '\u0661',
    '1e5',
    '100000',
    '1000000000',
    '1e-9',
    '89.99',
    '180',
)
WORDS = (
    '',
    ' ',
    'null',
    '~',
    'true',
    'no',
    '[]',
    '{}',
    '[1',
    '{a',
    '&a x',
    '*a',
    '<<',
    '!!binary x',
    '!!timestamp x',
    '!!python/name:os.system',
    '2001-99-99',
    '"',
    "'",
    '\x00',
    '\ufeff',
    '\n',
    '\r',
    '#',
    ':',
    ',',
    ';',
    '|',
    '%YAML 1.2',
    '---',
    '...',
    '../../x',
    '/dev/zero',
    '/(*',
    '..',
    'a' * 5000,
    '\u2028',
    '\x1b[31m',
    'é',
    '\U0001f600',
    '-',
    '- - - -',
    '{{',
    '<a>',
    '</a>',
    '<!DOCTYPE a>',
    '&lt;',
    '%s',
    '$(x)',
    '\\',
    'gennery',
    'flat_port',
    'equidistant',
    'pinhole',
)
_TOKEN = re.compile(rb'[-+]?[0-9][-+.0-9eE]*|[A-Za-z_][A-Za-z_0-9]*')


def mutated(data: bytes, rng: Random, binary: bool = False) -> bytes:
    """Return data with one to four faults in it; binary: no words to be found there."""
    kinds = _BINARY if binary else _BINARY + _TEXT
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(kinds)(data, rng)
    return data


def _flip(data: bytes, rng: Random) -> bytes:
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 20)) if found else 0):
        found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
    return bytes(found)


def _cut(data: bytes, rng: Random) -> bytes:
    a, b = _slice(data, rng)
    return data[:a] + data[b:]


def _truncate(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _repeat(data: bytes, rng: Random) -> bytes:
    a, b = _slice(data, rng)
    times = rng.choice((1, 1, 2, 30, 3000))
    return data[:b] + data[a:b] * min(times, 100_000 // (b - a + 1) + 1) + data[b:]


def _insert(data: bytes, rng: Random) -> bytes:
    a, _ = _slice(data, rng)
    new = rng.randbytes(rng.choice((1, 2, 8, 64)))
    return data[:a] + rng.choice((new, b'\0' * 8, b'\xff' * 8)) + data[a:]


def _replace_token(data: bytes, rng: Random) -> bytes:
    tokens = list(_TOKEN.finditer(data[:100_000]))
    if not tokens:
        return data
    one, other = rng.choice(tokens), rng.choice(tokens)
    number = one[0][-1:].isdigit() and rng.random() < 0.8
    new = rng.choice(NUMBERS if number else WORDS).encode()
    return data[: one.start()] + rng.choice((new, new, other[0])) + data[one.end() :]


def _lines(data: bytes, rng: Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if len(lines) < 2:
        return data
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    change = rng.randrange(4)
    if change == 0:
        lines.insert(i, lines[j])
    elif change == 1:
        del lines[i]
    elif change == 2:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        lines[i] = rng.choice((b'  ', b'\t', b'- ', b'#')) + lines[i]
    return b''.join(lines)


def _deepen(data: bytes, rng: Random) -> bytes:
    a, _ = _slice(data, rng)
    opener = rng.choice((b'[', b'{', b'(', b'- ', b'{a: ', b'<a>', b'-', b'"', b'&a [*a, ', b'? '))
    return data[:a] + opener * rng.choice((1, 3, 60, 3000)) + data[a:]


def _slice(data: bytes, rng: Random) -> tuple[int, int]:
    a = rng.randrange(len(data) + 1)
    return a, min(len(data), a + rng.choice((1, 2, 8, 40, 400)))


_BINARY = (_flip, _flip, _cut, _truncate, _repeat, _insert)
_TEXT = (_replace_token, _replace_token, _replace_token, _lines, _lines, _deepen)


def nasty(rng: Random, kind: type) -> object:
    """Return a value for a parameter or a field that takes `kind`, often one that it must not."""
    if rng.random() < 0.2:
        return rng.choice((None, (), [1], {}, True, b'x', 1 + 2j, '', 0, float('nan'), [[1.0]]))
    if kind is float:
        return rng.choice(
            (
                0.0,
                -0.0,
                1e308,
                -1e308,
                5e-324,
                float('inf'),
                float('nan'),
                1e-9,
                89.9,
                rng.uniform(-10, 10),
                10.0 ** rng.randrange(-320, 308),
            )
        )
    if kind is int:
        return rng.choice((0, -1, 1, 2**31, 2**63 - 1, 2**64, 10**30, rng.randrange(-10, 100)))
    if kind is bool:
        return rng.random() < 0.5
    return rng.choice(WORDS)
