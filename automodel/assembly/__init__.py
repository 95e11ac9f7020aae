"""From a configuration to concrete parts: the only place below the commands that knows concrete classes."""
