"""Digital sibling `torcs`: the car and the renderer of TORCS, in a process of its own."""
