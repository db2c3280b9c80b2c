"""The task: scenario, reference trajectories, observation, reward terms, end of an episode, metrics.

Knows the true state and what is wanted of it; knows no API of any learning library.
"""
