"""World and camera of the simulator `panda`, drawn by Panda3D."""
