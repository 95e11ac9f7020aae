"""What can go wrong with a source."""


class SourceError(OSError):
    """A source is broken or its file is wrong; the text is one line: what, where, what to do."""


class EndOfSource(Exception):  # an end, not an error
    """The source has delivered its last frame."""
