"""Single inputs tried and judged, and the process that does it."""

from __future__ import annotations

import os
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from random import Random

from benchmark.hardening.fuzz.nodes import node_surfaces
from benchmark.hardening.fuzz.surfaces import Surface, Trial, surfaces
from fisheye_svp_ros.errors import FisheyeSvpError

SLOWEST = 2.0  # s of processor time an input
WAITING = 10.0  # s of wall time an input, on a machine that may be busy
LARGEST = 200.0  # MB that an input adds to the memory ever used


@dataclass
class Outcome:
    """What became of inputs; faults: crashed, wrong, slow, large, by seed, with what was said."""

    tried: int = 0
    refused: int = 0
    slowest: float = 0.0
    largest: float = 0.0
    faults: Counter[str] = field(default_factory=Counter)
    told: list[str] = field(default_factory=list)

    def fault(self, kind: str, name: str, seed: int, text: str) -> None:
        """Count a fault and keep the first ones in words."""
        self.faults[kind] += 1
        if len(self.told) < 5:
            self.told.append(f'{kind}: {name} {seed}: {text[-1500:]}')

    def add(self, other: Outcome) -> None:
        """Count what another has counted."""
        self.tried += other.tried
        self.refused += other.refused
        self.slowest = max(self.slowest, other.slowest)
        self.largest = max(self.largest, other.largest)
        self.faults += other.faults
        self.told += other.told


def tried(name: str, trial: Trial, seed: int, outcome: Outcome) -> None:
    """Try one input."""
    memory, begun, clock = _memory(), time.process_time(), time.monotonic()
    outcome.tried += 1
    try:
        wrong = trial(Random(f'{name} {seed}'))
        if wrong:
            outcome.fault('wrong', name, seed, wrong)
    except FisheyeSvpError as error:
        outcome.refused += 1
        text = str(error)
        if not text or '\n' in text or len(text) > 2000:
            outcome.fault('wrong', name, seed, f'not one line: {text}')
    except Exception:
        outcome.fault('crashed', name, seed, traceback.format_exc())
    seconds, growth = time.process_time() - begun, _memory() - memory
    outcome.slowest, outcome.largest = max(outcome.slowest, seconds), max(outcome.largest, growth)
    waited = time.monotonic() - clock
    if seconds > SLOWEST or waited > WAITING:
        outcome.fault('slow', name, seed, f'{seconds:.1f} s, {waited:.1f} s on the clock')
    if growth > LARGEST:
        outcome.fault('large', name, seed, f'{growth:.0f} MB')


def run_chunk(name: str, first: int, count: int) -> Outcome:
    """Try a chunk of seeds in this process."""
    trial, outcome = trial_of(name), Outcome()
    for seed in range(first, first + count):
        tried(name, trial, seed, outcome)
    return outcome


_trials: dict[str, Trial] = {}


def trial_of(name: str) -> Trial:
    """Return a surface by name, made once a process."""
    if name not in _trials:
        known = {surface.name: surface for surface in every()}
        folder = Path(tempfile.mkdtemp(prefix='fuzz'))
        _trials[name] = known[name].make(folder)
    return _trials[name]


@cache
def every() -> list[Surface]:
    """Return all surfaces."""
    return [*surfaces(), *node_surfaces()]


def _memory() -> float:
    """Return the largest memory that this process ever had, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def prepare() -> None:
    """Prepare a process: quiet, and left alone by Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter('ignore')
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 2)  # what nodes log about what they refuse
