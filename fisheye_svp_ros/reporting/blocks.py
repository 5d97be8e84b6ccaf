"""Reports as a list of blocks, rendered as Markdown and as one self-contained HTML page."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2

from fisheye_svp_ros.io.files import write_text, written


class Heading(NamedTuple):
    """A heading; level 1 is the title of the report."""

    text: str
    level: int = 2
    kind: str = 'heading'


class Text(NamedTuple):
    """A paragraph."""

    text: str
    kind: str = 'text'


class TableBlock(NamedTuple):
    """A table; the first `names` columns hold names, the others numbers."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    names: int = 1
    kind: str = 'table'


class Picture(NamedTuple):
    """A picture file in the report's folder."""

    file: str
    caption: str
    kind: str = 'picture'


Block = Heading | Text | TableBlock | Picture


def write_blocks(folder: Path, name: str, blocks: Sequence[Block]) -> list[Path]:
    """Write NAME.md and NAME.html beside the pictures; return both, or raise OutputError."""
    blocks = [
        block
        for block in blocks
        if not isinstance(block, Picture) or written(folder / block.file).exists()
    ]
    pictures = {
        block.file: data_uri(folder / block.file) for block in blocks if isinstance(block, Picture)
    }
    pages = [folder / f'{name}.{suffix}' for suffix in ('md', 'html')]
    for path in pages:
        write_text(
            path, page(f'blocks{path.suffix}', blocks=blocks, title=blocks[0], pictures=pictures)
        )
    return pages


def page(template: str, **values: Any) -> str:
    """Return a template of this package, filled in."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('fisheye_svp_ros.reporting'),
        autoescape=jinja2.select_autoescape(['html']),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(values)


def data_uri(path: Path) -> str:
    """Return a picture file as part of a page."""
    return png_uri(written(path).read_bytes())


def png_uri(data: bytes) -> str:
    """Return a PNG picture as part of a page."""
    return image_uri(data, 'png')


def image_uri(data: bytes, form: str) -> str:
    """Return a picture as part of a page; form: png, jpeg."""
    return f'data:image/{form};base64,' + base64.b64encode(data).decode('ascii')
