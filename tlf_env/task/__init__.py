"""The task: scenario, reference trajectories, observation, reward terms, end of an episode, metrics.

It uses the true state, and no API of a learning library.
"""
