"""Sphinx: `make docs` builds the site into out/site without the network; rosdoc2 uses it, too."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

from site_parts import commands, diagnosis_keys  # noqa: E402

from fisheye_svp_ros import __version__  # noqa: E402

project = 'fisheye_svp_ros'
copyright = f'the {project} maintainers, Apache-2.0'
version = release = __version__

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.viewcode']
exclude_patterns = ['Thumbs.db', '.DS_Store']
myst_heading_anchors = 4
myst_enable_extensions = ['deflist']
autodoc_member_order = 'bysource'
autodoc_typehints = 'signature'
autodoc_typehints_format = 'short'
autodoc_preserve_defaults = True
autodoc_type_aliases = {
    name: name for name in ('Array', 'Index', 'Mask', 'AnyLens', 'AnyObservations')
}

html_theme = 'furo'
html_title = f'{project} {version}'
html_show_sourcelink = False

_LINK = re.compile(r'(?<!!)\[([^\]]*)\]\((?!https?:)([^)#\s]+)(?:#[^)\s]*)?\)')
# By the comment that stands in its place, what the code says.
_PARTS = {'<!-- commands:': commands, '<!-- diagnosis.json:': diagnosis_keys}


def _complete(_: Any, page: str, source: list[str]) -> None:
    """Add what the code says; keep only the text of links to files that the site does not hold."""
    folder = (DOCS / page).parent

    def replaced(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(folder / link[2]))
        return link[0] if target.is_relative_to(DOCS) and target.suffix == '.md' else link[1]

    text = source[0]
    for comment, part in _PARTS.items():
        if comment in text:
            before, _, rest = text.partition(comment)
            text = before + part() + rest.partition('-->')[2]
    source[0] = _LINK.sub(replaced, text)


def setup(app: Any) -> None:
    """Connect the hook above."""
    app.connect('source-read', _complete)
