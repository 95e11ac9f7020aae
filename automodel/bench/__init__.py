"""What `automodel bench` runs: accuracy, speed, latency, faults, and the papers' tables."""
