"""Force law of the suspension: springs, dampers, bump stops and anti-roll bars."""

from __future__ import annotations

from collections.abc import Sequence

from ds_sim_bullet.parameters import BulletParameters


class Suspension:
    """Suspension forces at the four hubs, in the order of `ds_sim_bullet.urdf.CORNERS`.

    Args:
        p: parameters of the car.
    """

    def __init__(self, p: BulletParameters) -> None:
        self._travel, self._stop = p.travel, p.stop_stiffness
        front, rear = (
            (p.spring_load(front=f), p.spring_stiffness(front=f), p.spring_damping(front=f)) for f in (True, False)
        )
        self._corners = (front, front, rear, rear)
        self._bars = (p.front_anti_roll, p.rear_anti_roll)

    def forces(self, guides: Sequence[tuple[float, ...]]) -> list[float]:
        """Force on each hub, N, positive up.

        Args:
            guides: joint states of the guides as PyBullet reports them: position (m) and velocity (m/s) first,
                positive up (compression).
        """
        forces = []
        for (load, stiffness, damping), guide in zip(self._corners, guides, strict=True):
            position, velocity = guide[0], guide[1]
            beyond = position - min(max(position, -self._travel), self._travel)
            forces.append(-(load + stiffness * position + damping * velocity + self._stop * beyond))
        for axle, bar in enumerate(self._bars):
            twist = bar * (guides[2 * axle][0] - guides[2 * axle + 1][0])
            forces[2 * axle] -= twist
            forces[2 * axle + 1] += twist
        return forces
