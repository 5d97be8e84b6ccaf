"""Message and service classes shaped like the generated ones, on the definitions of rosbags.

Fields hold what a generated ROS 2 Python message holds: `array.array` for numeric sequences, numpy
arrays for numeric arrays of fixed size, `bytes` of length one for `byte`, lists for the rest. So a
node reads and writes the same values in both worlds, and large data never becomes a Python list.
"""

from __future__ import annotations

import array
import codecs
import sys
from collections.abc import Callable, Iterable
from functools import cache
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fisheye_svp_ros.errors import StandaloneError

# The message store of rosbags has no services; these are the ones that nodes offer.
_SERVICES = {
    'std_srvs/srv/Trigger': ('', 'bool success\nstring message'),
    'rcl_interfaces/srv/GetParameters': (
        'string[] names', 'rcl_interfaces/ParameterValue[] values'),
    'rcl_interfaces/srv/GetParameterTypes': ('string[] names', 'uint8[] types'),
    'rcl_interfaces/srv/SetParameters': (
        'rcl_interfaces/Parameter[] parameters',
        'rcl_interfaces/SetParametersResult[] results'),
    'rcl_interfaces/srv/SetParametersAtomically': (
        'rcl_interfaces/Parameter[] parameters', 'rcl_interfaces/SetParametersResult result'),
    'rcl_interfaces/srv/DescribeParameters': (
        'string[] names', 'rcl_interfaces/ParameterDescriptor[] descriptors'),
    'rcl_interfaces/srv/ListParameters': (
        'uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth',
        'rcl_interfaces/ListParametersResult result'),
}

# The store keeps no default values; these are the non-zero ones of the common interfaces.
_DEFAULTS: dict[tuple[str, str], object] = {
    ('geometry_msgs/msg/Quaternion', 'w'): 1.0,
}

_CODES = {
    'int8': 'b', 'uint8': 'B', 'int16': 'h', 'uint16': 'H', 'int32': 'i', 'uint32': 'I',
    'int64': 'q', 'uint64': 'Q', 'float32': 'f', 'float64': 'd',
}  # fmt: skip

# rosidl puts one byte into a message without fields, because IDL knows no empty structure.
_EMPTY = 'structure_needs_at_least_one_member'

Convert = Callable[[Any], Any]

_BAD_STRINGS = 100  # of one message that are mended
codecs.register_error(
    'mark', lambda e: ('?' * (e.end - e.start), e.end))  # type: ignore[attr-defined]


class UnknownFieldError(StandaloneError, AttributeError):
    """A message has no field of that name."""


class FieldValueError(StandaloneError, TypeError, ValueError):
    """A value does not fit the field it is assigned to."""


class UnreadableError(StandaloneError, ValueError):
    """Bytes from the wire are not a message of the type they claim to be."""


class Field(NamedTuple):
    """How one field starts, what it accepts, and what rosbags reads and writes for it."""

    default: Callable[[], Any]
    check: Convert
    to_wire: Convert | None = None
    from_wire: Convert | None = None


class Message:
    """A ROS message: keyword arguments, typed fields with defaults, constants on the class."""

    __slots__ = ()
    TYPENAME: ClassVar[str]
    FIELDS: ClassVar[dict[str, Field]]

    def __init__(self, **values: object) -> None:
        for name, field in self.FIELDS.items():
            if name not in values:
                object.__setattr__(self, name, field.default())
        for name, value in values.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: object) -> None:
        field = self.FIELDS.get(name)
        if field is None:
            raise UnknownFieldError(f'{self.TYPENAME} has no field {name!r}: {[*self.FIELDS]}')
        try:
            checked = field.check(value)
        except (TypeError, ValueError, OverflowError) as error:
            msg = f'{self.TYPENAME}.{name} {error}, not {type(value).__name__} {value!r:.60}'
            raise FieldValueError(msg) from error
        object.__setattr__(self, name, checked)

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in self.FIELDS
        )

    def __repr__(self) -> str:
        values = {name: getattr(self, name) for name in self.FIELDS if name != _EMPTY}
        fields = (f'{name}={list(value) if isinstance(value, array.array) else value!r}'
                  for name, value in values.items())
        return f'{self.TYPENAME.replace("/", ".")}({", ".join(fields)})'

    @classmethod
    def from_wire(cls, *values: object) -> Message:
        """Build a message of values as rosbags reads them, trusting their types."""
        message = cls.__new__(cls)
        for (name, field), value in zip(cls.FIELDS.items(), values, strict=True):
            convert = field.from_wire
            object.__setattr__(message, name, convert(value) if convert else value)
        return message


@cache
def _store() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, (constants, fields) in store.fielddefs.items():
        store.fielddefs[name] = (constants, [(n, _without_char(desc)) for n, desc in fields])
    for service, parts in _SERVICES.items():
        for suffix, text in zip(('_Request', '_Response'), parts, strict=True):
            (definition,) = get_types_from_msg(text, f'{service}{suffix}').values()
            store.register({f'{service}{suffix}': definition})
    return store


