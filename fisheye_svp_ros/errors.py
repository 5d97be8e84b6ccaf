"""The errors of this package: one root, one subclass a kind of bad input."""


class FisheyeSvpError(Exception):
    """Root of all errors raised on purpose; its text is one line that names the remedy."""


class LensError(FisheyeSvpError):
    """A lens description is incomplete or impossible."""


class ObservationError(FisheyeSvpError):
    """Observations, poses or landmarks are missing, malformed or contradictory."""


class GeometryError(FisheyeSvpError):
    """Too few or degenerate points, or points outside the domain of the lens."""


class ParameterError(FisheyeSvpError):
    """A parameter or a sweep file holds a value that cannot be used."""


class BagError(FisheyeSvpError):
    """A recording cannot be read or written."""


class OutputError(FisheyeSvpError):
    """A result cannot be written."""


class SweepError(FisheyeSvpError):
    """A sweep cannot go on, for want of somebody who works on it."""


class StandaloneError(FisheyeSvpError):
    """Something was asked of the standalone client that it does not cover."""
