"""A few seconds of what `make hardening NAME=fuzz` does for half an hour."""

from __future__ import annotations

import subprocess
import sys
from random import Random
from typing import Any

import pytest
from helpers.nodes import ROOT

from benchmark.hardening.fuzz.mutations import mutated
from benchmark.hardening.fuzz.surfaces import surfaces
from benchmark.hardening.fuzz.trials import Outcome, trial_of, tried
from fisheye_svp_ros.errors import FisheyeSvpError, LensError

hypothesis = pytest.importorskip('hypothesis')
NAMES = [surface.name for surface in surfaces()]


@pytest.mark.parametrize('name', NAMES)
def test_input_is_taken_or_refused_in_one_line(name: str) -> None:
    trial = trial_of(name)

    @hypothesis.settings(
        max_examples=15,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(hypothesis.strategies.randoms(use_true_random=False))
    def check(random: Random) -> None:
        try:
            assert trial(random) == ''
        except FisheyeSvpError as error:
            assert str(error) and '\n' not in str(error)

    check()


def test_a_short_run_over_all_surfaces_finds_no_fault() -> None:
    done = subprocess.run(
        [
            sys.executable,
            '-m',
            'benchmark.hardening.fuzz',
            '--inputs',
            '1200',
            '--workers',
            '1',
            '--no-docs',
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert 'crashed 0, hung or died 0, wrong 0, slow 0, large 0' in done.stdout


def test_faults_are_told() -> None:
    def failing(_: Random) -> str:
        raise ZeroDivisionError

    def refusing(_: Random) -> str:
        raise LensError('no')

    outcome = Outcome()
    trials: list[Any] = [failing, refusing, lambda _: 'wrong', lambda _: '']
    for trial in trials:
        tried('x', trial, 7, outcome)
    assert (outcome.tried, outcome.refused) == (4, 1)
    assert outcome.faults == {'crashed': 1, 'wrong': 1}
    assert outcome.told[0].startswith('crashed: x 7: Traceback')


def test_a_seed_is_an_input() -> None:
    data = b'name: fish\nf: 400.0\n' * 5
    assert mutated(data, Random('a 1')) == mutated(data, Random('a 1'))
    assert len({mutated(data, Random(f'a {seed}')) for seed in range(100)}) > 60
