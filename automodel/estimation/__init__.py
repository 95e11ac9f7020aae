"""From line points to the lane: the model and the filter of each paper, and the car's own motion."""
