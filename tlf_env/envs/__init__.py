"""Interfaces of the learning libraries: spaces, dictionaries and ends of episodes, without physics."""
