"""Two cameras: stripes in both images, their epipolar matches, and the ground plane that these lie on."""