def _without_char(desc: Any) -> Any:
    """Return a descriptor in which char is uint8, as rosidl has it in its type hashes."""
    kind, argument = desc
    if kind in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
        return kind, (_without_char(argument[0]), argument[1])
    return (kind, ('uint8', 0)) if argument == ('char', 0) else desc


@cache
def message_class(typename: str) -> type[Message]:
    """Return the class of a message, for example of `geometry_msgs/msg/PoseStamped`."""
    constants, _ = _store().fielddefs[typename]
    fields = {name: _field(typename, name, desc) for name, desc in definition(typename)}
    namespace: dict[str, object] = {
        name: bytes([value]) if kind == 'byte' else value for name, kind, value in constants
    }
    package, kind, cls_name = typename.split('/')
    namespace |= {'__slots__': tuple(fields), '__module__': f'{package}.{kind}'}
    namespace |= {'TYPENAME': typename, 'FIELDS': fields}
    cls: type[Message] = type(cls_name, (Message,), namespace)
    # rosbags calls what it finds here with the values it read, in the order of the fields.
    _store().types[typename] = cls.from_wire
    return cls


@cache
def service_class(typename: str) -> type[Any]:
    """Return the class of a service, with its Request and Response."""
    parts = {p: message_class(f'{typename}_{p}') for p in ('Request', 'Response')}
    return type(typename.rsplit('/', 1)[1], (), {'TYPENAME': typename, **parts})


def definition(typename: str) -> list[tuple[str, Any]]:
    """Return names and rosbags descriptors of the fields of a message, never an empty list."""
    fields = _store().fielddefs[typename][1]
    return fields or [(_EMPTY, (Nodetype.BASE, ('uint8', 0)))]


@cache
def type_hash(typename: str) -> str:
    """Return the RIHS01 hash by which ROS 2 compares message definitions."""
    return cast('str', _store().hash_rihs01(typename))


def serialize(message: Message) -> bytes:
    """Return a message as CDR: little-endian, with the encapsulation header."""
    return bytes(_store().serialize_cdr(_to_wire(message), message.TYPENAME, little_endian=True))


def deserialize(data: bytes, cls: type[Message]) -> Message:
    """Return the message of a class that CDR bytes with encapsulation header hold.

    What is not UTF-8 in a string becomes question marks; anything else raises UnreadableError.
    """
    for _ in range(_BAD_STRINGS):
        try:
            return cast('Message', _store().deserialize_cdr(data, cls.TYPENAME))
        except Exception as error:
            bad = error.__cause__
            if not isinstance(bad, UnicodeDecodeError):
                raise UnreadableError(f'not a {cls.TYPENAME} ({error!r:.80})') from error
            # As long as before, so that everything else stays where it is; behind its length, so
            # that numbers of the same bytes stay what they are.
            length = (len(bad.object) + 1).to_bytes(4, 'little' if data[1] & 1 else 'big')
            mended = bad.object.decode('utf-8', 'mark').encode()
            data = data.replace(length + bad.object, length + mended, 1)
    raise UnreadableError(f'{cls.TYPENAME} with more than {_BAD_STRINGS} strings not in UTF-8')


# As `rclpy.serialization` calls them
serialize_message, deserialize_message = serialize, deserialize


def _to_wire(message: Message) -> object:
    if not _needs_conversion(message.TYPENAME):
        return message
    return SimpleNamespace(**{
        name: field.to_wire(getattr(message, name)) if field.to_wire else getattr(message, name)
        for name, field in message.FIELDS.items()
    })


@cache
def _needs_conversion(typename: str) -> bool:
    return any(field.to_wire for field in message_class(typename).FIELDS.values())


def _field(typename: str, name: str, desc: Any) -> Field:
    field = _any_field(desc)
    if (typename, name) in _DEFAULTS:
        value = _DEFAULTS[typename, name]
        return field._replace(default=lambda: value)
    return field


def _any_field(desc: Any) -> Field:
    kind, argument = desc
    if kind == Nodetype.BASE:
        return _scalar(*argument)
    if kind == Nodetype.NAME:
        return _nested(argument)
    (item_kind, item), length = argument
    numeric = item_kind == Nodetype.BASE and item[0] in _CODES
    if kind == Nodetype.ARRAY:
        return _numeric_array(item[0], length) if numeric else _list((item_kind, item), length, 0)
    return _numeric_sequence(item[0], length) if numeric else _list((item_kind, item), 0, length)


def _scalar(kind: str, bound: int) -> Field:
    if kind in _CODES:
        dtype = np.dtype(_CODES[kind])
        return Field(float if dtype.kind == 'f' else int, _number_check(dtype))
    if kind == 'byte':
        return Field(
            lambda: b'\0',
            lambda value: _require(
                isinstance(value, bytes) and len(value) == 1, value, 'takes bytes of length 1'),
            to_wire=lambda value: int.from_bytes(value, 'little', signed=True),
            from_wire=lambda value: bytes([value & 0xFF]),
        )
    if kind == 'bool':
        return Field(bool, lambda value: _require(isinstance(value, bool), value, 'takes a bool'))
    if kind == 'string':
        limit = bound or sys.maxsize
        rule = f'takes a str of at most {bound} characters' if bound else 'takes a str'
        return Field(
            str,
            lambda value: _require(isinstance(value, str) and len(value) <= limit, value, rule),
        )
    raise StandaloneError(f'fields of type {kind} are not covered without ROS 2')


