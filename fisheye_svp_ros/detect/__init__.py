"""Photographs to observations: sources, detectors, the order of corners, their uncertainty."""

import os

# Pixels of an image that OpenCV decodes, 67 million: a small file can ask for any number.  OpenCV
# reads this as it is loaded.
os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(1 << 26))
