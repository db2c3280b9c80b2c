"""Live windows: an episode in real time that can be changed by hand, and a leader that is driven by hand."""
