"""Work in a process of its own, done once for each line it is sent; it times itself."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from benchmark.speed.harness import NotHereError


@contextmanager
def worker(
    command: Sequence[str], environment: Mapping[str, str] | None = None
) -> Iterator[Callable[[], dict[str, Any]]]:
    """Yield a function that has the process work once and returns its answer, with its times.

    It raises NotHereError where the process ends without an answer.
    """
    with subprocess.Popen(
        command, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        asked, answered = process.stdin, process.stdout

        def run() -> dict[str, Any]:
            with suppress(BrokenPipeError):
                print('go', file=asked, flush=True)
            line = answered.readline()
            if not line:
                raise NotHereError(f'its process ended with {process.wait()}')
            answer: dict[str, Any] = json.loads(line)
            return answer

        yield run
        with suppress(BrokenPipeError):
            asked.close()
