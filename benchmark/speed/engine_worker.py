"""Does a job with the Numba engine, once a line that comes in; run by variants.py."""

from __future__ import annotations

import json
import sys
import time

from benchmark.speed import engines
from benchmark.speed.variants import work_of

engines.use('numba')
job = work_of(sys.argv[1], int(sys.argv[2]))
for _ in sys.stdin:
    wall, processor = time.perf_counter(), time.process_time()
    job()
    print(
        json.dumps(
            {
                'wall': time.perf_counter() - wall,
                'processor': time.process_time() - processor,
            }
        ),
        flush=True,
    )
