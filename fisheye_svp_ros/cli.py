"""The command line: `fisheye-svp COMMAND ...`.

A command is one module in `commands` with `add_arguments(parser)` and `run(args)`, and one line
in COMMANDS.  Only the module of the command that is asked for is imported.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import NoReturn

from fisheye_svp_ros import __version__
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.io.streams import tolerant_streams
from fisheye_svp_ros.process import draw_to_files, set_thread_count

_DESCRIPTION = (
    'Measure the error of the single-viewpoint (SVP) approximation of a fisheye lens, and find '
    'the model errors in calibration data.'
)
COMMANDS = {
    'budget': 'find the range and the angle at which the SVP error exceeds your limits',
    'calibrate': 'calibrate a lens or a rig from photographs or observations, without an '
    'initial guess',
    'demo': "run all nodes on simulated cameras, and compare the errors with those of Kita's "
    'paper',
    'detect': 'find the points of a board in photographs, videos, or recordings',
    'diagnose': 'find the model errors in your data and name their causes',
    'example': 'write example photographs of a bent board through a lens with a moving viewpoint',
    'lens': 'show, check, or convert a lens file of this package or of another tool',
    'localize': 'estimate one pose per frame, with residuals and covariance, without an initial '
    'guess',
    'map': 'map loose tags from photographs, a video, or a recording of a walk',
    'paper': "reproduce the tables and figures of Kita's paper, and extend them",
    'plan': 'plan the photographs that calibrate a lens; print them as a shot list',
    'plot': 'plot a recording, a table or a sweep',
    'record': 'record the topics of the nodes into a rosbag2 recording (MCAP)',
    'render': 'render photographs of a chessboard through a lens, with their true corners and '
    'poses',
    'run': 'run one node, as `ros2 run` does, or several in one process',
    'sweep': 'run a sweep of simulated scenarios offline; write one row per scenario',
    'table': 'turn a recording into a table with one row per stamp of the input',
    'undistort': 'undistort photographs, rectify stereo pairs, and write maps for cv2.remap',
    'watch': 'show the results of running nodes live in the terminal',
}
# One for the help of each command.
EXAMPLES = {
    'budget': '--lens fish180 --range 0.5 --noise 0.3 -o budget',
    'calibrate': 'photographs --board chessboard:9x6:25mm -o lens.yaml',
    'demo': '-o demo',
    'detect': 'photographs --board chessboard:9x6:25mm -o observations.csv',
    'diagnose': 'photographs --board chessboard:9x6:25mm --lens lens.yaml -o diagnosis',
    'example': '-o example',
    'lens': 'camchain.yaml -o lens.yaml',
    'localize': 'observations.csv --lens lens.yaml -o poses',
    'map': 'walk --board tags:36h11:160mm --lens lens.yaml -o tags.yaml',
    'paper': '-o paper',
    'plan': '--lens lens.yaml --board chessboard:9x6:25mm --room 0.2 1 -o plan',
    'plot': 'recording -o pictures',
    'record': '-o recording --sweep noise',
    'render': '--lens fish180 --board chessboard:9x6:25mm --count 12 -o rendered',
    'run': 'synthetic_camera localizer',
    'sweep': 'noise -o sweep',
    'table': 'recording -o table',
    'undistort': 'lens.yaml photographs --as pinhole -o undistorted',
    'watch': '',
}
_FIRST_COMMANDS = """{description}

with photographs of a board:
  fisheye-svp calibrate {calibrate}
  fisheye-svp diagnose {diagnose}
on a robot, or without one:
  fisheye-svp demo {demo}
  fisheye-svp run {run}
  fisheye-svp sweep {sweep}

all commands: fisheye-svp --help
"""
_SOLVING = ('budget', 'calibrate', 'demo', 'detect', 'diagnose', 'localize', 'paper', 'sweep')
# Others project many points at once, for which the compiled engine takes every core.
_ON_ONE_THREAD = ('calibrate', 'diagnose', 'sweep')
_ON_LARGE_ARRAYS = ('calibrate', 'diagnose')
_SIGNAL_HANDLERS = ('record', 'run', 'watch')  # these end themselves on SIGTERM
_BAD_INPUT = 2
_EXIT_SIGINT = 130  # 128 + SIGINT, as a shell reports it
_BROKEN_PIPE = 141  # 128 + SIGPIPE
_EXIT_SIGTERM = 143  # 128 + SIGTERM


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(_BAD_INPUT, f'fisheye-svp: {message} (see {self.prog} --help)\n')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 2, after one line on stderr, for bad input."""
    with tolerant_streams() as lost:
        status = _status(sys.argv[1:] if arguments is None else arguments)
        if (error := lost()) is None:
            return status
        if isinstance(error, BrokenPipeError):  # nobody reads on
            return status or _BROKEN_PIPE
        return _print_error(f'standard output cannot be written ({error.strerror})')


