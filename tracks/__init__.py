"""The shipped tracks, one TOML each; `automodel.sim.track.load_track` reads them."""
