"""Where measured data are: FISHEYE_SVP_DATA, or shared/data beside the checkout."""

from __future__ import annotations

import os
from pathlib import Path

_BESIDE = Path(__file__).resolve().parents[3] / 'shared' / 'data'
DATA = Path(os.environ.get('FISHEYE_SVP_DATA', _BESIDE))
NO_DATA = f'no measured data in {DATA}; FISHEYE_SVP_DATA: docs/tutorials/real_cameras.md'
