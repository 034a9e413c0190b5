"""Full-size car: the multi-body model of CommonRoad."""
