"""Time of ops and of training steps."""
