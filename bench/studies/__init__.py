"""Studies of one question each, which a document or a decision quotes."""
