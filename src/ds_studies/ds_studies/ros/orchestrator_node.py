# SPDX-License-Identifier: Apache-2.0
"""Orchestrator as a ROS node: its thread answers, the main thread drives, as engines handle signals there."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from ds_interfaces.action import DriveTests, RunCampaign
from ds_interfaces.msg import CampaignState
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.utilities import try_shutdown

from ds_base.executables import Stop
from ds_base.extension import confirm
from ds_base.progress import lines_to
from ds_orchestrator.campaign.executor import Stopped
from ds_orchestrator.graph.signals import IgnoreSignals, listen
from ds_sim.ros.neighbours import Presence
from ds_sim.ros.node_thread import NodeThread
from ds_sim.ros.parameters import declare
from ds_sim.ros.requests import GoalServer, RequestRefused
from ds_sim.ros.runtime import init_ros
from ds_sim.simulator import Reason
from ds_studies.ros.campaign_view import CampaignView, StateListener
from ds_studies.ros.goals import ENGINES, Job, Work, drive_tests_goal, run_campaign_goal

EVERY = 1.0
"""Seconds between two messages of state; chosen: what people follow."""
GRACE, LAST_WORDS = 3.5, 0.5
"""Time in which an engine that a signal interrupts may end its drives, and then that in which the result of the goal is
sent, s: less than the 5 s after which `ros2 launch` sends SIGTERM."""
_KEPT = "what was finished is kept, and the same goal resumes"


class OrchestratorNode(Node):
    """Takes goals, and publishes state, outcomes and maps."""

    def __init__(self) -> None:
        super().__init__("orchestrator")
        self._root = Path(declare(self, "root", ".", "Folder that contains the goals' folders."))
        self._trusted = declare(self, "trust", [""], "Names in goals that may run code of their own, as module:Class.")
        confirm(self._trusted)
        self._jobs: SimpleQueue[Job] = SimpleQueue()
        self._job: Job | None = None
        self._presence = Presence(self, "orchestrator_presence", lambda: self.get_logger().error(self._crowd()))
        self._view = CampaignView(self, self._crowd)
        self._serve(RunCampaign, "run_campaign", run_campaign_goal)
        self._serve(DriveTests, "drive_tests", drive_tests_goal)
        # Steady clock: under use_sim_time the node's own stands still between runs.
        self.create_timer(EVERY, self._show, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f"ready; the folders of goals are below {self._root.resolve()}")

    def destroy_node(self) -> None:
        """End the drawing of maps with the node."""
        self._view.close()
        super().destroy_node()

    def work(self) -> None:
        """Do what goals ask, one after the other, in the main thread, until a signal's `KeyboardInterrupt`."""
        while True:
            with suppress(Empty):
                self._do(self._jobs.get(timeout=0.2))

    def _do(self, job: Job) -> None:
        try:
            with lines_to(job.listener.hear):
                job.work(job, self._trusted)
        except (Stopped, KeyboardInterrupt):
            if job.stop.is_on:
                return self._finish(job, job.goal.canceled, CampaignState.CANCELLED, f"cancelled; {_KEPT}")
            self.abandon()
            raise KeyboardInterrupt from None
        except Exception as error:  # the node outlives whatever a goal brings
            message = " ".join(str(error).split()) or type(error).__name__
            if isinstance(error, ValueError):
                job.result.reason.value = int(Reason.BAD_GOAL)
            self._finish(job, job.goal.abort, CampaignState.BROKEN, message)
        else:
            self._finish(job, job.goal.succeed, CampaignState.FINISHED, "")

    def abandon(self) -> None:
        """Send the result of a goal that a signal has interrupted, if there is one."""
        if (job := self._job) is not None:
            self._finish(job, job.goal.abort, CampaignState.BROKEN, f"a signal ended the node; {_KEPT}")
            time.sleep(LAST_WORDS)

    def _finish(self, job: Job, close: Callable[[], None], state: int, message: str) -> None:
        job.result.message = message
        job.listener.end(state, message)
        self.get_logger().info(f"{job.folder}: {message or 'finished'}")
        self._job = None
        job.server.close(job.goal, job.result, close)

    def _serve(self, kind: Any, name: str, work: Work) -> None:
        def begin(goal: ServerGoalHandle) -> None:
            self._check(goal.request.engine)
            folder, listener = self._folder(goal.request.folder), StateListener(goal.request.folder)
            self._job = Job(goal=goal, server=server, folder=folder, work=work, result=kind.Result(), listener=listener)
            self._view.begin(listener, folder if kind is RunCampaign else None)
            self._jobs.put(self._job)

        server = GoalServer(self, kind, name, begin, self._on_cancel)

    def _check(self, engine: str) -> None:
        if crowd := self._crowd():
            raise RequestRefused(Reason.TWO_ORCHESTRATORS, crowd)
        if self._job is not None:
            raise RequestRefused(Reason.BUSY, f"{self._job.folder} is under way: wait for its result, or cancel it")
        if engine not in ("", *ENGINES):
            raise RequestRefused(Reason.BAD_GOAL, f"engine {engine!r:.40}: expected one of {', '.join(ENGINES)}")

    def _folder(self, name: str) -> Path:
        path = Path(name)
        if not path.name or path.is_absolute() or ".." in path.parts:
            expected = f"expected a folder below {self._root.resolve()}, such as campaign"
            raise RequestRefused(Reason.BAD_GOAL, f"folder {name!r:.60}: {expected}")
        if any((self._root / one).is_symlink() for one in (path, *list(path.parents)[:-1])):
            raise RequestRefused(Reason.BAD_GOAL, f"folder {name!r:.60} leads through a link: remove it")
        return self._root / path

    def _crowd(self) -> str:
        """What is wrong with several orchestrators; "" if this is the only one."""
        if self._presence.others <= 0:
            return ""
        return (
            f"{self._presence.others + 1} orchestrators live in {self.get_namespace()}: stop all but one, or give them "
            "other namespaces (__ns:=)"
        )

    def _on_cancel(self, goal: ServerGoalHandle) -> None:
        job = self._job
        if job is not None and job.goal.goal_id == goal.goal_id:
            # Engines may take seconds to end their drives, and this thread has to answer.
            threading.Thread(target=job.stop.turn_on, name="cancel", daemon=True).start()

    def _show(self) -> None:
        job = self._job
        self._view.show()
        if job is not None:
            feedback = RunCampaign.Feedback if job.work is run_campaign_goal else DriveTests.Feedback
            job.goal.publish_feedback(feedback(state=job.listener.state))


def main() -> None:
    """Run the node until a signal, after which it ends within 5 s whatever it does."""
    stop = Stop(GRACE, lambda: node.abandon())
    init_ros()
    try:
        node = OrchestratorNode()
    except ValueError as error:
        try_shutdown()
        sys.exit(f"error: {error}")
    thread = NodeThread(node)
    listen()
    stop.making = False
    try:
        node.work()
    except KeyboardInterrupt:
        IgnoreSignals().__enter__()
    finally:
        if thread.end():
            node.destroy_node()
        try_shutdown()


if __name__ == "__main__":
    main()
