"""Parameters of another node, where the middleware loses an answer."""

from __future__ import annotations

from itertools import count
from typing import Any

from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters

from spacerobot_ros.nodes.common.ros_parameters import RemoteParameters


class Future:
    def __init__(self, answer: Any) -> None:
        self.answer = answer

    def done(self) -> bool:
        return self.answer is not None

    def result(self) -> Any:
        return self.answer


class Client:
    """Of a service whose first ``lost`` answers never come; it is there at the second look."""

    def __init__(self, answer: Any, lost: int) -> None:
        self.calls, self.looks, self._answer, self._lost = 0, 0, answer, lost

    def service_is_ready(self) -> bool:
        self.looks += 1
        return self.looks > 1

    def call_async(self, request: Any) -> Future:
        assert self.looks > 4, "the service has not met the client yet"
        self.calls += 1
        return Future(None if self.calls <= self._lost else self._answer)


class Node:
    """A node that asks; ``clients`` are those that it has made and not destroyed."""

    def __init__(self, lost: int) -> None:
        listed = ListParameters.Response()
        listed.result.names = ["rate"]
        value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=2.5)
        self._answers = {
            ListParameters: listed,
            GetParameters: GetParameters.Response(values=[value]),
        }
        self._lost, self.clients = lost, list[Client]()

    def create_client(self, kind: Any, name: str) -> Client:
        self.clients.append(Client(self._answers[kind], self._lost))
        return self.clients[-1]

    def destroy_client(self, client: Client) -> None:
        self.clients.remove(client)


def looks_at(lost: int) -> tuple[RemoteParameters, int, Node]:
    """Return what was asked for, after how many looks, and who asked."""
    node: Any = Node(lost)
    asking = RemoteParameters(node, "/plant")
    looks = next(number for number in count(1) if asking.look())
    return asking, looks, node


def test_an_answer_that_is_lost_is_asked_for_again() -> None:
    asking, at_once, node = looks_at(lost=0)
    assert asking.values == {"rate": "2.5"}
    assert at_once < 15
    assert node.clients == []
    asking, looks, node = looks_at(lost=1)
    assert asking.values == {"rate": "2.5"}
    assert looks > 50, "one that is late is waited for"
    assert node.clients == []


def test_a_node_that_never_answers_is_given_up() -> None:
    asking, looks, node = looks_at(lost=1000)
    assert asking.values is None
    assert looks < 1000
    assert node.clients == []
