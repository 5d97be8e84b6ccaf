"""Links and anchors of the documentation have targets, without building the site."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest
from helpers.nodes import ROOT

PAGES = sorted([*ROOT.glob('*.md'), *(ROOT / 'docs').rglob('*.md')])
_CODE = re.compile(r'^```.*?^```|`[^`\n]*`', re.DOTALL | re.MULTILINE)
_LINK = re.compile(r'\[[^\]]*\]\(([^)\s]+)\)')


@cache
def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r'^```.*?^```', '', page.read_text(encoding='utf-8'),
                  flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r'^#+ (.*)$', text, re.MULTILINE)
    plain = [re.sub(r'[^\w\- ]', '', re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', heading)).lower()
             for heading in headings]
    return {heading.strip().replace(' ', '-') for heading in plain}


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_have_targets(page: Path) -> None:
    text = _CODE.sub('', page.read_text(encoding='utf-8'))
    for link in _LINK.findall(text):
        if re.match('[a-z]+:', link):
            continue
        target, _, anchor = link.partition('#')
        path = page.parent / target if target else page
        assert path.exists(), link
        if anchor:
            assert anchor in anchors(path.resolve()), link
