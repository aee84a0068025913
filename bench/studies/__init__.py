"""Studies of single questions, quoted by pages or decisions."""
