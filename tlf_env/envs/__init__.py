"""The learning libraries' interfaces. No physics and no mathematics: only spaces, dictionaries and ends."""
