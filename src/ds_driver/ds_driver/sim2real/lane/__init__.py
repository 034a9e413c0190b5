"""Where the lane is: finds its lines in images, and shows it alike in both domains."""
