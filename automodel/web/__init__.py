"""The page of a run: what the car sees and does, STOP, and arming by a button that is held."""