def _status(arguments: Sequence[str]) -> int:
    try:
        _run(arguments)
    except FisheyeSvpError as error:
        return _print_error(str(error))
    except ModuleNotFoundError as error:
        if str(error.name).startswith('fisheye_svp_ros'):
            raise
        return _print_error(f'this needs the Python package {error.name}, which is not installed')
    except OSError as error:  # of a path that no check has asked for
        return _print_error(f'{error.filename or "a file"!r:.200}: {error.strerror or error}')
    except KeyboardInterrupt:
        return _EXIT_SIGINT
    return 0


def _print_error(text: str) -> int:
    """Print the one line of bad input; return its exit code."""
    print(f'fisheye-svp: {text}', file=sys.stderr)
    return _BAD_INPUT


def _run(arguments: Sequence[str]) -> None:
    if not arguments:
        print(_FIRST_COMMANDS.format(description=_DESCRIPTION, **EXAMPLES), end='')
        return
    parser = _Parser(prog='fisheye-svp', description=_DESCRIPTION)
    parser.add_argument('--version', action='version', version=f'%(prog)s {__version__}')
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for name, purpose in COMMANDS.items():
        commands.add_parser(name, help=purpose, description=purpose[0].upper() + purpose[1:] + '.')
    named = next((word for word in arguments if not word.startswith('-')), '')
    draw_to_files()
    if named in _ON_ONE_THREAD:
        set_thread_count()
    if named in _ON_LARGE_ARRAYS:
        import_module('fisheye_svp_ros.process').keep_memory()
    if named in COMMANDS:
        module = import_module(f'fisheye_svp_ros.commands.{named}')
        module.add_arguments(commands.choices[named])
        commands.choices[named].set_defaults(run=module.run)
        commands.choices[named].epilog = f'example: fisheye-svp {named} {EXAMPLES[named]}'.rstrip()
    elif named:
        _refuse(parser, named, COMMANDS, 'command')
    if named in _SOLVING:
        commands.choices[named].add_argument(
            '--engine',
            choices=('auto', 'numpy', 'numba'),
            help='numpy or numba (extra `fast`). numba compiles for about a minute at its first '
            'use on a machine. auto: numba for long work, numpy otherwise. Default: '
            'FISHEYE_SVP_ENGINE, or auto',
        )
    if '' in arguments and named != 'run':  # as a path it would be the folder that one is in
        parser.error('an argument is empty; a variable of the shell may be unset')
    parsed, unknown = parser.parse_known_args(arguments)
    if unknown:
        chosen = commands.choices[named]
        _refuse(chosen, unknown[0], chosen.format_help().split(), 'argument')
    checks = 'fisheye_svp_ros.commands.applicability', 'fisheye_svp_ros.commands.outputs'
    import_module(checks[0]).check_options(named, parsed, commands.choices[named])
    import_module(checks[1]).check_output(parsed)
    if named not in _SIGNAL_HANDLERS:  # nodes have it compiled in the background
        _choose_engine(getattr(parsed, 'engine', None))
    with _tidy(named):
        parsed.run(parsed)


def _choose_engine(name: str | None) -> None:
    """Take the engine that a command is given into use; have it say when it has to compile."""
    from fisheye_svp_ros.optics import engines

    engines.before_compiling = _tell_compilation
    if name:
        engines.use(name)


def _tell_compilation() -> None:
    from fisheye_svp_ros.reporting.wording.inputs import compiling_first

    print(f'fisheye-svp: note: {compiling_first()}', file=sys.stderr, flush=True)


@contextmanager
def _tidy(command: str) -> Iterator[None]:
    """Have SIGTERM end a command as an exception does: temporary files go, children end."""
    if command in _SIGNAL_HANDLERS or threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(*_: object) -> NoReturn:
        sys.exit(_EXIT_SIGTERM)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _refuse(
    parser: argparse.ArgumentParser, word: str, known: Iterable[str], kind: str
) -> NoReturn:
    """End with the help of a parser that does not know a word, and a known one like it."""
    from difflib import get_close_matches

    near = get_close_matches(word.partition('=')[0], known, 1, 0.8)
    parser.error(f'unknown {kind} {word}' + (f'; did you mean {near[0]}?' if near else ''))


if __name__ == '__main__':
    sys.exit(main())
