"""A run for who watches it: a page with STOP and arming by a button that is held, and Foxglove."""
