"""World of a road in Panda3D, and the camera that sees it."""
