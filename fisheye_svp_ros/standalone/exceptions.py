"""The errors that rclpy raises, under the names of `rclpy.exceptions` and `rclpy.executors`."""

from __future__ import annotations

from fisheye_svp_ros.errors import StandaloneError


class NotSupportedError(StandaloneError, AttributeError):
    """A part of ROS 2 that exists only where ROS 2 is installed."""


class RCLError(StandaloneError, RuntimeError):
    """The state of the context does not allow an operation."""


class NotInitializedException(StandaloneError):
    """`rclpy.init()` has not been called."""


class ExternalShutdownException(StandaloneError):
    """The context was shut down, by a signal or by other code, while the executor waited."""


class NameValidationException(StandaloneError, ValueError):
    """A node, topic, service or namespace name is malformed."""


class UnknownROSArgsError(StandaloneError):
    """Something after `--ros-args` is not understood."""


class ParameterException(StandaloneError):
    """Base of the errors about one parameter."""


class ParameterNotDeclaredException(ParameterException):
    """A parameter was used before it was declared."""

    def __init__(self, parameters: str | list[str]) -> None:
        super().__init__(f'Invalid access to undeclared parameter(s): {parameters}')


class ParameterAlreadyDeclaredException(ParameterException):
    """A parameter was declared twice."""


class ParameterUninitializedException(ParameterException):
    """A statically typed parameter was read before it had a value."""


class InvalidParameterException(ParameterException):
    """A parameter name is malformed."""


class InvalidParameterTypeException(ParameterException):
    """An initial value has another type than the parameter."""


class InvalidParameterValueException(ParameterException):
    """An initial value was refused by its descriptor or by a callback."""

    def __init__(self, parameter: str, value: object, reason: str) -> None:
        super().__init__(
            f'Invalid parameter value ({value}) for parameter. Reason: {reason}: {parameter}')
