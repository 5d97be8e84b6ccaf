"""The services behind `ros2 param`: get, set, list and describe the parameters of a node."""

from __future__ import annotations

from typing import Any

from fisheye_svp_ros.standalone.exceptions import ParameterException
from fisheye_svp_ros.standalone.messages import message_class, service_class
from fisheye_svp_ros.standalone.parameters import Parameter
from fisheye_svp_ros.standalone.qos import qos_profile_parameters

_Result: Any = message_class('rcl_interfaces/msg/SetParametersResult')


class ParameterServices:
    """Offers the parameters of a node to other processes."""

    def __init__(self, node: Any) -> None:
        self._node = node
        for name, callback in (
            ('DescribeParameters', self._describe),
            ('GetParameters', self._get),
            ('GetParameterTypes', self._get_types),
            ('ListParameters', self._list),
            ('SetParameters', self._set),
            ('SetParametersAtomically', self._set_atomically),
        ):
            topic = ''.join(f'_{c.lower()}' if c.isupper() else c for c in name).lstrip('_')
            node.create_service(
                service_class(f'rcl_interfaces/srv/{name}'),
                f'~/{topic}',
                callback,
                qos_profile=qos_profile_parameters,
            )

    def _describe(self, request: Any, response: Any) -> Any:
        # An unknown name empties the answer: that is how ROS 2 says that it is not declared.
        if all(self._node.has_parameter(name) for name in request.names):
            response.descriptors = [self._node.describe_parameter(n) for n in request.names]
        return response

    def _get(self, request: Any, response: Any) -> Any:
        try:
            parameters = self._node.get_parameters(request.names)
        except ParameterException:
            return response
        response.values = [parameter.get_parameter_value() for parameter in parameters]
        return response

    def _get_types(self, request: Any, response: Any) -> Any:
        if all(self._node.has_parameter(name) for name in request.names):
            response.types = [self._node.describe_parameter(n).type for n in request.names]
        return response

    def _list(self, request: Any, response: Any) -> Any:
        names = self._node.get_parameters_by_prefix('')
        for name in names:
            if request.prefixes or request.depth:
                below = [name[len(p) + 1 :] for p in request.prefixes if name.startswith(f'{p}.')]
                rest = below or ([] if request.prefixes else [name])
                shallow = any(not request.depth or r.count('.') < request.depth for r in rest)
                if name not in request.prefixes and not shallow:
                    continue
            response.result.names.append(name)
            prefix = name.rpartition('.')[0]
            if prefix and prefix not in response.result.prefixes:
                response.result.prefixes.append(prefix)
        return response

    def _set(self, request: Any, response: Any) -> Any:
        response.results = [self._try([message]) for message in request.parameters]
        return response

    def _set_atomically(self, request: Any, response: Any) -> Any:
        response.result = self._try(request.parameters)
        return response

    def _try(self, messages: list[Any]) -> Any:
        try:
            parameters = [Parameter.from_parameter_msg(message) for message in messages]
            return self._node.set_parameters_atomically(parameters)
        except (ParameterException, ValueError) as error:
            return _Result(successful=False, reason=str(error))
