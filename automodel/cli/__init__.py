"""The commands; the only place that knows concrete classes."""
