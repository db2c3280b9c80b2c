"""The simulation of an episode: its arrays, and the compiled drivers that advance them."""
