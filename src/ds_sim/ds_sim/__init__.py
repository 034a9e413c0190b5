"""What a simulator is: its contract, the parts that all simulators share, and the node that hosts any of them."""
