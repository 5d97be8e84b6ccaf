"""Parameters of a node: declaration, ranges, callbacks. `rclpy.parameter` and a base of Node."""

from __future__ import annotations

import array
import math
from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any

from fisheye_svp_ros.standalone.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    NotSupportedError,
    ParameterAlreadyDeclaredException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from fisheye_svp_ros.standalone.messages import message_class

_Descriptor: Any = message_class('rcl_interfaces/msg/ParameterDescriptor')
_Result: Any = message_class('rcl_interfaces/msg/SetParametersResult')
_Event: Any = message_class('rcl_interfaces/msg/ParameterEvent')
_Value: Any = message_class('rcl_interfaces/msg/ParameterValue')
_Message: Any = message_class('rcl_interfaces/msg/Parameter')

_RELATIVE_TOLERANCE = 1e-6
_ITEMS = {'BYTE_ARRAY': bytes, 'BOOL_ARRAY': bool, 'INTEGER_ARRAY': int, 'DOUBLE_ARRAY': float,
          'STRING_ARRAY': str}  # fmt: skip
_SCALARS = {'BOOL': bool, 'INTEGER': int, 'DOUBLE': float, 'STRING': str}


class Parameter:
    """A parameter: name, type and value, none of which change."""

    class Type(Enum):
        """Types of parameters, in the numbering of rcl_interfaces/ParameterType."""

        NOT_SET = 0
        BOOL = 1
        INTEGER = 2
        DOUBLE = 3
        STRING = 4
        BYTE_ARRAY = 5
        BOOL_ARRAY = 6
        INTEGER_ARRAY = 7
        DOUBLE_ARRAY = 8
        STRING_ARRAY = 9

        @classmethod
        def from_parameter_value(cls, value: object) -> Parameter.Type:
            """Return the type that fits a Python value; an empty list counts as bytes."""
            candidates = cls if value is not None else (cls.NOT_SET,)
            for candidate in candidates:
                if candidate.check(value):
                    return candidate
            raise TypeError(f'no parameter type holds {value!r}')

        def check(self, value: object) -> bool:
            """Say whether a Python value is of this type."""
            if self.name in _SCALARS:
                return isinstance(value, _SCALARS[self.name])
            if self.name in _ITEMS:
                kinds = (list, tuple, array.array)
                item = _ITEMS[self.name]
                return isinstance(value, kinds) and all(isinstance(v, item) for v in value)
            return value is None

    def __init__(self, name: str, type_: Type | None = None, value: Any = None) -> None:
        self.name = name
        self.type_ = self.Type.from_parameter_value(value) if type_ is None else type_
        self.value = value
        if not self.type_.check(value):
            raise ValueError(f"Type '{self.type_}' and value '{value}' do not agree")

    @classmethod
    def from_parameter_msg(cls, msg: Any) -> Parameter:
        """Read a rcl_interfaces/Parameter."""
        kind = cls.Type(msg.value.type)
        value = None if kind == cls.Type.NOT_SET else getattr(msg.value, _value_field(kind))
        return cls(msg.name, kind, value)

    def get_parameter_value(self) -> Any:
        """Return type and value as rcl_interfaces/ParameterValue."""
        msg = _Value(type=self.type_.value)
        if self.type_ != self.Type.NOT_SET:
            setattr(msg, _value_field(self.type_), self.value)
        return msg

    def to_parameter_msg(self) -> Any:
        """Return the parameter as rcl_interfaces/Parameter."""
        return _Message(name=self.name, value=self.get_parameter_value())


def _value_field(kind: Parameter.Type) -> str:
    return f'{kind.name.lower()}_value'


OnSet = Callable[[list[Parameter]], Any]


