"""Models roll and pitch of the body on its springs, and the resulting wheel loads."""

from __future__ import annotations

import math

from ds_sim_softbody.parameters import GRAVITY, SoftbodyParameters


class Attitude:
    """Roll and pitch as two damped oscillators, excited by the acceleration of the body (Gillespie, ch. 6).

    Load that springs and dampers do not carry reaches the wheels instantly, through the arms and the unsprung masses;
    in steady state the loads are those of the whole mass at the height of its centre.

    Args:
        p: parameters of the car.
    """

    def __init__(self, p: SoftbodyParameters) -> None:
        self._p = p
        self.roll = self.roll_rate = 0.0
        self.pitch = self.pitch_rate = 0.0
        axle = p.wheelbase / 2.0
        spring = p.sprung_mass * (math.tau * p.ride_frequency) ** 2
        self._roll_arm = p.centre_of_mass_height - p.roll_axis_height
        lever = p.sprung_mass * self._roll_arm
        # Net of gravity, which increases the lean: gradient = lever / stiffness.
        net_roll = lever / p.roll_gradient
        self._roll_stiffness = net_roll + lever * GRAVITY
        self._roll_damping = 2.0 * p.body_damping * math.sqrt(net_roll * p.roll_inertia)
        self._pitch_lever = p.sprung_mass * p.centre_of_mass_height
        self._pitch_stiffness = spring * axle**2
        net_pitch = self._pitch_stiffness - self._pitch_lever * GRAVITY
        self._pitch_damping = 2.0 * p.body_damping * math.sqrt(net_pitch * p.pitch_inertia)

    def advance(self, forward: float, left: float, dt: float) -> None:
        """Advance by dt (s) under an acceleration of the body (forward and left, m/s^2)."""
        p = self._p
        lever = p.sprung_mass * self._roll_arm
        roll_moment = lever * (left + GRAVITY * math.sin(self.roll)) - self._roll_reaction()
        pitch_moment = self._pitch_lever * (GRAVITY * math.sin(self.pitch) - forward) - self._pitch_reaction()
        self.roll_rate += roll_moment / p.roll_inertia * dt
        self.pitch_rate += pitch_moment / p.pitch_inertia * dt
        self.roll += self.roll_rate * dt
        self.pitch += self.pitch_rate * dt

    def loads(self, forward: float, left: float) -> tuple[float, float, float, float]:
        """Wheel loads under an acceleration of the body, N: front left, front right, rear left, rear right.

        A negative load means that the wheel is in the air.

        Args:
            forward: acceleration forward, m/s^2.
            left: acceleration to the left, m/s^2.
        """
        p = self._p
        total = p.mass * p.centre_of_mass_height
        direct = (total - p.sprung_mass * self._roll_arm) * left
        lean = self._roll_reaction()
        front = (lean * p.roll_front_share + direct * p.front_share) / p.track
        rear = (lean * (1.0 - p.roll_front_share) + direct * (1.0 - p.front_share)) / p.track
        dive = (self._pitch_reaction() - (total - self._pitch_lever) * forward) / p.wheelbase
        front_half = (p.mass * GRAVITY * p.front_share + dive) / 2.0
        rear_half = (p.mass * GRAVITY * (1.0 - p.front_share) - dive) / 2.0
        return front_half - front, front_half + front, rear_half - rear, rear_half + rear

    def _roll_reaction(self) -> float:
        """Restoring moment of springs and dampers in roll, N m."""
        return self._roll_stiffness * self.roll + self._roll_damping * self.roll_rate

    def _pitch_reaction(self) -> float:
        """Restoring moment of springs and dampers in pitch, N m."""
        return self._pitch_stiffness * self.pitch + self._pitch_damping * self.pitch_rate
