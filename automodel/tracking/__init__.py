"""What happens between frames, for every pipeline alike: which lane it is, how sure that is, and how long it lives."""