def _number_check(dtype: np.dtype[Any]) -> Convert:
    # The C side of generated messages misreads an int in a float field, so it is refused here.
    if dtype.kind == 'f':
        return lambda value: _require(isinstance(value, float), value, 'takes a float')
    low, high = int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)
    rule = f'takes an int in [{low}, {high}]'
    return lambda value: _require(isinstance(value, int) and low <= value <= high, value, rule)


def _nested(typename: str) -> Field:
    cls = message_class(typename)

    def check(value: object) -> object:
        return _require(isinstance(value, cls), value, f'takes {typename}')

    return Field(cls, check, to_wire=_to_wire if _needs_conversion(typename) else None)


def _numeric_array(kind: str, length: int) -> Field:
    dtype = np.dtype(_CODES[kind])

    def check(value: object) -> object:
        values = np.asarray(value, dtype)
        return _require(values.size == length, values, f'takes {length} values')

    return Field(
        lambda: np.zeros(length, dtype),
        check,
        to_wire=lambda value: np.ascontiguousarray(value).reshape(-1),
        from_wire=np.array,  # a copy, because what rosbags returns is read-only
    )


def _numeric_sequence(kind: str, bound: int) -> Field:
    code = _CODES[kind]
    limit = bound or sys.maxsize

    def check(value: Any) -> object:
        if not (isinstance(value, array.array) and value.typecode == code):
            value = _array(code, value)
        return _require(len(value) <= limit, value, f'takes at most {limit} values')

    return Field(
        lambda: array.array(code),
        check,
        to_wire=np.asarray,  # a view, no copy
        from_wire=lambda value: _array(code, value),
    )


def _array(code: str, value: Any) -> array.array[Any]:
    if isinstance(value, str):
        raise TypeError('takes a sequence of numbers')
    result = array.array(code)
    if isinstance(value, np.ndarray) and value.dtype == np.dtype(code):
        result.frombytes(np.ascontiguousarray(value).view(np.uint8).data)
    elif isinstance(value, bytes | bytearray | memoryview) and code == 'B':
        result.frombytes(value)
    else:
        result.extend(value)
    return result


def _list(item: Any, length: int, bound: int) -> Field:
    field = _any_field(item)
    # The wire takes flags and bytes as an array, everything else item by item.
    base = item[1][0] if item[0] == Nodetype.BASE else ''
    dtype = {'bool': np.bool_, 'byte': np.int8}.get(base)

    def check(value: Any) -> object:
        if isinstance(value, str | bytes | dict) or not isinstance(value, Iterable):
            raise TypeError('takes a sequence')
        values = value if isinstance(value, list) else list(value)
        _require(len(values) == length or not length, values, f'takes {length} items')
        _require(len(values) <= bound or not bound, values, f'takes at most {bound} items')
        return [*map(field.check, values)] if values is not value else _checked(values)

    def _checked(values: list[Any]) -> list[Any]:
        for value in values:
            field.check(value)
        return values

    def to_wire(values: list[Any]) -> object:
        items = [field.to_wire(value) for value in values] if field.to_wire else values
        return np.array(items, dtype) if dtype else items

    def from_wire(values: Any) -> list[Any]:
        items = values.tolist() if dtype else values
        return [field.from_wire(value) for value in items] if field.from_wire else items

    converts = bool(dtype or field.to_wire)
    return Field(
        lambda: [field.default() for _ in range(length)],
        check,
        to_wire=to_wire if converts else None,
        from_wire=from_wire if dtype or field.from_wire else None,
    )


def _require(condition: bool, value: object, rule: str) -> object:
    if not condition:
        raise ValueError(rule)
    return value


def packages() -> dict[str, ModuleType]:
    """Return modules that give the classes: `geometry_msgs`, `geometry_msgs.msg` and so on."""
    modules: dict[str, ModuleType] = {}
    for kind, names in (('msg', _store().fielddefs), ('srv', _SERVICES)):
        for package in {name.split('/')[0] for name in names if f'/{kind}/' in name}:
            parent = modules.setdefault(package, ModuleType(package))
            child = ModuleType(f'{package}.{kind}', f'Definitions of {package}, without ROS 2.')
            child.__getattr__ = _lookup(package, kind)  # type: ignore[method-assign]
            setattr(parent, kind, child)
            modules[child.__name__] = child
    return modules


def _lookup(package: str, kind: str) -> Callable[[str], Any]:
    def lookup(name: str) -> Any:
        typename = f'{package}/{kind}/{name}'
        if typename not in (_SERVICES if kind == 'srv' else _store().fielddefs):
            raise AttributeError(f'{typename} is not among the definitions of rosbags')
        return service_class(typename) if kind == 'srv' else message_class(typename)

    return lookup
