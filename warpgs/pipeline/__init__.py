"""The fit, in the order of the story: each file takes what the one before it made."""
