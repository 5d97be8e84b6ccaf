"""`python -m fisheye_svp_ros COMMAND ...`: the command line."""

import sys

from fisheye_svp_ros.cli import main

if __name__ == '__main__':
    sys.exit(main())
