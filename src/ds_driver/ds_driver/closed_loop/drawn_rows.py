"""Leaves out the rows of a simulator's images that nobody looks at in a run."""

from __future__ import annotations

from ds_sim.simulator import DrawsRows, Simulator, TakesStills


def draw_seen_rows(simulator: Simulator, rows: tuple[int, int] | None, *, probed: bool) -> None:
    """Draw only the rows of the runs to come that the driver or the probe of the lines looks at.

    Args:
        simulator: draws whole images if it does not satisfy `ds_sim.simulator.DrawsRows`.
        rows: first row and end of the rows that the driver sees; None for all.
        probed: whether the contrast of the lines is measured, on the camera's whole images unless the simulator
            satisfies `ds_sim.simulator.TakesStills`.
    """
    if not isinstance(simulator, DrawsRows):
        return
    if probed and not isinstance(simulator, TakesStills):
        rows = None
    simulator.draw_rows(*(rows or (0, simulator.spec.camera.height_px)))
