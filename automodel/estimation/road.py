"""How roads change along their way, for every estimator."""

TAPER = 0.03  # sigma of the width's change along the road: by a third within three lane widths at most
TAPER_LANES = 3.0  # lane widths for which such a change lasts
