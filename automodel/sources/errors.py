"""What can go wrong with a source."""


class SourceError(OSError):
    """A source is broken or its file is wrong; the text is one line: what, where, what to do."""


class SourceStalled(SourceError):
    """A source gives nothing that can be used, and may go on by itself; where that is `lasting`, open it anew."""

    def __init__(self, text: str, lasting: bool) -> None:
        super().__init__(text)
        self.lasting = lasting


class EndOfSource(Exception):  # an end, not an error
    """The source has delivered its last frame."""
