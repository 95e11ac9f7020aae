"""From a lane estimate to a limited command."""
