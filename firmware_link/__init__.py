"""The vehicle's controller behind a pipe: wire format, drivers, emulators."""
