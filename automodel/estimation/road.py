"""How roads change along their way, and how well a car's motion is known, for every estimator.

Lengths are in lane widths.
"""

ANY_BEND = 0.3  # [1 / lane width] sigma of a road's curvature where nothing is known
TAPER = 0.03  # sigma of the width's change along the road: by a third within three lane widths at most
TAPER_LANES = 3.0  # for which such a change lasts
BEHIND = 1.2  # of the lane behind the reference point that is kept: the rear of a car
NODE = 0.6  # between two nodes of a curve that describes a road's bends
WALK = 0.02  # sigma that offset, and heading [rad], gain over a lane width of driving by odometry
LOST_STEP, LOST_TURN_RAD = 0.5, 1.0  # what they gain over a second of unknown motion
MAX_GAP_S = 0.5  # a longer gap between frames: a car at 1 m/s has driven more than a scale lane's width
LOST_PACE = 3.0  # 1/s: speed of a car of which nothing is known
MOST_SIGMAS = 10.0  # of such a car: none drives more than 30 lane widths in a second, or turns by more than 10 rad
OUTLIER = 0.06  # of a line's points: distance from it at which Tukey's biweight becomes 0
