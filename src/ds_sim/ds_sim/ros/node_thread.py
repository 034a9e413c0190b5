# SPDX-License-Identifier: Apache-2.0
"""Spins a node in a thread of its own and calls services through it; every wait has a limit."""

from __future__ import annotations

import atexit
import threading
from collections.abc import Callable
from typing import Any

from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.task import Future

from ds_base.processes import RunningClock
from ds_sim.ros.runtime import SPIN_TIME, make_executor

ANSWER_TIME = 2.0
"""Time after which a service is called again, s: a node that is being discovered, or has just died, never answers."""
END_TIME = 2.0
"""Limit for a callback under way to return when the thread is to end, s."""


class NodeThread:
    """Thread that spins one node until `end`."""

    def __init__(self, node: Node) -> None:
        self._stopped, self._ending = threading.Event(), threading.Event()
        self._clock = RunningClock()
        self._executor = make_executor(node.context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, name=node.get_name(), daemon=True)
        self._thread.start()
        atexit.register(self.end)  # a thread in ROS aborts an interpreter that ends under it

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stopped.is_set()

    def stop(self) -> None:
        """End every wait now; the node is still spun."""
        self._stopped.set()

    def end(self) -> bool:
        """Stop, end the thread, and let go of the node, unless a callback keeps it: False, do not destroy it."""
        atexit.unregister(self.end)
        self.stop()
        self._ending.set()
        self._thread.join(END_TIME)
        if self._thread.is_alive():
            return False
        # An executor keeps the handles of its nodes, and with them their participant, until it is shut down.
        self._executor.shutdown()
        return True

    def pause(self, seconds: float) -> bool:
        """Wait, and return True as soon as `stop` is called."""
        return self._stopped.wait(seconds)

    def ask(self, client: Any, request: Any, limit: float) -> Any:
        """Call a service, repeatedly if needed; None without an answer within a limit, s."""
        deadline = self._clock.now() + limit
        while (left := deadline - self._clock.now()) > 0.0:
            answer = self.call(lambda: client.call_async(request), min(left, ANSWER_TIME))
            if answer is not None or self.stopped:
                return answer
        return None

    def call(self, begin: Callable[[], Future], limit: float) -> Any:
        """Send a request and wait for its answer; None after a limit, s, or when stopped.

        The node's thread calls `begin`, which sends the request: rclpy's action client has no lock, and drops an answer
        that arrives before the request is registered.
        """
        deadline = self._clock.now() + limit
        sent = self.send(begin, limit)
        return None if sent is None else self.wait(sent, max(0.0, deadline - self._clock.now()))

    def send(self, begin: Callable[[], Future], limit: float) -> Future | None:
        """Send a request as `call` does, and return the future of its answer; None after the limit or when stopped."""
        sent: Future | None = self.wait(self._executor.create_task(begin), limit)
        return sent

    def wait(self, future: Future, limit: float) -> Any:
        """Wait for a future's result; None after the limit or when stopped."""
        ready = threading.Event()
        future.add_done_callback(lambda _future: ready.set())
        deadline = self._clock.now() + limit
        while not ready.wait(min(0.1, max(0.0, deadline - self._clock.now()))):
            if self.stopped or self._clock.now() >= deadline:
                return None
        return future.result()

    def _spin(self) -> None:
        try:
            while not self._ending.is_set():
                self._executor.spin_once(timeout_sec=SPIN_TIME)
        except ExternalShutdownException:
            pass
