"""The walks of architecture.md, and the files of the package that something runs."""

import inspect
import re
import sys

from helpers.nodes import ROOT

PACKAGE = ROOT / 'fisheye_svp_ros'
PAGE = ROOT / 'docs' / 'explanation' / 'architecture.md'


def walk(start):
    """Return the files of one walk, room after room; start: how the head of its column begins."""
    table = PAGE.read_text(encoding='utf-8').partition('## Three walks')[2].partition('\n## ')[0]
    rows = [line.split('|')[1:-1] for line in table.splitlines() if line.startswith('|')]
    (column,) = (i for i, head in enumerate(rows[0]) if head.strip().startswith(start))
    return re.findall(r'`(\w+/[\w/]+\.py)`', '\n'.join(cells[column] for cells in rows[2:]))


def files_run(act, among):
    """Return which of some files have functions that `act` calls.

    Rooms come in the order in which they are entered, the files of each in that of first calls.
    It is called twice, as modules that are imported call functions, too.
    """
    run = {}

    def note(frame, event, _):
        code = frame.f_code
        if event == 'call' and code.co_flags & inspect.CO_OPTIMIZED and code.co_name != '__init__':
            run.setdefault(code.co_filename)

    act()
    sys.setprofile(note)
    try:
        act()
    finally:
        sys.setprofile(None)
    names = {str(PACKAGE / name): name for name in among}
    files = [names[name] for name in run if name in names]
    rooms = [room_of(file) for file in files]
    return sorted(files, key=lambda file: rooms.index(room_of(file)))


def room_of(file):
    """Return the folder of a file of the package."""
    return file.partition('/')[0]
