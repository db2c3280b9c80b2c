"""Training of policies with stable-baselines3."""
