"""Hostile input for every surface of the package: files, parameters, messages."""

import fisheye_svp_ros.detect  # noqa: F401  # bounds what OpenCV decodes, before that is loaded
