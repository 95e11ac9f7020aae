"""The shipped tracks, one TOML each; `automodel.sim.track_files.load_track` reads them."""