class ParameterHolder:
    """The parameters of a node and the calls that Node offers for them.

    Attributes are called as in rclpy or are mangled, so that a node class which uses one of these
    names for itself gets along with both or with neither.
    """

    def __init__(self, overrides: dict[str, Any]) -> None:
        self._parameter_overrides = overrides
        self._parameters: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._on_set_parameters_callbacks: list[OnSet] = []
        self._post_set_parameters_callbacks: list[Callable[[list[Parameter]], None]] = []

    def _publish_parameter_event(self, event: Any) -> None:
        raise NotImplementedError

    def declare_parameter(self, name: str, value: Any = None, descriptor: Any = None) -> Parameter:
        """Declare a parameter with a default value; the command line overrides the value."""
        if not name:
            raise InvalidParameterException(f'Invalid parameter name: {name}')
        if name in self._parameters:
            raise ParameterAlreadyDeclaredException(f'Parameter(s) already declared: {[name]}')
        descriptor = descriptor if descriptor is not None else _Descriptor()
        if not descriptor.dynamic_typing:
            descriptor.type = Parameter.Type.from_parameter_value(value).value
            if descriptor.type == 0:
                raise ValueError(f'{name}: a statically typed parameter needs a value')
        parameter = Parameter(name, value=self._parameter_overrides.get(name, value))
        outcome = self.__set([parameter], {name: descriptor})
        if outcome.reason.startswith('Wrong parameter type'):
            raise InvalidParameterTypeException(
                f"Trying to set parameter '{name}' to '{parameter.value}' of type "
                f"'{parameter.type_.name}', expecting type "
                f"'{Parameter.Type(descriptor.type).name}': {name}")
        if not outcome.successful:
            raise InvalidParameterValueException(name, parameter.value, outcome.reason)
        return parameter

    def undeclare_parameter(self, name: str) -> None:
        """Forget a parameter."""
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)
        del self._parameters[name], self._descriptors[name]

    def has_parameter(self, name: str) -> bool:
        """Say whether a parameter is declared."""
        return name in self._parameters

    def get_parameter(self, name: str) -> Parameter:
        """Return a declared parameter."""
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)
        parameter = self._parameters[name]
        if parameter.value is None and not self._descriptors[name].dynamic_typing:
            raise ParameterUninitializedException(
                f"The parameter '{name}' is not initialized: {name}")
        return parameter

    def get_parameters(self, names: Iterable[str]) -> list[Parameter]:
        """Return declared parameters."""
        return [self.get_parameter(name) for name in names]

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Parameter]:
        """Return the parameters below a prefix, by the rest of their names."""
        start = f'{prefix}.' if prefix else ''
        return {n[len(start):]: p for n, p in self._parameters.items() if n.startswith(start)}

    def describe_parameter(self, name: str) -> Any:
        """Return the descriptor of a parameter."""
        if name not in self._descriptors:
            raise ParameterNotDeclaredException(name)
        return self._descriptors[name]

    def set_parameters(self, parameter_list: list[Parameter]) -> list[Any]:
        """Set parameters one by one and return a result with a reason for each."""
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> Any:
        """Set all parameters, or none when one of them is refused."""
        unknown = [p.name for p in parameter_list if p.name not in self._parameters]
        if unknown:
            raise ParameterNotDeclaredException(unknown)
        return self.__set(parameter_list)

    def add_on_set_parameters_callback(self, callback: OnSet) -> None:
        """Have a function accept or refuse new values; the last one added is asked first."""
        self._on_set_parameters_callbacks.insert(0, callback)

    def add_post_set_parameters_callback(
        self, callback: Callable[[list[Parameter]], None]
    ) -> None:
        """Have a function told of new values after they are in place."""
        self._post_set_parameters_callbacks.insert(0, callback)

    def __set(self, parameters: list[Parameter], declared: dict[str, Any] | None = None) -> Any:
        for parameter in parameters:
            descriptor = (declared or self._descriptors)[parameter.name]
            if reason := self.__objection(parameter, descriptor, bool(declared)):
                return _Result(successful=False, reason=reason)
        for callback in self._on_set_parameters_callbacks:
            result = callback(parameters)
            if not result.successful:
                return result
        event = _Event()
        for parameter in parameters:
            self.__store(parameter, declared, event)
        self._publish_parameter_event(event)
        for told in self._post_set_parameters_callbacks:
            told(parameters)
        return _Result(successful=True)

    def __store(self, parameter: Parameter, declared: dict[str, Any] | None, event: Any) -> None:
        name = parameter.name
        if parameter.value is None and not declared:
            event.deleted_parameters.append(parameter.to_parameter_msg())
            del self._parameters[name], self._descriptors[name]
            return
        before = self._parameters.get(name)
        new = before is None or before.value is None
        kind = event.new_parameters if new else event.changed_parameters
        kind.append(parameter.to_parameter_msg())
        self._descriptors |= declared or {}
        self._parameters[name] = parameter

    def __objection(self, parameter: Parameter, descriptor: Any, declaring: bool) -> str:
        """Return why a value is refused, in the words of rclpy; empty when it is not."""
        name, kind = parameter.name, parameter.type_
        descriptor.name = name
        if descriptor.read_only and not declaring:
            return f'Trying to set a read-only parameter: {name}.'
        if descriptor.dynamic_typing:
            descriptor.type = kind.value
        elif kind == Parameter.Type.NOT_SET:
            return 'Static parameter cannot be undeclared' if name in self._parameters else ''
        elif kind.value != descriptor.type:
            expected = Parameter.Type(descriptor.type)
            return f"Wrong parameter type, expected '{expected}' got '{kind}'"
        if name == 'use_sim_time' and parameter.value is True:
            return str(NotSupportedError('simulated time needs an installation of ROS 2'))
        if kind == Parameter.Type.INTEGER and descriptor.integer_range:
            return _outside(parameter, descriptor.integer_range[0], 0.0, '.')
        if kind == Parameter.Type.DOUBLE and descriptor.floating_point_range:
            limits = descriptor.floating_point_range[0]
            return _outside(parameter, limits, _RELATIVE_TOLERANCE, '')
        return ''


def _outside(parameter: Parameter, limits: Any, tolerance: float, mark: str) -> str:
    """Return why a value is out of its range, in rclpy's words, which have a mark for integers."""
    name, value = parameter.name, parameter.value
    low, high = sorted((limits.from_value, limits.to_value))
    at_end = any(math.isclose(value, end, rel_tol=tolerance) for end in (low, high))
    if at_end or low < value < high:
        return ''
    return f'Parameter {name} out of range{mark} Min: {low}, Max: {high}, value: {value}'
