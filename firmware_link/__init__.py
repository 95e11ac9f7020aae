"""The link to the vehicle's controller: wire format, drivers, emulators."""
