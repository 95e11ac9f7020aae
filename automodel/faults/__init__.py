"""What can go wrong with a car, injected into a run on virtual time, and whether the car did what it must."""
