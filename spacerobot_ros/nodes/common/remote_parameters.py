"""The parameters of other nodes, asked for through their services without waiting for them."""

from __future__ import annotations

import json
from collections.abc import Generator
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

_MOST_LOOKS = 200
"""Looks after which a node that does not answer has no such services."""

_SETTLED = 3
"""Looks after which the node has met the client, too. Before that its answer would hold it up for a
tenth of a second, and be lost.
"""

_LOST_AFTER = 50
"""Looks after which an answer is lost: the middleware drops it where it has not met the client."""


class RemoteParameters:
    """All parameters of one node, once it has answered; look again and again.

    Parameters
    ----------
    node
        Who asks.
    name
        Full name of the node that is asked.
    """

    def __init__(self, node: Node, name: str) -> None:
        self._node, self.name = node, name
        self.values: dict[str, str] | None = None
        """Every parameter that is set, as a JSON text by its full name; None before the answer."""
        self._steps = self._ask()

    def look(self) -> bool:
        """Return whether nothing more is to come: the node has answered, or never will."""
        return next(self._steps, True)

    def close(self) -> None:
        """Ask no more."""
        self._steps.close()

    def _ask(self) -> Generator[bool, None, None]:
        everything = ListParameters.Request(depth=ListParameters.Request.DEPTH_RECURSIVE)
        listed = yield from self._call(ListParameters, "list_parameters", everything)
        if listed is None:
            return
        names = list(listed.result.names)
        these = GetParameters.Request(names=names)
        got = yield from self._call(GetParameters, "get_parameters", these)
        if got is not None and len(got.values) == len(names):
            values = zip(names, map(parameter_value_to_python, got.values), strict=True)
            self.values = {name: json.dumps(_plain(value)) for name, value in values}

    def _call(self, kind: Any, service: str, request: Any) -> Generator[bool, None, Any]:
        """Return the answer of a service; None if it is late."""
        client: Client = self._node.create_client(kind, f"{self.name}/{service}")
        try:
            future, asked_at, ready = None, 0, 0
            for look in range(_MOST_LOOKS):
                if future is not None and future.done():
                    return future.result()
                ready = ready + 1 if client.service_is_ready() else 0
                lost = future is None or look - asked_at >= _LOST_AFTER
                if lost and ready > _SETTLED:
                    future, asked_at = client.call_async(request), look
                yield False
            return None
        finally:
            self._node.destroy_client(client)


def _plain(value: Any) -> Any:
    """Return a value as JSON can say it."""
    return value if value is None or isinstance(value, (bool, int, float, str)) else list(value)
