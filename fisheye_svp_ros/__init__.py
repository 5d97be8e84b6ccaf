"""What the single-viewpoint approximation of a fisheye lens costs, and where simulation errs."""

__version__ = '0.1.0'
