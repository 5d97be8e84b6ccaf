"""Where compressed images come, as image_transport has it."""

from __future__ import annotations

from typing import Any

COMPRESSED_SUFFIX = '/compressed'


def compressed_topic(node: Any, raw: str) -> str:
    """Return the topic of compressed images: beside the raw ones, unless remapped itself."""
    own = str(node.resolve_topic_name(raw + COMPRESSED_SUFFIX))
    if own != node.resolve_topic_name(raw + COMPRESSED_SUFFIX, only_expand=True):
        return own
    return f'{node.resolve_topic_name(raw)}{COMPRESSED_SUFFIX}'
