"""Work in a process of its own, done once for each line it is sent; it times itself."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any


@contextmanager
def worker(
    command: Sequence[str], environment: Mapping[str, str] | None = None
) -> Iterator[Callable[[], dict[str, Any]]]:
    """Yield a function that has the process work once and returns its answer, with its times."""
    with subprocess.Popen(
        command, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        asked, answered = process.stdin, process.stdout

        def run() -> dict[str, Any]:
            print('go', file=asked, flush=True)
            answer: dict[str, Any] = json.loads(answered.readline())
            return answer

        yield run
        asked.close()
