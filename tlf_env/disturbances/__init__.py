"""What disturbs the robots: channels, their signals over time, and the model of all channels."""
