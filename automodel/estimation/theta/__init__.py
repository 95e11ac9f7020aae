"""Lines and centerline as heading over arc length, theta(s) (Cudrano et al. 2020)."""
