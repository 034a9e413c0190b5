"""Scene of the simulator `panda`: a world and a camera drawn by Panda3D."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import SimulatorError, VehicleState
from ds_sim_panda.scene.graphics import graphics, panda
from ds_sim_panda.scene.viewpoint import camera_pose, check_camera, make_lens
from ds_sim_panda.scene.world import World


class PandaScene:
    """Implements `ds_sim.scene.Scene` with Panda3D: textured meshes, shadows of the sun, haze.

    The world belongs to the road: the same road always looks alike, whatever the seed of the run. The camera has
    neither noise nor latency.

    Args:
        camera: pinhole camera.

    Raises:
        ValueError: the camera has a property that this scene does not draw.
        ImportError: Panda3D is not installed.
        SimulatorError: EGL or Mesa's software renderer is missing.
    """

    def __init__(self, camera: CameraSpec) -> None:
        check_camera(camera)
        graphics()
        self._spec = camera
        self._rows = self._run_rows = (0, camera.height_px)
        self._camera = panda().NodePath(panda().Camera("camera", make_lens(camera)))
        self._world: World | None = None

    def load(self, road: Road, rng: np.random.Generator) -> None:
        """Build the world of a road from scratch; `rng` is not used."""
        self._world = None
        self._run_rows = self._rows
        self._world = World(road)

    def image(self, state: VehicleState) -> NDArray[np.uint8]:
        """Deliver the next camera image, (rows, columns, 3) uint8 RGB, read-only."""
        return self._draw(state, self._run_rows)

    def still(self, state: VehicleState, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Take one image from any pose; `rng` is not used."""
        return self._draw(state, self._run_rows)

    def draw_rows(self, top: int, bottom: int) -> None:
        """Draw only some rows of the images of the runs to come."""
        height = self._spec.height_px
        if not 0 <= top < bottom <= height:
            raise ValueError(f"rows {top} to {bottom} are no part of an image: expected 0 <= top < bottom <= {height}")
        self._rows = (top, bottom)

    def close(self) -> None:
        """Release the world; `load` may follow."""
        self._world = None

    def _draw(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        world, spec = self._world, self._spec
        if world is None:
            raise SimulatorError("the scene has no road: load one first")
        pose = camera_pose(spec, state)
        pose[3, :2] -= world.origin
        self._camera.reparent_to(world.root)
        self._camera.set_mat(panda().LMatrix4(*pose.ravel().tolist()))
        world.follow(*pose[3, :3].tolist())
        world.show_rows(*rows, spec.height_px)
        drawn = graphics().draw(self._camera, spec.width, spec.height_px)
        image = cv2.cvtColor(drawn[::-1], cv2.COLOR_BGR2RGB)
        image[: rows[0]] = 0
        image[rows[1] :] = 0
        image.setflags(write=False)
        return image
