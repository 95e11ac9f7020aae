"""What drives: the loop of one frame, the run around it, the safety state machine, clocks and signals."""
