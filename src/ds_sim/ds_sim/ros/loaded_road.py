"""Holds the road that a simulator's node drives next."""

from __future__ import annotations

from ds_interfaces.msg import Road as RoadMsg

from ds_road import Road, RoadError
from ds_sim.ros.conversions import road_from_message
from ds_sim.ros.refusal import RequestRefused
from ds_sim.simulator import Reason


class LoadedRoad:
    """Stores the road and seed that were loaded last."""

    def __init__(self) -> None:
        self.road: Road | None = None
        self.seed = 0

    def load(self, message: RoadMsg, seed: int) -> Road:
        """Check and store a road; a refused road does not replace the stored one.

        Raises:
            RequestRefused: BAD_ROAD.
        """
        try:
            road = road_from_message(message)
        except RoadError as error:
            raise RequestRefused(Reason.BAD_ROAD, str(error)) from None
        if not road.validity.valid:
            raise RequestRefused(Reason.BAD_ROAD, f"the road is not valid: {road.validity.reason}")
        self.road, self.seed = road, seed
        return road
